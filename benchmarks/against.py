"""This tree against an earlier commit, turn about: `python -m benchmarks.against COMMIT`.

Each tree is imported by a process of its own, and both are asked for the same call one after the
other, so that a machine that slows down slows both. How far the results differ is printed, too: at
19dbbc9 a place in three solids counted less than now, and untangled poses are not the same.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section

_ROOT = Path(__file__).resolve().parents[1]
_WORKER = Path(__file__).with_name("against_worker.py")
# What is called, and of how many meshes: no mesh comes twice, but for those to be untangled.
CALLS = {
    "default": ("default", 60),
    "default_warm": ("default, moved by up to 1 mm since the last call", 60),
    "folds": ("folds left out", 60),
    "folds_warm": ("folds left out, moved by up to 1 mm", 60),
    "margin_warm": ("folds left out, margin of 2 mm, moved by up to 1 mm", 60),
    "untangle": ("untangle_pose, compiled", 12),
    "scene": ("default, two people in each other", 20),
    "five": ("default, five people clear of each other", 20),
    "million": ("default, two balls, 1,048,576 triangles in all", 3),
    "box": ("default, a box of 12 triangles", 60),
    "rays512": ("512 x 512 rays, one direction", 20),
    "rays512x3": ("512 x 512 rays, three directions", 20),
    "rays2048": ("2048 x 2048 rays, one direction", 10),
    "labels": ("labels, vertex rule", 20),
}


@dataclass
class Settings:
    """With what the tree is compared."""

    commit: Annotated[str, tyro.conf.Positional]
    """Any name that git has for it."""
    only: tuple[str, ...] = ()
    """Calls by their short names, all of them if none is given."""
    record: bool = False
    """Write the table into results.md."""


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """A folder with the tree of that commit."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        add = ["git", "worktree", "add", "--quiet", "--detach", str(tree), commit]
        subprocess.run(add, cwd=_ROOT, check=True)
        try:
            yield tree
        finally:
            remove = ["git", "worktree", "remove", "--force", str(tree)]
            subprocess.run(remove, cwd=_ROOT, check=True)


class Worker:
    """A process that measures with one tree.

    Args:
        tree: where the package is imported from.
        script: what runs there: it answers each line with a line of JSON.
    """

    def __init__(self, tree: Path, script: Path = _WORKER):
        self._process = subprocess.Popen(
            [sys.executable, str(script), str(tree)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def measure(self, call: str) -> tuple[Any, ...]:
        """What the script answers: milliseconds and more."""
        process = self._process
        if process.stdin is None or process.stdout is None:
            raise ValueError("the worker must have pipes: got none.")
        print(call, file=process.stdin, flush=True)
        answer = process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{call} must be measured: the worker stopped with no answer.")
        return tuple(json.loads(answer))

    def close(self) -> None:
        """End it."""
        self._process.communicate()


def compared(before: Worker, now: Worker, call: str, meshes: int, advance) -> list[str]:
    """A row's figures: the times, the ratios, and how far the results differ."""
    times, used, off = [], [], []
    for turn in range(meshes + 1):
        # The first compiles, and is called again.
        line = f"{call} {max(turn - 1, 0)}"
        (old, was, old_used), (new, found, new_used) = before.measure(line), now.measure(line)
        if turn:
            times.append((old, new))
            used.append((old_used, new_used))
            # The value's sum, and the spread of what else there is, such as the gradient.
            off.append(max(abs(found[k] - was[k]) / max(abs(was[k]), 1e-30) for k in (0, -1)))
        advance()
    old, new = np.array(times).T
    ratio = np.percentile(new / old, [10, 50, 90])
    of_processor = np.median(np.divide(*np.array(used).T[::-1]))
    figures = (np.median(old), np.median(new), old.min(), new.min())
    return [
        *(f"{x:.2f}" if x < 10 else f"{x:.1f}" for x in figures),
        *(f"{x:.2f}" for x in (*ratio, of_processor)),
        f"{100 * np.median(off):.1g}",
    ]


def main(settings: Settings) -> None:
    unknown = sorted(set(settings.only) - set(CALLS))
    if unknown:
        sys.exit(f"only must be some of {', '.join(CALLS)}: got {', '.join(unknown)}.")
    chosen = {name: CALLS[name] for name in settings.only or CALLS}
    with checked_out(settings.commit) as tree:
        before, now = Worker(tree), Worker(_ROOT)
        rows = []
        with progress() as bar:
            task = bar.add_task("calls", total=sum(count + 1 for _, count in chosen.values()))
            for call, (name, meshes) in chosen.items():
                found = compared(before, now, call, meshes, lambda: bar.advance(task))
                rows.append((name, str(meshes), *found))
        before.close()
        now.close()
    table = Table(
        f"Value and gradient under jit, this tree and {settings.commit}, milliseconds",
        (
            "call",
            "meshes",
            "median then",
            "now",
            "least then",
            "now",
            "ratio 10 %",
            "median",
            "90 %",
            "of processor time",
            "off, %",
        ),
        rows,
    )
    table.print()
    if settings.record:
        only = f" --only {' '.join(settings.only)}" if settings.only else ""
        command = f"python -m benchmarks.against {settings.commit}{only}"
        body = f"{provenance(f'{command} --record')}\n\n{table.markdown()}"
        record_section("against", f"Against {settings.commit}", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
