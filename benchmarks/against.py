"""This tree against an earlier commit, turn about: `python -m benchmarks.against COMMIT`.

Each tree is imported by a process of its own, and both are asked for the same call one after the
other, so that a machine that slows down slows both. How far the results differ is printed, too: at
19dbbc9 a place in three solids counted less than now.
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
CALLS = {
    "default": "default",
    "rays512": "512 x 512 rays, one direction",
    "rays512x3": "512 x 512 rays, three directions",
    "rays2048": "2048 x 2048 rays, one direction",
    "scene": "default, two people in each other",
    "labels": "labels, vertex rule",
}


@dataclass
class Settings:
    """With what the tree is compared."""

    commit: Annotated[str, tyro.conf.Positional]
    """Any name that git has for it."""
    repeats: int = 20
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

    def measure(self, call: str) -> tuple[Any, Any]:
        """What the script answers: of `against_worker.py`, milliseconds and the call's numbers."""
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


def main(settings: Settings) -> None:
    with checked_out(settings.commit) as tree:
        before, now = Worker(tree), Worker(_ROOT)
        rows = []
        with progress() as bar:
            task = bar.add_task("calls", total=len(CALLS) * (settings.repeats + 1))
            for call, name in CALLS.items():
                times, off = [], 0.0
                for turn in range(settings.repeats + 1):
                    (old, was), (new, found) = before.measure(call), now.measure(call)
                    # The value's sum, and the spread of what else there is, such as the gradient.
                    for k in (0, -1):
                        off = max(off, abs(found[k] - was[k]) / max(abs(was[k]), 1e-30))
                    if turn:
                        times.append((old, new))
                    bar.advance(task)
                old, new = np.array(times).T
                ratio = np.percentile(new / old, [10, 50, 90])
                figures = (np.median(old), np.median(new), old.min(), new.min())
                rows.append(
                    (
                        name,
                        *(f"{x:.1f}" for x in figures),
                        *(f"{x:.2f}" for x in ratio),
                        f"{100 * off:.1g}",
                    )
                )
        before.close()
        now.close()
    table = Table(
        f"Value and gradient under jit, this tree and {settings.commit}, milliseconds",
        (
            "call",
            "median then",
            "now",
            "least then",
            "now",
            "ratio 10 %",
            "median",
            "90 %",
            "off, %",
        ),
        rows,
    )
    table.print()
    if settings.record:
        command = f"python -m benchmarks.against {settings.commit} --repeats {settings.repeats}"
        body = f"{provenance(f'{command} --record')}\n\n{table.markdown()}"
        record_section("against", f"Against {settings.commit}", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
