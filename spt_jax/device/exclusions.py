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

# Bytes of what is listed as near.
_MOST_LISTED = 64 << 20


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
            along = _along_rest(exclusions.rest, *pair)
            far[name] = ~_folds(exclusions.rest, *pair, along)
            length[name] = length[name] + jnp.minimum(along, UNCONNECTED)
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
    return _folds(rest, first, second, along)


def _folds(
    rest, f: Int[Array, "N"], g: Int[Array, "N"], along: Float[Array, "N"]
) -> Bool[Array, "N"]:
    """Whether triangles so far apart fold: nearer than the smaller of their distances allows.

    Or if their parts lie in each other at rest.
    """
    table = _place_table(rest)
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


class _PlaceTable:
    """What is known of each face of a rest surface by itself: how far folds reach, and its part.

    Where folds reach no farther than twice the way to the nearest seed, as on fingers, bounds by
    seeds are too rough (of 7,142 pairs that intersect on 41 hands they take 402 folds for
    collisions): there all faces that are near are listed, a bit for each. On the embedded body that
    takes 2 to 4 s at first, and 17 MB.

    The arrays are constants of the program that is traced.
    """

    def __init__(self, rest):
        part, pairs = rest.parts_at_rest
        with jax.ensure_compile_time_eval():
            one = rest.distances[: len(part)]
            self.distances = jnp.asarray(one.astype(np.float32))
            self.row, self.around = jnp.zeros(len(part), jnp.int32), None
            slim = _slim_faces(rest._paths, one)
            if len(slim):
                row = np.full(len(part), -1, np.int32)
                row[slim] = np.arange(len(slim), dtype=np.int32)
                self.row = jnp.asarray(row)
                self.around = jnp.asarray(_near_faces(rest._paths, slim, one[slim]))
            self.part, self.in_each_other = jnp.zeros(len(part), jnp.int32), None
            if len(pairs):
                # Rows for parts that lie in others; all the rest is row 0.
                names, row = np.unique(pairs, return_inverse=True)
                among = np.isin(part, names)
                number = np.where(among, np.searchsorted(names, part) + 1, 0)
                table = np.zeros((len(names) + 1, len(names) + 1), bool)
                first, second = row.reshape(-1, 2).T + 1
                table[first, second] = table[second, first] = True
                self.part = jnp.asarray(number.astype(np.int32))
                self.in_each_other = jnp.asarray(table)


def _slim_faces(paths, allowed: Float[np.ndarray, "F"]) -> Int[np.ndarray, "S"]:
    """The faces whose folds reach no farther than bounds by seeds are good for.

    None where listing what is near them would take more than `_MOST_LISTED` bytes.
    """
    seeds = paths._ready().to_nearest
    to_seed = float(seeds.max(initial=0.0, where=np.isfinite(seeds)))
    slim = np.flatnonzero(allowed < 2 * to_seed)
    return slim if len(slim) * len(allowed) <= 8 * _MOST_LISTED else slim[:0]


def _near_faces(paths, faces, allowed) -> np.ndarray:
    """For each of some faces a bit for every face: whether that one is nearer than allowed."""
    rows = []
    for start in range(0, len(faces), 64):
        part = slice(start, start + 64)
        along = paths._from_faces(faces[part], float(allowed[part].max()))
        rows.append(np.packbits(along < allowed[part, None], axis=1))
    return np.concatenate(rows)


@functools.lru_cache(maxsize=4)
def _place_table(rest) -> _PlaceTable:
    return _PlaceTable(rest)


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
