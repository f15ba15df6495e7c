"""Second-order searches in `untangle_pose`'s place: `python -m benchmarks.newton`.

The same frames, objective, weights and end (a step that gains less than 3 %, or a pose without
collisions) for the contact solver and for SciPy's methods that take products with the Hessian,
which `second_order=True` gives. The margin is left out of the product's price: the surface is the
body's own.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.optimize import minimize

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import config, load_body, load_mocap, self_intersection_penalty
from spt_jax.untangle.descent import (
    CENTIMETRE,
    SOLVER,
    Search,
    displacement_factor,
    is_near,
    turned,
    vertices_of,
)
from spt_jax.untangle.pose import _WEIGHTS

_RTOL, _STEPS = 0.03, 25
# By SciPy's names; BFGS takes no product.
_METHODS = ("BFGS", "Newton-CG", "trust-ncg", "trust-krylov")


@dataclass
class Settings:
    """How many frames collide."""

    frames: int = 60
    seed: int = 0
    margin: float = 0.002
    record: bool = False
    """Write the table into results.md."""


class Found(NamedTuple):
    """One frame by one method."""

    evaluations: int
    products: int
    seconds: float
    moved: float
    is_free: bool


class World:
    """The body, and the functions of a search's variables, compiled once."""

    def __init__(self, margin: float):
        self.body, self.mocap, self.margin = load_body(), load_mocap(), margin
        self.faces = np.asarray(self.body.faces, np.int64)
        self.search = Search(
            rays=None,
            directions=((0.0, 0.0, -1.0),),
            folds="ignore",
            margin=margin,
            weights=_WEIGHTS,
            steps_per_weight=_STEPS,
            tolerance=1e-9,
            solver=SOLVER,
            rest=self.body.rest_surface,
        )
        self.value = jax.jit(jax.value_and_grad(self.objective))
        gradient = jax.grad(self.objective)
        self.product = jax.jit(
            lambda y, v, *rest: jax.jvp(lambda at: gradient(at, *rest), (y,), (v,))[1]
        )
        self.step = jax.jit(self._step)

    def objective(self, moved, pose, factor, weight):
        """`untangle_pose`'s, with second derivatives."""
        at = turned(self.body, pose, factor, moved)
        volume = self_intersection_penalty(
            self.body(at).vertices,
            self.faces,
            margin=self.margin,
            rest_surface=self.search.rest,
            second_order=True,
        )
        return jnp.sum(moved**2) + weight * volume / CENTIMETRE**3

    def _step(self, moved, state, pose, factor, weight):
        """One of the contact solver, and whether it ends there."""
        fn = partial(lambda y, args: (self.objective(y, *args), None))
        args = (pose, factor, weight)
        moved, state, _ = SOLVER.step(fn, moved, args, {}, state, frozenset())
        return moved, state, SOLVER.terminate(fn, moved, args, {}, state, frozenset())[0]


def by_contact_solver(world: World, moved, *args) -> tuple[Any, int, int]:
    """One weight: where it ended, evaluations, products."""
    shape = jax.ShapeDtypeStruct((), moved.dtype)
    fn = partial(lambda y, args: (world.objective(y, *args), None))
    state = SOLVER.init(fn, moved, args, {}, shape, None, frozenset())
    for _ in range(_STEPS):
        moved, state, done = world.step(moved, state, *args)
        if done:
            break
    return moved, int(state.steps), 0


def by_scipy(method: str, world: World, moved, *args) -> tuple[Any, int, int]:
    """One weight: where it ended, evaluations, products."""
    count = np.zeros(2, int)
    last = [np.inf]

    def value(y):
        count[0] += 1
        found, slope = world.value(jnp.asarray(y, moved.dtype), *args)
        return float(found), np.asarray(slope, np.float64)

    def product(y, v):
        count[1] += 1
        typed = (jnp.asarray(x, moved.dtype) for x in (y, v))
        return np.asarray(world.product(*typed, *args), np.float64)

    def ends(intermediate_result):
        if last[0] - intermediate_result.fun < _RTOL * intermediate_result.fun:
            raise StopIteration
        last[0] = intermediate_result.fun

    found = minimize(
        value,
        np.asarray(moved, np.float64),
        jac=True,
        hessp=None if method == "BFGS" else product,
        method=method,
        callback=ends,
        options={"maxiter": _STEPS},
    )
    return jnp.asarray(found.x, moved.dtype), int(count[0]), int(count[1])


def freed(world: World, index: int, solve: Callable) -> Found:
    """One frame, by rising weights until nothing collides."""
    body, search = world.body, world.search
    pose = body.pose_from_smpl(jnp.asarray(world.mocap.pose[index]))
    factor = displacement_factor(body, pose, None)
    given = np.asarray(vertices_of(body, pose, None, None))
    moved = jnp.zeros(factor.shape[:1], pose.dtype)
    evaluations = products = 0
    start = time.process_time()
    there, is_free = given, False
    for weight in _WEIGHTS:
        at, more, curved = solve(world, moved, pose, factor, jnp.asarray(weight, pose.dtype))
        evaluations, products = evaluations + more, products + curved
        candidate = turned(body, pose, factor, at)
        if not np.isfinite(np.asarray(candidate)).all() or not is_near(candidate, pose):
            continue
        moved = at
        there = np.asarray(vertices_of(body, candidate, None, None))
        is_free = search.is_free(search.measure(there, world.faces))
        if is_free:
            break
    seconds = time.process_time() - start
    away = 1e3 * float(np.linalg.norm(there - given, axis=1).mean())
    return Found(evaluations, products, seconds, away, is_free)


def _colliding(world: World, settings: Settings) -> list[int]:
    found = []
    for index in np.random.default_rng(settings.seed).permutation(len(world.mocap.names)):
        pose = world.body.pose_from_smpl(jnp.asarray(world.mocap.pose[index]))
        vertices = np.asarray(vertices_of(world.body, pose, None, None))
        if not world.search.is_free(world.search.measure(vertices, world.faces)):
            found.append(int(index))
        if len(found) == settings.frames:
            break
    return found


def table(rows: dict[str, list[Found]]) -> Table:
    """Medians, and how many are free."""
    lines = []
    for name, found in rows.items():
        of = np.array(found, float)
        lines.append(
            (
                name,
                f"{int(of[:, 4].sum())} of {len(of)}",
                f"{np.median(of[:, 0]):.0f}",
                f"{np.percentile(of[:, 0], 90):.0f}",
                f"{np.median(of[:, 1]):.0f}",
                f"{np.median(of[:, 2]):.2f}",
                f"{np.median(of[:, 3]):.1f}",
                f"{np.percentile(of[:, 3], 90):.1f}",
            )
        )
    header = (
        "search",
        "free",
        "evaluations, median",
        "90 %",
        "products, median",
        "seconds of a core, median",
        "moved, mm, median",
        "90 %",
    )
    count = len(next(iter(rows.values())))
    return Table(f"{count} frames that collide, margin and weights of untangle_pose", header, lines)


def main(settings: Settings) -> None:
    """Search, count, print."""
    config.processes = 1
    world = World(settings.margin)
    indices = _colliding(world, settings)
    ways: dict[str, Callable] = {"contact solver (untangle_pose's)": by_contact_solver}
    ways |= {f"SciPy's {method}": partial(by_scipy, method) for method in _METHODS}
    rows: dict[str, list[Found]] = {name: [] for name in ways}
    for solve in ways.values():
        freed(world, indices[0], solve)  # compiled
    with progress() as bar:
        task = bar.add_task("searching", total=len(indices))
        for index in indices:
            for name, solve in ways.items():
                rows[name].append(freed(world, index, solve))
            bar.advance(task)
    found = table(rows)
    found.print()
    if settings.record:
        command = f"python -m benchmarks.newton --frames {settings.frames} --record"
        body = (
            f"{provenance(command)} Processor time, the searches turn about on each frame; an "
            "evaluation is a value with its gradient, a product one of the Hessian with a vector."
        )
        record_section("newton", "Second-order searches", f"{body}\n\n{found.markdown()}")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
