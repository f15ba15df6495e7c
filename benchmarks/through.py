"""Limbs that passed through other parts, freed: `python -m benchmarks.through`.

100 poses (`through_poses.py`): arms through the torso, legs through each other, hands and arms
through the head. `untangle_pose` sees the pose alone. Whether what it finds is free of collisions
is checked by ipctk; whether the limb is on the right side, the one that moves the body least, by
all poses known to be free: what it found, and what a descent finds that starts from the pose from
which the limb came.
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import RestGraph, far_crossings
from benchmarks.through_poses import KINDS, World, made
from spt_jax import untangle_pose
from spt_jax.untangle.descent import SOLVER, Search, descend, displacement_factor, turned

_BATCHES = 10
_WORSE = 1.1  # times the least movement known: still the right side


@dataclass
class Settings:
    """How the poses are shared out."""

    processes: int = 2
    record: bool = False
    """Write the table into results.md."""


class Freed(NamedTuple):
    """One pose: its kind and overlap, how it ended, and movements in mm, root mean square."""

    kind: str
    volume: float
    is_free: bool
    crossings: int
    moved: float
    came_from: float
    steps: int
    seconds: float


@cache
def _world() -> tuple[World, RestGraph]:
    world = World()
    return world, RestGraph.of_body(world.body)


def _rms(world: World, first: np.ndarray, second: np.ndarray) -> float:
    apart = world.vertices(first) - world.vertices(second)
    return 1e3 * float(np.sqrt((apart**2).sum(axis=1).mean()))


def _from_where_it_came(world: World, pose: np.ndarray, free: np.ndarray) -> float:
    """How far the body moves when a descent starts from the free pose; infinite without one."""
    body, given = world.body, jnp.asarray(pose, jnp.float32)
    search = Search(
        rays=None,
        directions=((0.0, 0.0, -1.0),),
        folds="ignore",
        margin=0.002,
        weights=(1.0,),
        steps_per_weight=25,
        tolerance=1e-9,
        solver=SOLVER,
        rest=body.rest_surface,
    )
    factor = displacement_factor(body, given, None)
    turn = (free - pose)[np.asarray(body.free_rows)].ravel() / 0.01
    moved = jnp.asarray(np.asarray(factor, np.float64).T @ turn, jnp.float32)
    least = _rms(world, pose, free)
    for weight in (3.0, 30.0, 100.0):
        fixed = (given, None, None, factor)
        moved, _, _ = descend(search, body, fixed, moved, 0.002, jnp.float32(weight))
        found = np.asarray(turned(body, given, factor, moved))
        if np.isfinite(found).all() and not world.measured(found).intersecting_pairs:
            return min(least, _rms(world, pose, found))
    return least


def freed(seed: int) -> list[Freed]:
    """A tenth of the poses."""
    world, graph = _world()
    rows = []
    for one in made(world, seed, 1 / _BATCHES):
        start = time.process_time()
        result = untangle_pose(world.body, jnp.asarray(one.pose, jnp.float32))
        seconds = time.process_time() - start
        vertices = np.asarray(result.vertices, np.float64)
        rows.append(
            Freed(
                one.kind,
                one.volume,
                bool(result.is_free),
                far_crossings(vertices, world.faces, graph).num_far,
                _rms(world, one.pose, np.asarray(result.pose)),
                _from_where_it_came(world, one.pose, one.free),
                int(result.steps),
                seconds,
            )
        )
    return rows


def table(rows: list[Freed]) -> Table:
    """Of each kind and of all, how many are free and on the right side."""
    lines = []
    for kind in (*KINDS, "all"):
        chosen = [row for row in rows if kind in (row.kind, "all")]
        free = sum(row.is_free and not row.crossings for row in chosen)
        right = sum(row.moved <= _WORSE * row.came_from and row.is_free for row in chosen)
        lines.append(
            (
                kind,
                str(len(chosen)),
                f"{np.median([row.volume for row in chosen]):.0f}",
                f"{free} ({free / len(chosen):.0%})",
                f"{right} ({right / len(chosen):.0%})",
                f"{np.median([row.moved for row in chosen]):.0f}",
                f"{np.median([row.came_from for row in chosen]):.0f}",
                f"{np.median([row.steps for row in chosen]):.0f}",
                f"{np.median([row.seconds for row in chosen]):.1f}",
            )
        )
    header = (
        "what passed through what",
        "poses",
        "overlap, cm^3",
        "free, target 95 %",
        "right side, target 90 %",
        "moved, mm",
        "the way it came, mm",
        "steps",
        "seconds of a core",
    )
    return Table(f"{len(rows)} poses in which a limb is halfway through", header, lines)


def main(settings: Settings) -> None:
    """Free them all, print, record."""
    rows: list[Freed] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.processes, mp_context=context) as pool, progress() as bar:
        task = bar.add_task("freeing", total=_BATCHES)
        for found in pool.map(freed, range(_BATCHES)):
            rows += found
            bar.advance(task)
    found = table(rows)
    found.print()
    if settings.record:
        command = f"python -m benchmarks.through --processes {settings.processes} --record"
        body = f"{provenance(command)} Movements and figures are medians.\n\n{found.markdown()}"
        record_section("through", "Limbs that passed through", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
