"""Several people in one scene, fitted together."""

import dataclasses
import inspect
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax._exclusions import as_fold_surface
from spt_jax._groups import between_groups, join_bodies, within_groups
from spt_jax._query import as_margin
from spt_jax._report import intersection_report
from spt_jax._result import Result, plain
from spt_jax._status import RESULTS
from spt_jax.body import BodyModel
from spt_jax.fit.inputs import Person
from spt_jax.fit.pose import fit_pose
from spt_jax.fit.programs import program
from spt_jax.fit.result import FitResult, fit_result
from spt_jax.fit.setup import Setup, prepare_fit
from spt_jax.fit.stages import descend
from spt_jax.fit.terms.regularisers import SelfIntersection, as_weights
from spt_jax.overlap.measure import Unmeasurable
from spt_jax.rest.surface import RestSurface

# What is tried where people still intersect: the margin, times this, with the last weight again.
_WIDER = (2.0, 4.0, 8.0)


class Penetration(Result):
    """How deep people are in each other and in themselves, folds of the skin left out.

    Attributes:
        volume_between, volume_within: overlap volumes, in m^3; NaN if a body cannot be measured.
        intersecting_pairs_between, intersecting_pairs_within: numbers of face pairs that intersect;
            -1 if a body cannot be measured.
    """

    volume_between: Float[Array, ""]
    volume_within: Float[Array, ""]
    intersecting_pairs_between: Int[Array, ""]
    intersecting_pairs_within: Int[Array, ""]

    @property
    def is_free(self) -> bool:
        """Whether no faces intersect and no parts overlap, folds left out."""
        pairs = int(self.intersecting_pairs_between), int(self.intersecting_pairs_within)
        return pairs == (0, 0) and float(self.volume_between) + float(self.volume_within) == 0

    def as_dict(self) -> dict[str, Any]:
        """All numbers as JSON types."""
        return {
            "is_free": self.is_free,
            "volume_between": plain(self.volume_between),
            "volume_within": plain(self.volume_within),
            "intersecting_pairs_between": plain(self.intersecting_pairs_between),
            "intersecting_pairs_within": plain(self.intersecting_pairs_within),
        }


class PeopleResult(Result):
    """What `fit_people` found.

    Attributes:
        people: the fits, (N, ...); `terms` are those of each person, without the penalty.
        before: penetration of the people fitted one by one.
        after: of the people fitted together.
        steps: of the solver, over all stages of the scene.
    """

    people: FitResult
    before: Penetration
    after: Penetration
    steps: Int[Array, ""]

    @property
    def status(self) -> RESULTS:
        """How the fit of each person ended."""
        return self.people.status

    @property
    def is_free(self) -> bool:
        """Whether no faces intersect between or within people, folds left out."""
        return self.after.is_free

    def as_dict(self) -> dict[str, Any]:
        """How the fits ended and what is left of the overlap, as JSON types."""
        return {
            "is_free": self.is_free,
            **self.people.as_dict(),
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "steps": plain(self.steps),
        }


def fit_people(
    body: BodyModel,
    keypoints: Any,
    camera: PinholeCamera,
    *,
    layout: Any,
    weights: Any = (0.01, 0.1, 1.0, 10.0, 100.0),
    margin: float = 0.002,
    fold_distance: float | None = None,
    max_steps: int = 25,
    **options: Any,
) -> PeopleResult:
    """People who share a scene, fitted so that they intersect neither each other nor themselves.

    Each is fitted alone by `fit_pose`; then all of their parameters together minimise the sum of
    their objectives and the overlap of the whole scene, between and within people, its weight
    rising. Where faces of two people, or of two parts of one, still intersect, the last weight is
    tried again with two, four and eight times the margin.

    Args:
        body: any `BodyModel`.
        keypoints: pixels, (N, K, 2), or a list of N people.
        camera: the one that sees them all.
        layout: what the keypoints are, as in `fit_pose`.
        weights: of the overlap in cm^3, one for each stage of the scene.
        margin: how far apart surfaces are pushed, in metres.
        fold_distance: how near to each other, along the rest surface and in metres, sheets of one
            body are folds; None: the body's own distances, place by place.
        max_steps: of each stage.
        options: of `fit_pose`, by name: confidence, shape, prior and so on; `regulariser` is what
            each person is fitted with alone.

    Returns:
        PeopleResult. Of all stages it keeps the one with the fewest intersecting pairs between
        people, then within, then the least overlap.

    Raises:
        TypeError, ValueError: as `fit_pose`; keypoints of another shape; an unknown option.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import PinholeCamera, fit_people, load_body
        >>> body = load_body()
        >>> camera = PinholeCamera(1000.0, (500.0, 500.0), translation=(0.0, 0.0, 4.0))
        >>> turned = jnp.zeros((2, 52, 3)).at[:, 0, 0].set(jnp.pi)
        >>> apart = jnp.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
        >>> seen = camera.project(body(turned, translation=apart).joints[:, :22])
        >>> fit = fit_people(body, seen, camera, layout=body.joint_names[:22])
        >>> int(fit.after.intersecting_pairs_between)
        0
    """
    known = inspect.signature(fit_pose).parameters
    for name in options:
        if name not in known or name in ("body", "keypoints", "camera", "layout", "max_steps"):
            raise TypeError(
                f"fit_people() takes the options of fit_pose: got an unexpected {name!r}."
            )
    if isinstance(keypoints, Tracer):
        raise TypeError(
            "keypoints must be known: got a traced array; fit_people decides by the values that "
            "it sees, so call it outside jit, vmap and grad."
        )
    options = {"layout": layout, "max_steps": max_steps, **options}
    alone = fit_pose(body, keypoints, camera, **options)
    if alone.pose.ndim != 3:
        raise ValueError(
            f"keypoints must have shape (N, K, 2), one scene: got {np.shape(keypoints)}; fit "
            "scenes one after another."
        )
    count = len(alone.pose)
    gap = as_margin(margin)
    defaults = {name: p.default for name, p in known.items() if p.default is not p.empty}
    rest = as_fold_surface(body, fold_distance)
    scene = SelfIntersection(weights, margin=jnp.asarray(gap), fold_distance=fold_distance)
    setup, people, _ = prepare_fit(
        body, keypoints, camera, **{**defaults, **options, "regulariser": scene}, in_scene=count
    )
    best, before = alone, _penetration(body, alone, rest)
    after, steps = before, jnp.array(0)
    rising = list(as_weights(weights)[:, None])
    attempts = [(gap, rising)] + [(gap * more, rising[-1:]) for more in _WIDER if gap]
    for attempt, stages in attempts:
        fits = best
        for weight in stages:  # one stage a call: all are one program
            changed = dataclasses.replace(
                setup.regulariser, margin=jnp.asarray(attempt), weights=weight
            )
            fits, taken = _descend_together(
                dataclasses.replace(setup, regulariser=changed), people, fits
            )
            steps = steps + taken
        found = _penetration(body, fits, rest)
        if _rank(found) < _rank(after):
            best, after = fits, found
        if not any(_rank(after)[:2]):
            break
    return PeopleResult(people=best, before=before, after=after, steps=steps)


@program
def _descend_together(
    setup: Setup, people: Person, fits: FitResult
) -> tuple[FitResult, Int[Array, ""]]:
    objectives = jax.vmap(setup.search.objective)(people)
    vectors = jax.vmap(
        lambda one, pose, shape, translation: one.pack(
            one.start._replace(pose=pose, shape=shape, translation=translation)
        )
    )(objectives, fits.pose, fits.shape, fits.translation)
    end = descend(setup.regulariser, setup.body, objectives, vectors, setup.solver, setup.max_steps)

    def each(objective, vector, steps):
        return fit_result(setup.body, objective, vector, {}, end.converged, steps)

    found = jax.vmap(each)(objectives, end.vectors, fits.steps)
    return found, end.steps


def _penetration(body: BodyModel, fits: FitResult, rest: RestSurface) -> Penetration:
    scene = join_bodies(fits.vertices, body.faces)
    count = len(fits.vertices)
    rest = rest if count == 1 else rest.copies(count)
    found = {}
    for name, ignored in (("between", within_groups(count)), ("within", between_groups(count))):
        try:
            report = intersection_report(
                scene.vertices,
                scene.faces,
                face_groups=scene.face_groups,
                ignore_groups=ignored,
                rest_surface=rest,
            )
        except Unmeasurable:
            nothing, none = jnp.asarray(jnp.nan, jnp.float32), jnp.asarray(-1)
            return Penetration(nothing, nothing, none, none)
        found[f"volume_{name}"] = jnp.asarray(report.volume, jnp.float32)
        found[f"intersecting_pairs_{name}"] = jnp.asarray(report.intersecting_pairs)
    return Penetration(**found)


def _rank(found: Penetration) -> tuple[int, int, float]:
    volume = float(found.volume_between) + float(found.volume_within)
    if not np.isfinite(volume):
        return np.iinfo(np.int64).max, 0, np.inf
    return int(found.intersecting_pairs_between), int(found.intersecting_pairs_within), volume
