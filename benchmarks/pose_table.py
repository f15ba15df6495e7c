"""The paper's Table 1 on real motion capture: `python -m benchmarks.pose_table`.

Poses are fitted to 22 projected joints by each method, all from the same starts and with the same
numbers of steps; `pose_scenes.py` says what the scenes are. Once the objective is the paper's, the
keypoints and the regulariser alone, and once it has what `fit_pose` adds by default, a prior (of
the other motions) and joint limits. `--tune` fits other scenes with rising weights; those in
WEIGHTS are the best that it found for each method.
"""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.pose_scenes import JOINTS, Scene, camera, prior_without, stored_scenes
from spt_jax import classify_vertices, fit_pose, load_body
from spt_jax.fit.terms.regularisers import (
    Laplacian,
    Nothing,
    Regulariser,
    SelfIntersection,
    Spheres,
)

TABLE_SCENES = 139  # as many as the paper's reduced test set of UP-3D
RISE = (0.01, 0.1, 1.0)  # of each method's weight, stage by stage
PAPER_RATE = 0.1  # gradient descent in coordinates in which the keypoints' cost is round

# The last weight of each method, keypoints alone and with prior and limits: see --tune.
WEIGHTS = {
    "RE": (0.0, 0.0),
    "RE + LR": (10.0, 0.1),
    "RE + SA": (10.0, 3.0),
    "RE + SPT": (1.0, 10.0),
    "RE + SPT, paper": (1e-2, 1e-2),
}
TRIED = {
    "RE + LR": (0.1, 1.0, 10.0, 100.0),
    "RE + SA": (0.1, 0.3, 1.0, 3.0, 10.0),
    "RE + SPT, paper": (1e-3, 1e-2, 0.1, 1.0),
    "RE + SPT": (0.1, 1.0, 10.0),
}
OBJECTIVES = ("keypoints alone", "prior and limits")
CONDITIONS = ("exact joints", "5 px noise, 10 % missing")


@dataclass
class Settings:
    """What is fitted."""

    tune: bool = False
    """Fit the tuning scenes with several weights in place of the table."""
    frames: int = TABLE_SCENES
    methods: tuple[str, ...] = tuple(WEIGHTS)
    objectives: tuple[str, ...] = OBJECTIVES
    conditions: tuple[str, ...] = CONDITIONS
    timed: int = 10
    """Scenes that are fitted one at a time for the column of seconds."""
    seed: int = 0
    cache: Path | None = None
    """An .npz of what has been fitted already; read where it exists, and written."""
    scenes: Path | None = None
    """An .npz of the scenes; read where it exists, and written."""
    record: bool = False
    """Write the tables into results.md."""


class Outcome(NamedTuple):
    """What a fit came to."""

    error: float  # mean distance of the vertices, pelvis on pelvis, mm
    inside: float  # vertices in self-intersection, per cent
    inside_without_folds: float


@dataclass
class Fitter:
    """The fits of one method under one objective."""

    method: str
    objective: str
    weight: float
    body: object = field(default_factory=load_body)

    def regulariser(self) -> Regulariser:
        """The method's term, its weight rising over the same stages for all."""
        weights = tuple(self.weight * share for share in RISE)
        if self.method == "RE":
            return Nothing(weights)
        if self.method == "RE + LR":
            return Laplacian(weights)
        if self.method == "RE + SA":
            return Spheres(weights)
        if self.method == "RE + SPT":
            return SelfIntersection(weights)
        # Section 4.3: Eqs. 10 and 11, Algorithm 1, one direction, folds and all, gradient descent.
        return SelfIntersection(
            weights,
            folds="count",
            value="ratio",
            gradient="unit",
            rule="triangle",
            rays=512,
            directions=1,
        )

    def __call__(self, some: Sequence[Scene], condition: str):
        """Fit scenes of one motion in one batch."""
        plain = self.objective == OBJECTIVES[0]
        exact = condition == CONDITIONS[0]
        return fit_pose(
            self.body,
            np.stack([scene.exact if exact else scene.noisy for scene in some]),
            camera(),
            joints="smpl",
            confidence=None if exact else np.stack([scene.seen for scene in some]),
            shape=np.stack([scene.shape for scene in some]),
            regulariser=self.regulariser(),
            # Its mean is where the search starts, whatever it weighs.
            prior=prior_without(some[0].motion),
            prior_weight=0.0 if plain else 1.0,
            limits=None if plain else "anatomical",
            upright_weight=0.0 if plain else 0.25,
            solver=optx.GradientDescent(PAPER_RATE, rtol=1e-3, atol=1e-3)
            if self.method.endswith("paper")
            else None,
        )


def fitted(fitter: Fitter, some: Sequence[Scene], condition: str) -> Iterator[tuple[int, Outcome]]:
    """The outcome of each scene with its place in the list, a motion at a time."""
    by_motion = defaultdict(list)
    for place, scene in enumerate(some):
        by_motion[scene.motion].append(place)
    for places in by_motion.values():
        chosen = [some[place] for place in places]
        outcomes = judged(fitter.body, chosen, fitter(chosen, condition))
        yield from zip(places, outcomes, strict=True)


def judged(body, some: Sequence[Scene], result) -> list[Outcome]:
    """What the columns are made of."""
    truth = body(*(jnp.stack([getattr(s, name) for s in some]) for name in ("pose", "shape")))
    away = result.vertices - result.joints[:, :1] - truth.vertices + truth.joints[:, :1]
    error = 1e3 * np.asarray(jnp.linalg.norm(away, axis=-1).mean(axis=-1))
    ratios = [np.asarray(one) for one in _ratios()(result.vertices)]
    return [Outcome(*map(float, row)) for row in zip(error, *ratios, strict=True)]


@cache
def _ratios():
    body = load_body()
    rest = body.rest_surface
    return jax.jit(
        lambda vertices: tuple(
            100 * classify_vertices(vertices, body.faces, folds=folds).ratio
            for folds in (None, rest)
        )
    )


def seconds(fitter: Fitter, some: Sequence[Scene], condition: str) -> float:
    """Median time of a fit of one scene, compiled before."""
    taken = []
    for scene in (some[0], *some):
        start = time.perf_counter()
        jax.block_until_ready(fitter([scene], condition).pose)
        taken.append(time.perf_counter() - start)
    return float(np.median(taken[1:]))


def interval(values: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """The 95 % bootstrap interval of a mean."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, len(values), (10_000, len(values)))
    low, high = np.percentile(values[rows].mean(axis=1), (2.5, 97.5))
    return float(low), float(high)


class Cache:
    """Arrays of outcomes by name, in a file where one is given."""

    def __init__(self, path: Path | None):
        self.path = path
        self.found: dict[str, np.ndarray] = {}
        if path is not None and path.exists():
            with np.load(path) as data:
                self.found = dict(data)

    def add(self, name: str, values: np.ndarray) -> None:
        """Keep an array, and write the file."""
        self.found[name] = values
        if self.path is not None:
            np.savez(self.path, **self.found)


def outcomes_of(fitter: Fitter, some: Sequence[Scene], condition: str, cache: Cache, bar, task):
    """An array of outcomes (scenes, 3), from the cache where it has them."""
    name = "|".join((fitter.method, fitter.objective, condition, f"{fitter.weight:g}"))
    if name not in cache.found or len(cache.found[name]) != len(some):
        rows = np.full((len(some), 3), np.nan)
        for place, outcome in fitted(fitter, some, condition):
            rows[place] = outcome
            bar.advance(task)
        cache.add(name, rows)
    else:
        bar.advance(task, len(some))
    return cache.found[name]


def table_rows(settings: Settings, objective: str, condition: str, some, cache, bar, task):
    """The rows of one block, and those of the paired differences to RE."""
    rows, baseline = [], None
    for method in settings.methods:
        weight = WEIGHTS[method][OBJECTIVES.index(objective)]
        fitter = Fitter(method, objective, weight)
        found = outcomes_of(fitter, some, condition, cache, bar, task)
        name = f"seconds|{method}|{objective}|{condition}"
        if name not in cache.found:
            cache.add(name, np.array(seconds(fitter, some[: settings.timed], condition)))
        baseline = found if method == "RE" else baseline
        row = [method, f"{weight:g}"]
        for column in found.T:
            low, high = interval(column)
            row.append(f"{column.mean():.2f} ({low:.2f} to {high:.2f})")
        if baseline is None or method == "RE":
            row += ["", ""]
        else:
            for column in (0, 2):
                change = found[:, column] - baseline[:, column]
                low, high = interval(change)
                row.append(f"{change.mean():+.2f} ({low:+.2f} to {high:+.2f})")
        rows.append([*row, f"{float(cache.found[name]):.2f}"])
    return rows


HEADER = (
    "method",
    "weight",
    "per-vertex error, mm",
    "in self-intersection, %",
    "without folds, %",
    "error against RE, mm",
    "without folds against RE, %",
    "s a fit",
)


def tables(settings: Settings) -> list[Table]:
    """The table's four blocks."""
    some = stored_scenes(settings.scenes, 0, settings.frames, settings.seed)
    cache = Cache(settings.cache)
    made = []
    blocks = [(o, c) for o in settings.objectives for c in settings.conditions]
    with progress() as bar:
        task = bar.add_task("fits", total=len(blocks) * len(settings.methods) * len(some))
        for objective, condition in blocks:
            rows = table_rows(settings, objective, condition, some, cache, bar, task)
            made.append(Table(f"{objective}; {condition}; {len(some)} scenes", HEADER, rows))
            made[-1].print()
    return made


def tuning(settings: Settings) -> list[Table]:
    """Errors on scenes that the table does not have, by weight."""
    some = stored_scenes(settings.scenes, TABLE_SCENES, settings.frames, settings.seed)
    cache = Cache(settings.cache)
    made = []
    for objective in settings.objectives:
        for condition in settings.conditions:
            rows = []
            with progress() as bar:
                task = bar.add_task("fits", total=None)
                for method in settings.methods:
                    for weight in TRIED.get(method, (0.0,)):
                        fitter = Fitter(method, objective, weight)
                        found = outcomes_of(fitter, some, condition, cache, bar, task)
                        means = [f"{value:.2f}" for value in found.mean(axis=0)]
                        rows.append([method, f"{weight:g}", *means])
            title = f"Tuning: {objective}; {condition}; {len(some)} other scenes"
            made.append(Table(title, HEADER[:5], rows))
            made[-1].print()
    return made


_METHOD = """
Embedded body with random shape coefficients (clipped at 2), a random turn about the vertical, 3 to
5 m from a camera of focal length 1200 pixels; frames of motion capture whose body has no collision
in that shape (folds aside; by the penalty and by ipctk). {joints} joints are given, the shape is
known, pose and translation are fitted. All methods: the same six orientations and flips, then three
stages of at most 20 steps of BFGS with a weight rising to the one shown (RE: the same stages with
none; "paper": gradient descent on the ratio with the unit gradient, 512 x 512 rays, one direction).
Means with 95 % bootstrap intervals; differences are paired. RE + LR: Wang et al. 2018, RE + SA:
Pons-Moll et al. 2015 with spheres fitted to the body. "Without folds":
`classify_vertices(..., folds=body.rest_surface)`. The prior is learned from the other ten motions.
Of the weights that `--tune` tried on 16 other scenes, with noise, each method has the one with the
lowest mean error.
"""


def main(settings: Settings) -> None:
    """Print the tables, and record them."""
    if settings.tune:
        found = tuning(settings)
    else:
        found = tables(settings)
    if settings.record:
        count = len(settings.conditions)
        for k, objective in enumerate(settings.objectives):
            record(settings, objective, found[k * count : (k + 1) * count])


def record(settings: Settings, objective: str, found: Sequence[Table]) -> None:
    """Write one objective's tables into results.md."""
    kind = "pose_tuning" if settings.tune else "pose_table"
    title = "weights" if settings.tune else "the table"
    command = "python -m benchmarks.pose_table" + (" --tune" if settings.tune else "")
    for option, given, usual in (
        ("methods", settings.methods, tuple(WEIGHTS)),
        ("objectives", (objective,), ()),
        ("conditions", settings.conditions, CONDITIONS),
        ("frames", (str(settings.frames),), (str(TABLE_SCENES),)),
    ):
        if tuple(given) != usual:
            command += f" --{option} " + " ".join(f'"{name}"' for name in given)
    body = [provenance(f"{command} --record"), _METHOD.strip().format(joints=JOINTS)]
    record_section(
        f"{kind}_{OBJECTIVES.index(objective)}",
        f"Poses from 2D joints, {title}: {objective}",
        "\n\n".join([*body, *(one.markdown() for one in found)]),
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
