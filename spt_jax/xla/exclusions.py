"""Which overlaps are included, decided interval by interval, as in `overlap.exclusions`."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.exclusions import UNCONNECTED
from spt_jax.xla.levels import Intervals
from spt_jax.xla.pair_search import over_intersecting_pairs
from spt_jax.xla.patches import spread
from spt_jax.xla.tables import ExclusionTables, GroupTable, PathTable, PlaceTable, RestTable

# The six pairs of the four sheets: opening, first, last and closing, along the ray.
_PAIRS = {"ol": (0, 2), "fc": (1, 3), "oc": (0, 3), "fl": (1, 2), "of": (0, 1), "cl": (3, 2)}


class ContourFaces(NamedTuple):
    """Triangles that pass through another one; the contour_faces of overlaps run there.

    Attributes:
        intersecting: all of them.
        colliding: those that collide there.
    """

    intersecting: Bool[Array, "F"]
    colliding: Bool[Array, "F"]

    def included(self, faces: Int[Array, "F 3"], overlapped: Bool[Array, "V"]) -> Bool[Array, "V"]:
        """The vertices of overlaps that have a collision along their contour, or no contour."""

        def reached(triangles):
            corners = jnp.zeros(len(overlapped), bool)
            corners = corners.at[faces.reshape(-1)].max(jnp.repeat(triangles, 3))
            return spread(corners, overlapped, faces)

        return reached(self.colliding) | (overlapped & ~reached(self.intersecting))


def find_contour_faces(
    exclusions: ExclusionTables, vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]
) -> ContourFaces:
    """The contour_faces of all overlaps, from the triangles alone.

    Two triangles that pass through each other collide where they are far apart at rest, and of
    groups of which overlaps count.
    """

    def add(contour_faces: ContourFaces, first, second, intersects) -> ContourFaces:
        collides = intersects & ~_by_groups(exclusions.groups, first, second)[1]
        if exclusions.rest is not None:
            collides &= ~_near_at_rest(exclusions.rest, first, second)
        both = jnp.concatenate([first, second])
        return ContourFaces(
            contour_faces.intersecting.at[both].max(jnp.tile(intersects, 2)),
            contour_faces.colliding.at[both].max(jnp.tile(collides, 2)),
        )

    nothing = jnp.zeros(len(faces), bool)
    return over_intersecting_pairs(vertices, faces, add, ContourFaces(nothing, nothing))


def included_intervals(
    exclusions: ExclusionTables,
    intervals: Intervals,
    faces: Int[Array, "F 3"],
    contour_faces: ContourFaces,
    included: Bool[Array, "V"],
) -> Bool[Array, "N"]:
    """Which intervals are included.

    Of the included overlaps, those whose sheets may collide and those that end at a triangle which
    collides at a contour.
    """
    apart = _apart(exclusions, intervals)
    # Two sheets bound an overlap: what is known of either holds for what is between them.
    corners = faces[intervals.ends.reshape(-1)]
    allowed = included[corners].all(axis=1).reshape(-1, 2).any(axis=1)
    # As on the host: one end at a colliding contour is enough where folds are excluded; groups
    # require both.
    at_contour = jnp.any if exclusions.rest is not None else jnp.all
    return allowed & (apart | at_contour(contour_faces.colliding[intervals.ends], axis=1))


def _apart(exclusions: ExclusionTables, intervals: Intervals) -> Bool[Array, "N"]:
    """Whether the two solids of each interval may collide."""
    first, last = intervals.ends.T
    opening, closing = intervals.around.T
    lone = opening < 0  # inside out: only the two ends are there to compare
    sheets = jnp.where(lone, first, opening), first, last, jnp.where(lone, last, closing)
    # The solids are (opening, last) and (first, closing) where they cross, and (opening, closing)
    # and (first, last) where one lies in the other.
    length, far, ignored = {}, {}, {}
    for name, (i, j) in _PAIRS.items():
        pair = sheets[i], sheets[j]
        other_group, ignored[name] = _by_groups(exclusions.groups, *pair)
        length[name] = other_group.astype(jnp.float32)
        far[name] = jnp.ones(len(first), bool)
        if exclusions.rest is not None:
            along = _along_rest(exclusions.rest.paths, *pair)
            far[name] = ~_folds(exclusions.rest.places, *pair, along)
            length[name] = length[name] + jnp.minimum(along, UNCONNECTED)
    crossing = length["ol"] + length["fc"] <= length["oc"] + length["fl"]
    apart = far["of"] & far["cl"]
    apart &= jnp.where(crossing, far["oc"] & far["fl"], far["ol"] & far["fc"])
    apart = jnp.where(lone, far["fl"], apart)
    # Where several solids overlap in a row, the nearest sheet that opens or closes may be another
    # solid's. So of two that cross, the sheets that bound the interval determine the pair of
    # groups.
    nested = ignored["of"] | ignored["cl"] | ignored["ol"] | ignored["fc"]
    return apart & ~jnp.where(crossing | lone, ignored["fl"], nested)


def _by_groups(
    groups: GroupTable | None, f: Int[Array, "N"], g: Int[Array, "N"]
) -> tuple[Bool[Array, "N"], Bool[Array, "N"]]:
    """Whether triangles are of different groups, and whether that pair of groups is ignored."""
    if groups is None:
        nothing = jnp.zeros(len(f), bool)
        return nothing, nothing
    row, ignored = groups
    return row[f] != row[g], ignored[row[f], row[g]]


def _along_rest(table: PathTable, f: Int[Array, "N"], g: Int[Array, "N"]) -> Float[Array, "N"]:
    """`RestSurface.between_faces`, which is the middle of two bounds."""
    faces = table.nearest.shape[0]
    person, other = f // faces, g // faces
    f, g = f % faces, g % faces
    over_g = table.rows[f, table.nearest[g]]
    over_f = table.rows[g, table.nearest[f]]
    upper = jnp.minimum(over_g + table.to_nearest[g], over_f + table.to_nearest[f])
    lower = jnp.maximum(over_g - table.from_nearest[g], over_f - table.from_nearest[f])
    return jnp.where(person == other, 0.5 * (jnp.maximum(lower, 0.0) + upper), jnp.inf)


def _near_at_rest(rest: RestTable, f: Int[Array, "N"], g: Int[Array, "N"]) -> Bool[Array, "N"]:
    """`RestSurface.near`, by the bounds over all seeds.

    Of 9,157 pairs of triangles that intersect on 60 mocap frames none is classified otherwise than
    by the paths themselves; by the bounds of `_along_rest` 36 are.
    """
    table = rest.paths
    faces = table.nearest.shape[0]
    first, second = f, g
    person, other = f // faces, g // faces
    f, g = f % faces, g % faces
    to_f, to_g = table.rows[f], table.rows[g]
    upper = (to_f + to_g).min(axis=1)
    # Equal ones first: both are infinite at seeds of other parts.
    farther = jnp.where(to_f == to_g, jnp.zeros_like(to_f), to_f - to_g)
    lower = jnp.maximum(
        farther.max(axis=1) - table.longest[g], -farther.min(axis=1) - table.longest[f]
    )
    along = jnp.where(person == other, 0.5 * (jnp.maximum(lower, 0.0) + upper), jnp.inf)
    return _folds(rest.places, first, second, along)


def _folds(
    table: PlaceTable, f: Int[Array, "N"], g: Int[Array, "N"], along: Float[Array, "N"]
) -> Bool[Array, "N"]:
    """Whether triangles so far apart fold: nearer than the smaller of their distances allows.

    Or if their parts lie in each other at rest.
    """
    count = table.distances.shape[0]
    person, other = f // count, g // count
    f, g = f % count, g % count
    near = along < jnp.minimum(table.distances[f], table.distances[g])
    if table.around is not None:
        swap = table.distances[g] < table.distances[f]
        own, far = jnp.where(swap, g, f), jnp.where(swap, f, g)
        row = table.row[own]
        byte = table.around[jnp.maximum(row, 0), far >> 3].astype(jnp.int32)
        listed = (byte >> (7 - (far & 7))) & 1 == 1
        near = jnp.where(row >= 0, (person == other) & listed, near)
    if table.in_each_other is not None:
        near |= (person == other) & table.in_each_other[table.part[f], table.part[g]]
    return near
