"""The methods of `benchmarks.pose_table`, with their weights, and what a fit comes to."""

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from benchmarks.pose_scenes import Scene, camera, prior_without
from spt_jax import BodyModel, classify_vertices, fit_pose, intersection_report, load_body
from spt_jax.fit import (
    Laplacian,
    Nothing,
    Regularizer,
    SelfIntersection,
    Spheres,
    Stages,
    Start,
    Terms,
)

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


class Outcome(NamedTuple):
    """What a fit came to."""

    error: float  # mean distance of the vertices, pelvis on pelvis, mm
    inside: float  # vertices in self-intersection, per cent
    inside_without_folds: float
    off: float  # mean distance of the seen keypoints in the image, pixels
    free: float  # 1 if no faces intersect, folds left out
    converged: float


@dataclass
class Fitter:
    """The fits of one method under one objective."""

    method: str
    objective: str
    weight: float
    body: BodyModel = field(default_factory=load_body)

    def regularizer(self) -> Regularizer:
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
            layout="smpl",
            confidence=None if exact else np.stack([scene.seen for scene in some]),
            start=Start(shape=np.stack([scene.shape for scene in some])),
            terms=Terms(
                # Its mean is where the search starts, whatever it weighs.
                prior=prior_without(some[0].motion),
                prior_weight=0.0 if plain else 1.0,
                limits=None if plain else "anatomical",
                upright_weight=0.0 if plain else 0.25,
            ),
            regularizer=self.regularizer(),
            stages=Stages(
                optx.GradientDescent(PAPER_RATE, rtol=1e-3, atol=1e-3)
                if self.method.endswith("paper")
                else None
            ),
        )


def fitted(fitter: Fitter, some: Sequence[Scene], condition: str) -> Iterator[tuple[int, Outcome]]:
    """The outcome of each scene with its place in the list, a motion at a time."""
    by_motion = defaultdict(list)
    for place, scene in enumerate(some):
        by_motion[scene.motion].append(place)
    for places in by_motion.values():
        chosen = [some[place] for place in places]
        outcomes = judged(fitter.body, chosen, condition, fitter(chosen, condition))
        yield from zip(places, outcomes, strict=True)


_FAR = 1e3  # metres


def judged(body, some: Sequence[Scene], condition: str, result) -> list[Outcome]:
    """What the columns are made of."""
    truth = body(*(jnp.stack([getattr(s, name) for s in some]) for name in ("pose", "shape")))
    away = result.vertices - result.joints[:, :1] - truth.vertices + truth.joints[:, :1]
    error = 1e3 * np.asarray(jnp.linalg.norm(away, axis=-1).mean(axis=-1))
    # A fit without a penalty may end kilometers away, where float32 holds no surface; what a body
    # does to itself does not depend on where it stands.
    far = jnp.abs(result.vertices).max(axis=(1, 2), keepdims=True) > _FAR
    vertices = jnp.where(far, body(result.pose, result.shape).vertices, result.vertices)
    ratios = [np.asarray(one) for one in _ratios()(vertices)]
    exact = condition == CONDITIONS[0]
    off = [
        np.linalg.norm(np.asarray(found) - (s.exact if exact else s.noisy), axis=-1)
        for s, found in zip(some, result.keypoints, strict=True)
    ]
    off = [
        one.mean() if exact else one[s.seen > 0].mean() for s, one in zip(some, off, strict=True)
    ]
    pairs = [
        intersection_report(one, body.faces, rest_surface=body.rest_surface).intersecting_pairs
        for one in vertices
    ]
    columns = (error, *ratios, off, np.array(pairs) == 0, np.asarray(result.converged))
    return [Outcome(*map(float, row)) for row in zip(*columns, strict=True)]


@cache
def _ratios():
    body = load_body()
    rest = body.rest_surface
    return jax.jit(
        lambda vertices: tuple(
            100 * classify_vertices(vertices, body.faces, rest_surface=surface).ratio
            for surface in (None, rest)
        )
    )


def seconds(fitter: Fitter, some: Sequence[Scene], condition: str) -> float:
    """Median processor time of a fit of one scene, compiled before."""
    taken = []
    for scene in (some[0], *some):
        start = time.process_time()
        jax.block_until_ready(fitter([scene], condition).pose)
        taken.append(time.process_time() - start)
    return float(np.median(taken[1:]))
