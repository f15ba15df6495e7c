"""What a fit to keypoints costs: `python -m benchmarks.fit_speed`.

One person at a time against all in one call, with the default regularizer, on scenes of
`pose_scenes.py` with noise: some of them collide on the way, most do not.
"""

import resource
import time
from dataclasses import dataclass

import jax
import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from benchmarks.pose_scenes import camera, scenes
from spt_jax import fit_pose, load_body
from spt_jax.fit import Start

_MEGABYTE = 1024  # in the kilobytes of getrusage


@dataclass
class Settings:
    """What is fitted."""

    people: int = 16
    repeats: int = 3
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


def measured(settings: Settings) -> list[list[str]]:
    """Rows: what, seconds of the first call, median seconds of the others, memory after it."""
    body = load_body()
    some = list(scenes(0, settings.people, settings.seed))
    points = np.stack([scene.noisy for scene in some])
    seen = np.stack([scene.seen for scene in some])
    shapes = np.stack([scene.shape for scene in some])

    def fit(rows, regularizer):
        found = fit_pose(
            body,
            points[rows],
            camera(),
            layout="smpl",
            confidence=seen[rows],
            start=Start(shape=shapes[rows]),
            regularizer=regularizer,
        )
        jax.block_until_ready(found.pose)

    def timed(rows, regularizer):
        start = time.perf_counter()
        fit(rows, regularizer)
        return time.perf_counter() - start

    table, before = [], memory()
    for regularizer in ("none", "spt"):
        first = timed(0, regularizer)
        singles = [timed(row, regularizer) for row in range(settings.people)]
        table.append(_row(f"one person, {regularizer}", first, singles, 1, before))
        whole = slice(None)
        first = timed(whole, regularizer)
        batches = [timed(whole, regularizer) for _ in range(settings.repeats)]
        name = f"{settings.people} in one call, {regularizer}"
        table.append(_row(name, first, batches, settings.people, before))
        share = np.median(batches) / np.sum(singles)
        table.append(
            [f"the call against {settings.people} single ones", "", f"{share:.2f}", "", ""]
        )
    return table


def memory() -> float:
    """The largest resident memory so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MEGABYTE


def _row(name, first, seconds, people, before) -> list[str]:
    median, most = np.median(seconds), np.max(seconds)
    each = f"{median / people:.2f}"
    return [
        name,
        f"{first:.1f}",
        f"{median:.2f} (at most {most:.2f})",
        each,
        f"{memory() - before:.0f}",
    ]


def main(settings: Settings) -> None:
    """Print the table, and record it."""
    rows = measured(settings)
    header = ("", "first call, s", "median, s", "a person, s", "memory over the start, MB")
    table = Table("A fit of 22 joints: 5 px noise, 10 % missing", header, rows)
    table.print()
    if settings.record:
        body = [
            provenance("python -m benchmarks.fit_speed --record"),
            _METHOD.strip(),
            table.markdown(),
        ]
        record_section("fit_speed", "Poses from 2D joints: time and memory", "\n\n".join(body))


_METHOD = """
Embedded body, known shape, pose and translation fitted; the first call compiles. What the penalty
remembers of meshes that it has seen is not used across people. Memory is the largest so far,
compiled programs included.
"""

if __name__ == "__main__":
    main(tyro.cli(Settings))
