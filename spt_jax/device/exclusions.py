"""Which overlaps count, decided for each interval by its own sheets, as `overlap.exclusions`."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax.device.levels import Intervals
from spt_jax.device.pair_search import over_crossing_pairs
from spt_jax.device.patches import spread
from spt_jax.overlap.exclusions import UNCONNECTED, Exclusions, group_table

# The six pairs of the four sheets: opening, first, last and closing, along the ray.
_PAIRS = {"ol": (0, 2), "fc": (1, 3), "oc": (0, 3), "fl": (1, 2), "of": (0, 1), "cl": (3, 2)}


class Rims(NamedTuple):
    """Triangles that pass through another one; the rims of overlaps run there.

    Attributes:
        crossing: all of them.
        colliding: those that collide there.
    """

    crossing: Bool[Array, "F"]
    colliding: Bool[Array, "F"]

    def may_count(self, faces: Int[Array, "F 3"], overlapped: Bool[Array, "V"]) -> Bool[Array, "V"]:
        """The vertices of overlaps that have a collision along their rim, or no rim."""

        def reached(triangles):
            corners = jnp.zeros(len(overlapped), bool)
            corners = corners.at[faces.reshape(-1)].max(jnp.repeat(triangles, 3))
            return spread(corners, overlapped, faces)

        return reached(self.colliding) | (overlapped & ~reached(self.crossing))


def find_rims(
    exclusions: Exclusions, vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]
) -> Rims:
    """The rims of all overlaps, from the triangles alone.

    Two triangles that pass through each other collide where they are far apart at rest, and of
    groups of which overlaps count.
    """

    def add(rims: Rims, first, second, crosses) -> Rims:
        collides = crosses & ~_by_groups(exclusions, first, second)[1]
        if exclusions.rest is not None:
            collides &= ~_near_at_rest(exclusions.rest, first, second)
        both = jnp.concatenate([first, second])
        return Rims(
            rims.crossing.at[both].max(jnp.tile(crosses, 2)),
            rims.colliding.at[both].max(jnp.tile(collides, 2)),
        )

    nothing = jnp.zeros(len(faces), bool)
    return over_crossing_pairs(vertices, faces, add, Rims(nothing, nothing))


def which_count(
    exclusions: Exclusions,
    intervals: Intervals,
    faces: Int[Array, "F 3"],
    rims: Rims,
    may_count: Bool[Array, "V"],
) -> Bool[Array, "N"]:
    """Which intervals count.

    Of overlaps that may count, those whose sheets may collide and those at triangles that collide
    at the rim.
    """
    apart = _apart(exclusions, intervals)
    # Two sheets bound an overlap: what is known of either holds for what is between them.
    corners = faces[intervals.ends.reshape(-1)]
    allowed = may_count[corners].all(axis=1).reshape(-1, 2).any(axis=1)
    # As on the host: one end at the rim will do where folds are told apart, groups ask for both.
    at_rim = jnp.any if exclusions.rest is not None else jnp.all
    return allowed & (apart | at_rim(rims.colliding[intervals.ends], axis=1))


def _apart(exclusions: Exclusions, intervals: Intervals) -> Bool[Array, "N"]:
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
        other_group, ignored[name] = _by_groups(exclusions, *pair)
        length[name] = other_group.astype(jnp.float32)
        far[name] = jnp.ones(len(first), bool)
        if exclusions.rest is not None:
            along = jnp.minimum(_along_rest(exclusions.rest, *pair), UNCONNECTED)
            far[name] = along >= exclusions.rest.distance
            length[name] = length[name] + along
    crossing = length["ol"] + length["fc"] <= length["oc"] + length["fl"]
    apart = far["of"] & far["cl"]
    apart &= jnp.where(crossing, far["oc"] & far["fl"], far["ol"] & far["fc"])
    apart = jnp.where(lone, far["fl"], apart)
    # Where several solids overlap in a row, the nearest sheet that opens or closes may be another
    # solid's. So of two that cross, the sheets that bound the interval tell the pair of groups.
    nested = ignored["of"] | ignored["cl"] | ignored["ol"] | ignored["fc"]
    return apart & ~jnp.where(crossing | lone, ignored["fl"], nested)


def _by_groups(
    exclusions: Exclusions, f: Int[Array, "N"], g: Int[Array, "N"]
) -> tuple[Bool[Array, "N"], Bool[Array, "N"]]:
    """Whether triangles are of different groups, and whether that pair of groups is ignored."""
    if exclusions.groups is None or not exclusions.ignored:
        nothing = jnp.zeros(len(f), bool)
        return nothing, nothing
    row, ignored = group_table(exclusions.groups, exclusions.ignored)
    row = jnp.asarray(row, jnp.int32)
    return row[f] != row[g], jnp.asarray(ignored)[row[f], row[g]]


def _along_rest(rest, f: Int[Array, "N"], g: Int[Array, "N"]) -> Float[Array, "N"]:
    """`RestSurface.between_faces`, which is the middle of two bounds."""
    table = _rest_table(rest)
    faces = table.nearest.shape[0]
    person, other = f // faces, g // faces
    f, g = f % faces, g % faces
    over_g = table.rows[f, table.nearest[g]]
    over_f = table.rows[g, table.nearest[f]]
    upper = jnp.minimum(over_g + table.to_nearest[g], over_f + table.to_nearest[f])
    lower = jnp.maximum(over_g - table.from_nearest[g], over_f - table.from_nearest[f])
    return jnp.where(person == other, 0.5 * (jnp.maximum(lower, 0.0) + upper), jnp.inf)


def _near_at_rest(rest, f: Int[Array, "N"], g: Int[Array, "N"]) -> Bool[Array, "N"]:
    """`RestSurface.near`, by the bounds over all seeds.

    Of 9,157 pairs of triangles that cross on 60 mocap frames none is told otherwise than by the
    paths themselves; by the bounds of `_along_rest` 36 are.
    """
    table = _rest_table(rest)
    faces = table.nearest.shape[0]
    person, other = f // faces, g // faces
    f, g = f % faces, g % faces
    to_f, to_g = table.rows[f], table.rows[g]
    upper = (to_f + to_g).min(axis=1)
    # Equal ones first: both are infinite at seeds of other parts.
    farther = jnp.where(to_f == to_g, jnp.zeros_like(to_f), to_f - to_g)
    lower = jnp.maximum(
        farther.max(axis=1) - table.longest[g], -farther.min(axis=1) - table.longest[f]
    )
    return (person == other) & (0.5 * (jnp.maximum(lower, 0.0) + upper) < rest.distance)


class _RestTable:
    """The shortest paths of a rest surface on the device."""

    def __init__(self, paths):
        table = paths._ready()
        with jax.ensure_compile_time_eval():
            self.longest = jnp.asarray(paths._longest)
            self.rows = jnp.asarray(table.rows)
            self.nearest = jnp.asarray(np.asarray(table.nearest, np.int32))
            self.to_nearest = jnp.asarray(table.to_nearest)
            self.from_nearest = jnp.asarray(table.from_nearest)


def _rest_table(rest) -> _RestTable:
    return _table_on_device(rest._paths)


@functools.lru_cache(maxsize=4)
def _table_on_device(paths) -> _RestTable:
    return _RestTable(paths)
