"""Which overlaps are included: ignored pairs of groups and folds at joints are excluded.

Overlap between two connected parts of the surface is included or excluded as a whole, where the
parts' groups decide it or where no path along the rest surface connects the parts. Such overlap is
measured exactly, by the winding numbers of the included parts. Parts that lie in each other at
rest, such as eyeballs in a head, are meant to overlap and are excluded.

Within one part the intersection contours decide. An overlap region is included with the share of
its contour's length along which the intersecting triangles are far from each other at rest: wholly
where all of the contour is, as for two limbs; not at all where none is, as for the crease of a bent
elbow; and in part where a fold and a collision form one region. Where a fan closes a hole, what the
fan intersects beside the hole is a fold, too, whatever else is included (`caps.py`).

With rays, each interval is decided by itself. An interval in an included region is included where
its four sheets may collide: the two solids that overlap there either cross each other or lie one in
the other, and every end of one must be apart from every end of the other. Intervals that end at a
triangle which collides at a contour are included too, so that no included region has volume zero.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.levels import Overlaps
from spt_jax.overlap.triangles.manifold import Manifold

# Between parts that no path along the rest surface connects.
UNCONNECTED = 1e6


class Rest(Protocol):
    """Distances along a rest surface; `spt_jax.RestSurface` is one."""

    distance: float

    def between_faces(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N"]:
        """Distance along the rest surface between triangles."""
        ...

    def near(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"], exact: bool = False
    ) -> Bool[np.ndarray, "N"]:
        """Whether they are folds of each other: nearer than where they lie allows."""
        ...

    def overlap_at_rest(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N"]:
        """Whether the connected parts of two triangles lie in each other at rest."""
        ...


class Exclusions(NamedTuple):
    """What is excluded, hashable so that it can be a static option.

    Attributes:
        groups: each triangle's group, the bytes of an int64 array; None: no groups.
        ignored: pairs of groups whose overlaps are excluded.
        rest: overlaps of sheets nearer than `rest.distance` along it are folds; None: none are.
    """

    groups: bytes | None = None
    ignored: tuple[tuple[int, int], ...] = ()
    rest: Any = None

    @property
    def any(self) -> bool:
        """Whether anything is excluded."""
        return bool(self.groups is not None and self.ignored) or self.rest is not None


NOTHING = Exclusions()


@dataclass(frozen=True, eq=False)
class PartRules:
    """Which overlaps between two connected parts are included, and which the contour decides.

    Attributes:
        group: of each part, as a row of the table of ignored pairs; -1 where it has several.
        face: one of the faces given, for each part.
        ignored: the table.
        rest: the surface at rest.
        capped: parts with holes that fans close: what a fan meets of its own may be a fold.
    """

    group: Int[np.ndarray, "P"]
    face: Int[np.ndarray, "P"]
    ignored: Bool[np.ndarray, "G G"]
    rest: Any
    capped: Bool[np.ndarray, "P"]

    def __call__(
        self, first: Int[np.ndarray, "N"], second: Int[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N 2"]:
        """Whether overlaps of two parts are included whole, and whether the contour decides."""
        same = first == second
        judged = (self.group[first] < 0) | (self.group[second] < 0)
        dropped = ~judged & self.ignored[self.group[first], self.group[second]]
        if self.rest is not None:
            f, g = self.face[first], self.face[second]
            dropped |= ~same & self.rest.overlap_at_rest(f, g)
            judged |= same | np.isfinite(self.rest.between_faces(f, g))
        judged |= same & self.capped[first]
        judged &= ~dropped
        return np.stack([~judged & ~dropped, judged], axis=1)


@functools.lru_cache(maxsize=8)
def part_rules(exclusions: Exclusions, manifold: Manifold) -> PartRules:
    """The rules for a surface's connected parts."""
    part = manifold.part[manifold.faces[:, 0]]
    face = np.zeros(manifold.num_parts, np.int64)
    face[part[::-1]] = manifold.beside[::-1]
    group, ignored = np.zeros(manifold.num_parts, np.int64), np.zeros((1, 1), bool)
    if exclusions.groups is not None and exclusions.ignored:
        groups, ignored = group_table(exclusions.groups, exclusions.ignored)
        of_face = groups[manifold.beside]
        low, high = np.full((2, manifold.num_parts), 0)
        low[:] = len(ignored)
        np.minimum.at(low, part, of_face)
        np.maximum.at(high, part, of_face)
        group = np.where(low == high, low, -1)
        group[low == len(ignored)] = 0
    capped = np.zeros(manifold.num_parts, bool)
    capped[part[manifold.kept < 0]] = True
    return PartRules(group, face, ignored, exclusions.rest, capped)


def pair_weights(
    exclusions: Exclusions, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """The weight of an intersection of two faces: 1 for a collision, 0 for a fold."""
    weight = 1.0 - _ignored(exclusions, f, g)
    if exclusions.rest is not None:
        weight *= ~exclusions.rest.near(f, g, exact=True)
    return weight


@dataclass(frozen=True)
class ContourDecisions:
    """The overlap regions and what their contours decide of them, for intervals on rays.

    Attributes:
        region: of each face given; -1 where it bounds none.
        pairs: faces that intersect.
        collides: which of these pairs collide.
        included: regions that have a collision along their contour, or no contour.
    """

    region: Int[np.ndarray, "F"]
    pairs: Int[np.ndarray, "P 2"]
    collides: Bool[np.ndarray, "P"]
    included: Bool[np.ndarray, "R"]


def decide_by_contours(
    exclusions: Exclusions,
    region: Int[np.ndarray, "F"],
    count: int,
    pairs: Int[np.ndarray, "P 2"],
) -> ContourDecisions:
    """Which intersections of faces are collisions, and which regions are included for that."""
    collides = pair_weights(exclusions, *pairs.T) > 0
    at = region[pairs[:, 0]]
    total = np.bincount(at, minlength=count)
    return ContourDecisions(
        region, pairs, collides, (total == 0) | (np.bincount(at[collides], minlength=count) > 0)
    )


def included_intervals(
    exclusions: Exclusions, decisions: ContourDecisions, beams: list[Overlaps]
) -> list[Bool[np.ndarray, "N"]]:
    """Which intervals of each beam are included."""
    allowed = np.append(decisions.included, True)  # -1: in no region
    collides = np.zeros(len(decisions.region), bool)
    collides[decisions.pairs[decisions.collides]] = True
    # With folds excluded, an interval is included if either of its end faces lies on a colliding
    # contour. With groups, both must: accepting one would attribute 6 % of each body's own overlap
    # to the pair, requiring both leaves 0.2 %.
    at_contour = np.any if exclusions.rest is not None else np.all
    counted = []
    for overlaps in beams:
        region = decisions.region[overlaps.ends].max(axis=1, initial=-1)
        near_contour = at_contour(collides[overlaps.ends], axis=1)
        counted.append(allowed[region] & (near_contour | _apart(exclusions, overlaps)))
    return counted


def _apart(exclusions: Exclusions, overlaps: Overlaps) -> Bool[np.ndarray, "N"]:
    """Whether the two solids of each interval may collide."""
    first, last = overlaps.ends.T
    opening, closing = overlaps.around.T
    lone = opening < 0  # inside out: only the two ends are there to compare
    opening, closing = np.where(lone, first, opening), np.where(lone, last, closing)
    # The solids are (opening, last) and (first, closing) where they cross, and (opening, closing)
    # and (first, last) where one lies in the other.
    pairs = {
        "ol": (opening, last),
        "fc": (first, closing),
        "oc": (opening, closing),
        "fl": (first, last),
        "of": (opening, first),
        "cl": (closing, last),
    }
    length = {name: _group_distance(exclusions, *pair) for name, pair in pairs.items()}
    far = {name: np.ones(len(first), bool) for name in pairs}
    if exclusions.rest is not None:
        for name, pair in pairs.items():
            along = np.minimum(exclusions.rest.between_faces(*pair), UNCONNECTED)
            far[name] = ~exclusions.rest.near(*pair)
            length[name] = length[name] + along
    crossing = length["ol"] + length["fc"] <= length["oc"] + length["fl"]
    apart = far["of"] & far["cl"] & np.where(crossing, far["oc"] & far["fl"], far["ol"] & far["fc"])
    apart = np.where(lone, far["fl"], apart)
    # Where several solids overlap in a row, the nearest sheet that opens or closes may be another
    # solid's. So of two that cross, the sheets that bound the interval determine the groups.
    ignored = {name: _ignored(exclusions, *pair) for name, pair in pairs.items()}
    nested = ignored["of"] | ignored["cl"] | ignored["ol"] | ignored["fc"]
    return apart & ~np.where(crossing | lone, ignored["fl"], nested)


def _ignored(exclusions: Exclusions, f, g) -> Bool[np.ndarray, "N"]:
    if exclusions.groups is None or not exclusions.ignored:
        return np.zeros(len(f), bool)
    groups, ignored = group_table(exclusions.groups, exclusions.ignored)
    return ignored[groups[f], groups[g]]


def _group_distance(exclusions: Exclusions, f, g) -> Float[np.ndarray, "N"]:
    if exclusions.groups is None:
        return np.zeros(len(f))
    groups, _ = group_table(exclusions.groups, exclusions.ignored)
    return 1.0 * (groups[f] != groups[g])


@functools.lru_cache(maxsize=8)
def group_table(groups: bytes, pairs: tuple[tuple[int, int], ...]):
    """Each face's group as a row of a table of the ignored pairs, and that table."""
    names, row = np.unique(np.frombuffer(groups, np.int64), return_inverse=True)
    ignored = np.zeros((len(names), len(names)), bool)
    for pair in pairs:
        at = np.searchsorted(names, pair)
        if (at < len(names)).all() and (names[at] == pair).all():
            ignored[at[0], at[1]] = ignored[at[1], at[0]] = True
    return row, ignored
