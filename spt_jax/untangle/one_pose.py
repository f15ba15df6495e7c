"""The search that frees one pose, weight after weight, and what it found.

`pose.py` has the function that users call: it checks what is asked and stacks the results of a
batch. `descent.py` has the solver's own loop, `sides.py` the way out where a limb has passed
through.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax._result import Overlap, Result, plain
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax._steps import OnStep
from spt_jax.body import AbstractBody
from spt_jax.overlap.measure import Measurement, Sampling, Unmeasurable
from spt_jax.rest.surface import RestSurface
from spt_jax.untangle.contacts import held_contacts
from spt_jax.untangle.descent import (
    Search,
    descend,
    descend_in_steps,
    displacement_factor,
    faces_of,
    is_near,
    pose_of,
    vertices_of,
)
from spt_jax.untangle.mesh import untangle_checked
from spt_jax.untangle.sides import other_side
from spt_jax.untangle.spread import Surface

# Below this a weight may be too weak to move anything.
_STRONG = 10.0


class UntangleResult(Result):
    """What `untangle_pose` found.

    Attributes:
        pose: the best pose of all that were measured.
        vertices: the body in that pose, in metres; with folds="remove" its vertices were moved on.
        before, after: the overlap of the pose given and of what was found.
        steps: of the solver, over all weights.
        status: how it ended, one of `spt_jax.RESULTS` for each pose.
    """

    pose: Float[Array, "..."]
    vertices: Float[Array, "*batch V 3"]
    before: Overlap
    after: Overlap
    steps: Int[Array, "*batch"]
    status: RESULTS

    @property
    def is_free(self) -> Bool[Array, "*batch"]:
        """Whether no parts collide any more; with folds="remove", whether no faces intersect."""
        return self.status == RESULTS.successful

    @property
    def reason(self) -> Any:
        """The status in words: a string, or nested lists of strings over the batch axes."""
        return in_words(self.status, {"successful": "collision-free"})

    def as_dict(self) -> dict[str, Any]:
        """All but pose and vertices, as JSON types."""
        return {
            "is_free": plain(self.is_free),
            "status": names_of(self.status),
            "reason": self.reason,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "steps": plain(self.steps),
        }


class WantedContacts(NamedTuple):
    """What contact is to be kept."""

    contacts: Any
    distance: float
    weight: float
    rest: RestSurface | None


def untangle_one(
    search: Search,
    surface: Surface | None,
    body: AbstractBody,
    pose: Array,
    shape: Array | None,
    translation: Array | None,
    wanted: WantedContacts,
    on_step: OnStep | None,
) -> UntangleResult:
    """Free one pose; all that is asked has been checked."""
    vertices, faces = vertices_of(body, pose, shape, translation), faces_of(body)
    before = search.measure(vertices, faces)
    best, after, steps = pose, before, 0
    ended, diverged = RESULTS.successful, False
    if not search.is_free(before):
        if wanted.contacts is not None:
            held = held_contacts(body, before.vertices, *wanted, dtype=pose.dtype)
            search = replace(search, contacts=held)
        factor = displacement_factor(body, pose, shape)
        moved = jnp.asarray(np.zeros(factor.shape[:1], pose.dtype))
        idle = 0
        for stage, (margin, weight) in enumerate(search.attempts()):
            arguments = (
                search,
                body,
                (pose, shape, translation, factor),
                moved,
                margin,
                jnp.asarray(weight, pose.dtype),
            )
            if on_step is None:
                there, taken, ended = descend(*arguments)
            else:
                there, taken, ended = descend_in_steps(*arguments, stage, steps, on_step)
            steps += int(taken)
            candidate = pose_of(body, pose, factor, there)
            found = _measured(search, body, pose, candidate, shape, translation)
            if found is None:
                diverged = True
                continue
            moved, (posed, overlap) = there, found
            falls = overlap.volume < 0.99 * after.volume
            idle = 0 if falls else idle + 1
            if search.rank(overlap) < search.rank(after):
                best, after, vertices = candidate, overlap, posed
            # Two in a row that gain nothing mean that the volume no longer falls.
            stuck = search.folds == "count" and idle >= 2 and weight >= _STRONG
            if search.is_free(after) or stuck:
                break
        side = other_side(search, body, (pose, shape, translation, factor), before, after)
        if side is not None:
            best, after, vertices = side.pose, side.found, side.vertices
            steps, diverged = steps + side.steps, False
    free = search.is_free(after)
    if surface is not None and after.total_intersecting_pairs:
        sampling = Sampling(None, search.directions)
        skin = untangle_checked(np.asarray(vertices), surface, sampling)
        if skin.moved:
            vertices = jnp.asarray(skin.vertices)
            after = search.measure(vertices, faces)
        free, ended = skin.is_free, skin.status
    return UntangleResult(
        pose=best,
        vertices=vertices,
        before=_overlap(before, pose.dtype),
        after=_overlap(after, pose.dtype),
        steps=jnp.asarray(steps),
        status=_status(free, diverged, ended),
    )


def _measured(search: Search, body, pose, candidate, shape, translation):
    """The vertices and the overlap of a pose, or None where it has run away."""
    if not is_near(candidate, pose):
        return None
    posed = vertices_of(body, candidate, shape, translation)
    try:
        return posed, search.measure(posed, faces_of(body))
    except Unmeasurable:
        return None


def _overlap(found: Measurement, dtype: Any) -> Overlap:
    return Overlap(
        volume=jnp.asarray(found.volume, dtype),
        total_volume=jnp.asarray(found.total_volume, dtype),
        ratio=jnp.asarray(np.mean(found.labels("vertex") != 0), dtype),
        intersecting_pairs=jnp.asarray(found.intersecting_pairs, jnp.int32),
        total_intersecting_pairs=jnp.asarray(found.total_intersecting_pairs, jnp.int32),
    )


def _status(free: bool, diverged: bool, ended: Any) -> Any:
    if free:
        return RESULTS.successful
    if diverged:
        return RESULTS.nonlinear_divergence
    if ended == RESULTS.successful:
        return RESULTS.intersections_left
    return ended
