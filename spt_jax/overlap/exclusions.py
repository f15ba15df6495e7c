"""Which overlaps count: pairs of groups left out, and folds told from collisions.

Overlaps are decided twice. A region of overlap counts where anywhere along its rim two triangles
cross that may collide; that settles the folds of skinning, whose sheets meet at a crease. Within a
region that counts, an interval on a ray counts where its four sheets may collide: the two solids
that overlap there either cross or lie one in the other, and every end of one must be apart from
every end of the other. Intervals at triangles which collide at the rim count too, so that a region
that counts never weighs nothing.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.levels import Overlaps
from spt_jax.overlap.triangles.sheets import Sheets

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
        """Whether it is less than `distance`."""
        ...


class Exclusions(NamedTuple):
    """What does not count, hashable so that it can be a static option.

    Attributes:
        groups: each triangle's group, the bytes of an int64 array; None: no groups.
        ignored: pairs of groups whose overlaps do not count.
        rest: overlaps of sheets nearer than `rest.distance` along it are folds; None: none are.
    """

    groups: bytes | None = None
    ignored: tuple[tuple[int, int], ...] = ()
    rest: Any = None

    @property
    def any(self) -> bool:
        """Whether anything is left out."""
        return bool(self.groups is not None and self.ignored) or self.rest is not None


NOTHING = Exclusions()


@dataclass(frozen=True)
class Rims:
    """What the triangles that pass through each other say of the regions of overlap.

    Attributes:
        collides: which pairs of `Sheets.pairs` collide, by groups and rest distance.
        pairs: how many pairs run along each region's rim.
        colliding: how many of those collide.
    """

    collides: Bool[np.ndarray, "P"]
    pairs: Int[np.ndarray, "R"]
    colliding: Int[np.ndarray, "R"]

    @property
    def rimless(self) -> Bool[np.ndarray, "R"]:
        """Regions that nothing crosses: parts that lie within another whole, or inside out."""
        return self.pairs == 0

    @property
    def may_count(self) -> Bool[np.ndarray, "R"]:
        """Regions that have a collision along their rim, or no rim."""
        return self.rimless | (self.colliding > 0)

    @property
    def undecided(self) -> Bool[np.ndarray, "R"]:
        """Regions that the triangles do not decide: no rim, or collisions along a part of it."""
        return self.rimless | ((self.colliding > 0) & (self.colliding < self.pairs))


def judge_rims(exclusions: Exclusions, sheets: Sheets) -> Rims:
    """Which crossings of triangles collide, and what that makes of the regions."""
    f, g = sheets.pairs.T
    collides = ~_ignored(exclusions, f, g)
    if exclusions.rest is not None:
        collides &= ~exclusions.rest.near(f, g, exact=True)
    region, count = sheets.region[f], sheets.num_regions
    return Rims(
        collides,
        np.bincount(region, minlength=count),
        np.bincount(region[collides], minlength=count),
    )


def counted_intervals(
    exclusions: Exclusions, sheets: Sheets, rims: Rims, beams: list[Overlaps]
) -> list[Bool[np.ndarray, "N"]]:
    """Which intervals of each beam count."""
    allowed = np.append(rims.may_count, True)  # -1: in no region
    collides = np.zeros(len(sheets.region), bool)
    collides[sheets.pairs[rims.collides]] = True
    # What folds has few sheets far from each other, and one end at the rim will do. Groups tell
    # the sheets apart by themselves: of two bodies, one end would add 6 % of folds to what is
    # between them, both ends add 0.2 %.
    at_rim = np.any if exclusions.rest is not None else np.all
    counted = []
    for overlaps in beams:
        region = sheets.region[overlaps.ends].max(axis=1, initial=-1)
        rim = at_rim(collides[overlaps.ends], axis=1)
        counted.append(allowed[region] & (rim | _apart(exclusions, overlaps)))
    return counted


def counted_labels(
    sheets: Sheets, faces: Int[np.ndarray, "F 3"], counted: Bool[np.ndarray, "R"]
) -> Int[np.ndarray, "V"]:
    """The vertices' classes sign(w_out), 0 where their region of overlap does not count."""
    label = np.sign(sheets.winding).astype(np.int8)
    if not counted.all():
        touched = counted[sheets.region[sheets.faces]]
        kept = np.zeros(len(label), bool)
        kept[faces[sheets.faces[touched]]] = True
        label[~kept] = 0
    return label


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
            far[name] = along >= exclusions.rest.distance
            length[name] = length[name] + along
    crossing = length["ol"] + length["fc"] <= length["oc"] + length["fl"]
    apart = far["of"] & far["cl"] & np.where(crossing, far["oc"] & far["fl"], far["ol"] & far["fc"])
    apart = np.where(lone, far["fl"], apart)
    # Where several solids overlap in a row, the nearest sheet that opens or closes may be another
    # solid's. So of two that cross, the sheets that bound the interval tell the pair of groups.
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
