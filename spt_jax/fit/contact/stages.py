"""The stages of a fit with the penalty: the weight rises, then the search goes on until it is free.

What the last weight leaves is a graze, as deep as the keypoints pull: a hundredth of a cubic
centimetre. So the search goes on with more weight, and with the surface moved outwards by more and
more, until no parts intersect any more. Where that finds no way out, other minima of the keypoints'
objective are taken, and limbs are swung to sides on which nothing collides.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body.swings import free_starts, limbs_in_collision
from spt_jax.fit.contact.cuts import Cuts
from spt_jax.fit.contact.descent import Ended, descend
from spt_jax.fit.contact.places import Ground, Place
from spt_jax.fit.problem.variables import Variables
from spt_jax.overlap.measure import Measurement, Unmeasurable

# What is tried, one after the other, until nothing intersects: the least margin, times this, and
# the last weight times this; and the places that are measured at most for each.
_ATTEMPTS = ((1.0, 10.0), (1.0, 100.0), (2.0, 100.0), (4.0, 100.0))
_MARGIN = 0.001  # metres
_LOOKS = 12

# The last stage goes on for so many times as long, where it has something left to gain.
_LAST = 3

# Of two that go through the stages, one whose total is so many times the other's is given up.
_HOPELESS = 3.0

# A volume that is none where nothing intersects, in m^3.
_TOLERANCE = 1e-9

_SWINGS = 3  # limbs' other places that are tried


class Tried(NamedTuple):
    """A place that stages or attempts came to.

    Attributes:
        place: measured with the term's own margin.
        converged: whether the descent that ended there had nothing left to gain.
        pairs: of included faces that intersect; a very large number if that cannot be measured.
        volume: of the overlap, in m^3.
    """

    place: Place
    converged: bool
    pairs: int
    volume: float

    @property
    def is_free(self) -> bool:
        """Whether no parts intersect."""
        return self.pairs == 0 and self.volume <= _TOLERANCE


#: Called after each stage with its number and the place.
OnStage = Callable[[int, Place], None]


class Stages:
    """The stages of people who are fitted together.

    Args:
        ground: of the people.
        weights: of the overlap, rising.
        margin: how far apart parts are pushed, in metres.
        most: places that are measured at most in each stage.
        on_stage: called after each.
    """

    def __init__(
        self,
        ground: Ground,
        weights: Float[np.ndarray, "stages"],
        margin: float,
        most: int,
        on_stage: OnStage,
    ):
        self.ground, self.margin, self.most = ground, margin, most
        self.weights = weights.tolist()
        self.on_stage = on_stage

    def quietly(self) -> "Stages":
        """The same without the callback."""
        return Stages(self.ground, np.array(self.weights), self.margin, self.most, lambda *_: None)

    @property
    def last(self) -> float:
        """The last weight."""
        return self.weights[-1]

    def look(self, vector: Float[np.ndarray, "N D"]) -> Place | None:
        """A place with the term's own margin."""
        return self.ground.look(vector, self.margin)

    def rank(self, tried: Tried) -> tuple[bool, int, float]:
        """Sorts places, the best first: free ones by what they cost."""
        if tried.is_free:
            return False, 0, tried.place.total(self.last)
        return True, tried.pairs, tried.volume

    def tried(self, place: Place, *, converged: bool) -> Tried:
        """A place with what intersects there."""
        found = self.ground.measure(place.vertices)
        if found is None:
            return Tried(place, False, np.iinfo(np.int64).max, np.inf)
        return Tried(place, converged, found.intersecting_pairs, found.volume)

    def through(self, places: list[Place]) -> list[Tried]:
        """Descend from each of some places, stage by stage; those of the lowest total first."""
        ends = [Ended(place, False) for place in places]
        cuts = [Cuts(*place.vector.shape) for place in places]
        for number, weight in enumerate(self.weights):
            most = _LAST * self.most if number + 1 == len(self.weights) else self.most
            ends = [
                descend(self.ground.look, one.place, known, weight, self.margin, most)
                for one, known in zip(ends, cuts, strict=True)
            ]
            totals = [one.place.total(weight) for one in ends]
            least = min(totals)
            self.on_stage(number + 1, ends[totals.index(least)].place)
            kept = [k for k, total in enumerate(totals) if total <= _HOPELESS * least + 1]
            ends, cuts = [ends[k] for k in kept], [cuts[k] for k in kept]
        ends.sort(key=lambda one: one.place.total(self.last))
        return [self.tried(one.place, converged=one.converged) for one in ends]

    def freed(self, begin: Tried) -> Tried:
        """The search from where the stages ended, until nothing intersects, as far as it goes."""
        best, vector = begin, begin.place.vector
        cuts = Cuts(*vector.shape)
        for more, heavier in _ATTEMPTS:
            margin, weight = self.margin + more * _MARGIN, heavier * self.last
            place = self.ground.look(vector, margin)
            if place is None:
                return best
            ended = descend(self.ground.look, place, cuts, weight, margin, _LOOKS)
            vector = ended.place.vector
            best = self.better(best, vector, converged=ended.converged)
            if best.is_free:
                return best
        return best

    def better(self, best: Tried, vector: Float[np.ndarray, "N D"], *, converged: bool) -> Tried:
        """The best one so far, or a place where that ranks before it."""
        place = self.look(vector)
        if place is None:
            return best
        return min(best, self.tried(place, converged=converged), key=self.rank)

    def from_other_sides(self, best: Tried) -> Tried:
        """The search from places of limbs on which nothing collides, of one person alone."""
        found = self.ground.measure(best.place.vertices)
        if len(best.place.vector) > 1 or found is None:
            return best
        for vector in self._swung(best.place, found):
            best = self.better(best, vector, converged=False)
            place = self.look(vector)
            if place is None:
                continue
            # Too strong to let the limb pass through once more.
            cuts = Cuts(*vector.shape)
            ended = descend(self.ground.look, place, cuts, 10 * self.last, self.margin, _LOOKS)
            there = self.tried(ended.place, converged=ended.converged)
            if not there.is_free:
                there = self.freed(there)
            best = min(best, there, key=self.rank)
        return best

    def _swung(self, place: Place, found: Measurement) -> Iterator[Float[np.ndarray, "1 D"]]:
        ground, body = self.ground, self.ground.body
        objective = ground.people[0]
        now = objective.unpack(jnp.asarray(place.vector[0], ground.dtype))
        given = np.array(now.pose, np.float64)

        def vector(pose: np.ndarray) -> Float[np.ndarray, "1 D"]:
            moved = Variables(jnp.asarray(pose, ground.dtype), now.shape, now.translation)
            return np.asarray(objective.pack(moved), np.float64)[None]

        def look(pose):
            seen = ground.vertices(vector(pose))
            there = ground.measure(seen)
            if there is None:
                raise Unmeasurable("the swung body has no surface that could be measured")
            return there.intersecting_pairs == 0 and there.volume <= _TOLERANCE, seen

        limbs = limbs_in_collision(found, body.part_groups, body.parents)
        for start in free_starts(given, limbs, look, _SWINGS):
            yield vector(start.pose)


def settled(stages: Stages, vectors: Float[Array, "M D"], *, free: bool) -> Tried | None:
    """Where a fit of one person ends; None where no candidate can be measured.

    The best candidate by the keypoints, and the best with the overlap, go through the stages: what
    a graze costs to end is only known then. The one that ends with the lower total is freed; where
    that fails, the others are tried.

    Args:
        stages: of the person.
        vectors: the candidates.
        free: whether the search goes on until nothing intersects.
    """
    # The best comes several times where fewer were found.
    rows = np.unique(np.asarray(vectors, np.float64), axis=0)
    known = [place for place in (stages.look(row[None]) for row in rows) if place is not None]
    if not known:
        return None
    first = [min(known, key=lambda one: one.cost)]
    judged = min(known, key=lambda one: one.total(stages.last))
    if judged is not first[0]:
        first.append(judged)
    ends = stages.through(first)
    best = ends[0]
    if not free or best.is_free:
        return best
    others = [place for place in known if all(place is not one for one in first)]
    best = _freed(stages, ends, others)
    stages.on_stage(len(stages.weights) + 1, best.place)
    return best


def _freed(stages: Stages, ends: list[Tried], others: list[Place]) -> Tried:
    """The best of all that is tried, one after another until something is free."""
    best = ends[0]
    for begin in ends:
        best = min(best, stages.freed(begin), key=stages.rank)
        if best.is_free:
            return best
    for place in others:
        (begin,) = stages.quietly().through([place])
        best = min(best, begin if begin.is_free else stages.freed(begin), key=stages.rank)
        if best.is_free:
            return best
    return stages.from_other_sides(best)
