"""How far `untangle_pose` frees real poses of collisions: `python -m benchmarks.untangle`.

Whether a pose is free is not for us to say: `oracles.py` lists the edges that pass through
triangles farther than 0.3 m away along the rest surface, before and after.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
import tyro

from benchmarks.common import FIGURES, Table, progress, provenance, record_section
from benchmarks.oracles import FAR, RestGraph, far_crossings
from spt_jax import load_body, load_mocap, untangle_pose
from spt_jax.show import render_strip

FREED, WITHIN = 0.99, 0.015  # the targets: share of frames, and metres of displacement
_PICTURED = 6


@dataclass
class Settings:
    """Which frames are untangled."""

    frames: int = 1086
    """Up to 1,086, which is all of them."""
    seed: int = 0
    processes: int = 2
    record: bool = False
    """Write the tables into results.md, and the failures' picture beside it."""


class Frame(NamedTuple):
    """One frame: far crossings before and after by the oracle, and what it cost."""

    index: int
    name: str
    before: int
    after: int
    volume: float
    left: float
    moved: float
    farthest: float
    steps: int
    seconds: float
    finite: bool
    is_free: bool
    reason: str


@cache
def _world():
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    return body, mocap, faces, RestGraph.of_body(body)


def untangled(index: int) -> tuple[Frame, np.ndarray, np.ndarray]:
    """One frame, and its vertices before and after."""
    body, mocap, faces, graph = _world()
    pose = body.pose_from_smpl(mocap.pose[index])
    vertices = np.asarray(body(pose).vertices, np.float64)
    start = time.perf_counter()
    result = jax.block_until_ready(untangle_pose(body, pose))
    seconds = time.perf_counter() - start
    freed = np.asarray(result.vertices, np.float64)
    moved = np.linalg.norm(freed - vertices, axis=1)
    frame = Frame(
        index=index,
        name=mocap.names[index],
        before=far_crossings(vertices, faces, graph).num_far,
        after=far_crossings(freed, faces, graph).num_far if moved.any() else -1,
        volume=float(result.before.volume),
        left=float(result.after.volume),
        moved=float(moved.mean()),
        farthest=float(moved.max()),
        steps=int(result.steps),
        seconds=seconds,
        finite=bool(np.isfinite(freed).all() and np.isfinite(np.asarray(result.pose)).all()),
        is_free=bool(result.is_free),
        reason=result.reason,
    )
    return frame._replace(after=frame.before if frame.after < 0 else frame.after), vertices, freed


def tables(frames: list[Frame]) -> list[Table]:
    """How many came free, at what price, and those that did not."""
    colliding = [frame for frame in frames if frame.before]
    others = [frame for frame in frames if not frame.before]
    free = [frame for frame in frames if not frame.after]
    failures = sorted((f for f in frames if f.after), key=lambda f: -f.after)
    price = np.array([f[6:10] for f in colliding]) * [1e3, 1e3, 1, 1]
    median = np.median(price[:, 0])
    unmoved = sum(frame.moved == 0 for frame in others)
    counts = Table(
        f"{len(frames)} mocap frames, {len(colliding)} with a crossing farther than {FAR:g} m",
        ("what", "is so", "target"),
        [
            (
                "no crossing that far is left",
                f"{len(free)} of {len(frames)} ({len(free) / len(frames):.2%})",
                f"{FREED:.0%}",
            ),
            (
                "of those that collide",
                f"{len(colliding) - len(failures)} of {len(colliding)}",
                "",
            ),
            (
                "mean vertex displacement of those that collide, median",
                f"{median:.1f} mm",
                f"{WITHIN * 1e3:g} mm",
            ),
            ("the others did not move at all", f"{unmoved} of {len(others)}", "all"),
            (
                "collision-free by its own account, and by ipctk",
                f"{sum(frame.is_free for frame in frames)}, "
                f"{sum(frame.is_free and not frame.after for frame in frames)}",
                "the same",
            ),
            ("a value is not finite", str(sum(not frame.finite for frame in frames)), "0"),
        ],
    )
    names = ("mean vertex displacement, mm", "largest displacement, mm", "steps", "seconds")
    spread = Table(
        "Frames that collide",
        ("figure", "median", "90 %", "99 %", "maximum"),
        [
            (name, *(f"{x:.3g}" for x in np.percentile(values, [50, 90, 99, 100])))
            for name, values in zip(names, price.T, strict=True)
        ],
    )
    listed = Table(
        "Frames that did not come free",
        (
            "frame",
            "far crossings before",
            "after",
            "volume before, cm^3",
            "after",
            "moved, mm",
            "how it ended",
        ),
        [
            (
                f.name,
                str(f.before),
                str(f.after),
                f"{1e6 * f.volume:.1f}",
                f"{1e6 * f.left:.3f}",
                f"{1e3 * f.moved:.1f}",
                f.reason.split(".")[0],
            )
            for f in failures
        ],
    )
    return [counts, spread, listed] if failures else [counts, spread]


def main(settings: Settings) -> None:
    count = len(load_mocap().names)
    chosen = np.random.default_rng(settings.seed).permutation(count)[: settings.frames]
    frames, pictured = [], []
    # Forked processes would inherit JAX's threads without the threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.processes, mp_context=context) as pool, progress() as bar:
        task = bar.add_task("untangling", total=len(chosen))
        for frame, before, after in pool.map(untangled, map(int, chosen)):
            frames.append(frame)
            if frame.after and len(pictured) < _PICTURED:
                pictured.append((frame.name, before, after))
            bar.advance(task)
    parts = tables(frames)
    for table in parts:
        table.print()
    if not settings.record:
        return
    picture = ""
    if pictured:
        render_strip(
            [[before, after] for _, before, after in pictured],
            _world()[2],
            None,
            ["before", "after"],
            row_titles=[name for name, _, _ in pictured],
            path=FIGURES / "untangle_failures.png",
        )
        picture = "![What did not come free, before and after](figures/untangle_failures.png)"
    record_section(
        "untangle",
        "Untangling real poses",
        "\n\n".join(
            [
                provenance(
                    f"python -m benchmarks.untangle --frames {settings.frames} --seed "
                    f"{settings.seed} --processes {settings.processes} --record"
                ),
                "Default settings of `untangle_pose`: collisions go, folds stay. Crossings are "
                "ipctk's, their distance the shortest way along the edges of the rest mesh; each "
                f"of the {settings.processes} processes compiles once, which its first frame pays.",
                *(table.markdown() for table in parts),
                picture,
            ]
        ),
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
