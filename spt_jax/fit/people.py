"""Several people in one scene, fitted together."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax._exclusions import as_fold_surface
from spt_jax._groups import between_groups, join_bodies, within_groups
from spt_jax._report import intersection_report
from spt_jax._result import Result, plain
from spt_jax._status import RESULTS
from spt_jax._steps import OnStep, Step
from spt_jax.body import BodyModel
from spt_jax.bridge.programs import program
from spt_jax.fit.contact.cuts import Cuts
from spt_jax.fit.contact.descent import descend as descend_by_cuts
from spt_jax.fit.contact.places import Ground
from spt_jax.fit.options import Numbers, Scene, Search, Stages, Start, Terms
from spt_jax.fit.pose import finished, fit_each, has_cuts, objective_of
from spt_jax.fit.problem.inputs import Keypoints, Person
from spt_jax.fit.regularizers._base import Regularizer
from spt_jax.fit.regularizers.spt import SelfIntersection
from spt_jax.fit.result import FitResult, fit_result
from spt_jax.fit.setup import Setup, prepare_fit
from spt_jax.fit.solver import default_solver
from spt_jax.fit.stages import descend
from spt_jax.keypoints import AnyLayout
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
    keypoints: Keypoints,
    camera: PinholeCamera,
    *,
    layout: AnyLayout | None = None,
    confidence: Numbers | None = None,
    start: Start = Start(),
    terms: Terms = Terms(),
    regularizer: str | Regularizer = "spt",
    search: Search = Search(),
    stages: Stages = Stages(),
    scene: Scene = Scene(),
    on_step: OnStep | None = None,
) -> PeopleResult:
    """People who share a scene, fitted so that they intersect neither each other nor themselves.

    Each is fitted alone by `fit_pose`; then all of their parameters together minimise the sum of
    their objectives and the overlap of the whole scene, between and within people, its weight
    rising; by the search on the host that `fit_pose` has, unless `scene` has a solver. Where faces
    of two people, or of two parts of one, still intersect, the last weight is tried again with two,
    four and eight times the margin.

    Args:
        body: any `BodyModel`.
        keypoints: pixels, (N, K, 2), a list of N people, or people of `read_keypoints`.
        camera: the one that sees them all.
        layout, confidence, start, terms, search: as in `fit_pose`.
        regularizer, stages: of the fits of each person alone, as in `fit_pose`.
        scene: weights, margin and solver of the fit of all people together.
        on_step: called with a `spt_jax.Step` of all bodies, one after another in its vertices,
            once each of them was fitted alone, stage 0, and after each stage of the scene; what it
            raises ends the fit.

    Returns:
        PeopleResult. Of all stages it keeps the one with the fewest intersecting pairs between
        people, then within, then the least overlap.

    Raises:
        TypeError, ValueError: as `fit_pose`; keypoints of another shape, or traced.

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
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(keypoints)):
        raise TypeError(
            "keypoints must be known: got a traced array; fit_people decides by the values that "
            "it sees, so call it outside jit, vmap and grad."
        )
    if not isinstance(scene, Scene):
        raise TypeError(f"scene must be a spt_jax.fit.Scene: got {type(scene).__name__}.")
    given = partial(
        prepare_fit,
        body,
        keypoints,
        camera,
        layout=layout,
        confidence=confidence,
        start=start,
        terms=terms,
        search=search,
    )
    single, people, batch = given(regularizer=regularizer, stages=stages)
    if len(batch) != 1:
        raise ValueError(
            f"keypoints must have shape (N, K, 2), one scene: got a batch of {batch}; fit scenes "
            "one after another."
        )
    alone = fit_each(single, people)
    together = SelfIntersection(
        scene.weights, margin=jnp.asarray(scene.margin), fold_distance=scene.fold_distance
    )
    descent = Stages(scene.solver, scene.max_steps)
    setup, people, _ = given(regularizer=together, stages=descent, in_scene=batch[0])
    return _settle(setup, people, alone, scene, on_step)


def _settle(
    setup: Setup, people: Person, alone: FitResult, scene: Scene, on_step: OnStep | None
) -> PeopleResult:
    """Descend stage by stage, with a wider margin where people still intersect."""
    rest = as_fold_surface(setup.body, scene.fold_distance)
    best, before = alone, _penetration(setup.body, alone.vertices, rest)
    after, steps, count = before, jnp.array(0), 0
    _tell(on_step, setup.body, rest, count, 0, best)
    rising = list(setup.regularizer.weights[:, None])
    on_host = _OnHost(setup, people) if has_cuts(setup) else None
    gap = scene.margin
    attempts = [(gap, rising)] + [(gap * more, rising[-1:]) for more in _WIDER if gap]
    for attempt, stages in attempts:
        fits = best
        for weight in stages:  # one stage a call: all are one program
            if on_host is not None:
                fits, taken = on_host.stage(fits, float(weight[0]), attempt)
            else:
                changed = dataclasses.replace(
                    setup.regularizer, margin=jnp.asarray(attempt), weights=weight
                )
                fits, taken = _descend_together(
                    dataclasses.replace(setup, regularizer=changed), people, fits
                )
            steps, count = steps + taken, count + 1
            _tell(on_step, setup.body, rest, count, int(steps), fits)
        found = _penetration(setup.body, fits.vertices, rest)
        if _rank(found) < _rank(after):
            best, after = fits, found
        if not any(_rank(after)[:2]):
            break
    return PeopleResult(people=best, before=before, after=after, steps=steps)


def _tell(
    on_step: OnStep | None, body: BodyModel, rest: RestSurface, stage: int, taken: int, fits
) -> None:
    if on_step is None:
        return

    def volume_and_pairs() -> tuple[float, int]:
        found = _penetration(body, fits.vertices, rest)
        volume = float(found.volume_between) + float(found.volume_within)
        if not np.isfinite(volume):
            return volume, -1
        return volume, int(found.intersecting_pairs_between + found.intersecting_pairs_within)

    vertices = np.asarray(fits.vertices).reshape(-1, 3)
    on_step(Step(stage, taken, vertices, None, volume_and_pairs))


class _OnHost:
    """Stages of a scene by the search on the host."""

    def __init__(self, setup: Setup, people: Person):
        assert isinstance(setup.regularizer, SelfIntersection)
        self._setup = setup
        count = len(people.keypoints)
        self._people = [jax.tree.map(lambda leaf, k=k: leaf[k], people) for k in range(count)]
        objectives = [objective_of(setup.search, one) for one in self._people]
        self._ground = Ground(setup.body, objectives, setup.regularizer)
        # What is known of the overlap holds for one margin.
        self._margin, self._cuts = np.nan, Cuts(count, 0)

    def stage(
        self, fits: FitResult, weight: float, margin: float
    ) -> tuple[FitResult, Int[np.ndarray, ""]]:
        """The fits after a stage, and how many places were measured; as they are if none can be."""
        ground, setup = self._ground, self._setup
        rows = [
            one.pack(one.start._replace(pose=p, shape=s, translation=t))
            for one, p, s, t in zip(
                ground.people, fits.pose, fits.shape, fits.translation, strict=True
            )
        ]
        vector = np.stack([np.asarray(row, np.float64) for row in rows])
        if margin != self._margin:
            self._margin, self._cuts = margin, Cuts(*vector.shape)
        before, place = ground.looks, ground.look(vector, margin)
        if place is None:
            return fits, np.array(0)
        end = descend_by_cuts(ground.look, place, self._cuts, weight, margin, setup.max_steps)
        each = [
            finished(
                setup.search,
                setup.body,
                person,
                jnp.asarray(row, ground.dtype),
                {},
                jnp.asarray(end.converged),
                steps,
                jnp.asarray(True),
            )
            for person, row, steps in zip(self._people, end.place.vector, fits.steps, strict=True)
        ]
        found = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
        return found, np.array(ground.looks - before)


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
    solver = setup.solver or default_solver()
    end = descend(setup.regularizer, setup.body, objectives, vectors, solver, setup.max_steps)

    def each(objective, vector, steps):
        return fit_result(setup.body, objective, vector, {}, end.converged, steps)

    found = jax.vmap(each)(objectives, end.vectors, fits.steps)
    return found, end.steps


def _penetration(
    body: BodyModel, vertices: Float[Array, "N V 3"], rest: RestSurface
) -> Penetration:
    scene = join_bodies(vertices, body.faces)
    count = len(vertices)
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
