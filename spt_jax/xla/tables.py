r"""What the device path knows from outside, as arrays: operands of its programs, not part of them.

Programs are compiled for shapes alone, so calls that differ in directions, groups or distances
share one. Every table is a look-up by face:

    faces of a triangle pair        f                              g
    GroupTable    is the pair       row[f] ------> ignored[.,.] <------ row[g]
                  ignored?
    PathTable     how far apart     rows[f, s] is the distance from f to seed s. Over any s, and
                  at rest?          best over f's or g's nearest one,

                                       f ---------------- g        |fs - sg| <= fg <= fs + sg
                                         \             /           so 512 numbers a face stand for
                                          s ---------'             distances of 300 million pairs

    PlaceTable    do they fold?     where fg is smaller than distances[f] and distances[g]; in slim
                                    limbs exactly, from a bit for each face that is near:
                                    around[row[f], g / 8] has g's bit at 7 - g mod 8, as
                                    `np.packbits` lays them

Scenes of several copies of one rest surface use the tables of one: face f of the scene is face
f mod F of copy f div F.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from spt_jax.overlap.exclusions import Exclusions, group_table
from spt_jax.overlap.measure import Sampling
from spt_jax.rest.paths import SurfacePaths
from spt_jax.xla.beam import Aims, aims
from spt_jax.xla.settings import resolve_rays
from spt_jax.xla.winding import generic_frames

# Known, before they become operands.
_Values = Array | np.ndarray

# Bytes of what is listed as near.
_MOST_LISTED = 64 << 20

# Groups: tables have room for a power of two of them, and at least so many.
_FEWEST_GROUPS = 8


class GroupTable(NamedTuple):
    """The group of each face, a row of the table of ignored pairs."""

    row: Int[_Values, "F"]
    ignored: Bool[_Values, "G G"]


class PathTable(NamedTuple):
    """The shortest paths of a rest surface, from seeds to its faces."""

    longest: Float[_Values, "F"]
    rows: Float[_Values, "F S"]
    nearest: Int[_Values, "F"]
    to_nearest: Float[_Values, "F"]
    from_nearest: Float[_Values, "F"]


class PlaceTable(NamedTuple):
    """What is known of each face of a rest surface by itself: how far folds reach, and its part.

    Where folds reach no farther than twice the way to the nearest seed, as on fingers, bounds by
    seeds are too rough (of 7,142 pairs that intersect on 41 hands they take 402 folds for
    collisions): there all faces that are near are listed, a bit for each. On the embedded body that
    takes 2 to 4 s at first, and 17 MB.

    Attributes:
        distances: how far folds reach.
        row: of each face in `around`; -1 where it is not listed.
        around: bits of the faces that are near; None: no face is listed.
        part: of each face, as a row of `in_each_other`.
        in_each_other: parts that lie in each other at rest; None: none do.
    """

    distances: Float[_Values, "F"]
    row: Int[_Values, "F"]
    around: UInt8[_Values, "N B"] | None
    part: Int[_Values, "F"]
    in_each_other: Bool[_Values, "P P"] | None


class RestTable(NamedTuple):
    """A rest surface."""

    paths: PathTable
    places: PlaceTable


class ExclusionTables(NamedTuple):
    """The tables that decide which overlaps are excluded."""

    groups: GroupTable | None
    rest: RestTable | None


class Tables(NamedTuple):
    """All of one call.

    Attributes:
        aims: the directions of the rays.
        frames: of the rays through vertices, as `winding.generic_frames`.
        exclusions: None where nothing is excluded.
    """

    aims: Aims
    frames: Float[_Values, "D 3 3"]
    exclusions: ExclusionTables | None


def tables_of(sampling: Sampling, exclusions: Exclusions, dtype: np.dtype) -> Tables:
    """The arrays for one sampling, in the precision of the vertices."""
    aimed = aims(sampling._replace(rays=resolve_rays(sampling.rays)), dtype)
    frames = generic_frames(sampling.directions).astype(dtype)
    if not exclusions.any:
        return Tables(aimed, frames, None)
    groups = rest = None
    if exclusions.groups is not None and exclusions.ignored:
        groups = _group_table(exclusions)
    if exclusions.rest is not None:
        rest = rest_table(exclusions.rest)
    return Tables(aimed, frames, ExclusionTables(groups, rest))


def rest_table(rest: Any) -> RestTable:
    """The tables of a rest surface; of the last four they are kept."""
    return RestTable(_path_table(rest._paths), _place_table(rest))


def _group_table(exclusions: Exclusions) -> GroupTable:
    assert exclusions.groups is not None
    row, ignored = group_table(exclusions.groups, exclusions.ignored)
    size = max(_FEWEST_GROUPS, 1 << (len(ignored) - 1).bit_length())
    table = np.zeros((size, size), bool)
    table[: len(ignored), : len(ignored)] = ignored
    return GroupTable(row.astype(np.int32), table)


@functools.lru_cache(maxsize=4)
def _place_table(rest: Any) -> PlaceTable:
    part, pairs = rest.parts_at_rest
    one = rest.distances[: len(part)]
    row, around = np.zeros(len(part), np.int32), None
    slim = _slim_faces(rest._paths, one)
    if len(slim):
        row = np.full(len(part), -1, np.int32)
        row[slim] = np.arange(len(slim), dtype=np.int32)
        around = _near_faces(rest._paths, slim, one[slim])
    number, table = np.zeros(len(part), np.int32), None
    if len(pairs):
        # Rows for parts that lie in others; all the rest is row 0.
        names, both = np.unique(pairs, return_inverse=True)
        among = np.isin(part, names)
        number = np.where(among, np.searchsorted(names, part) + 1, 0).astype(np.int32)
        table = np.zeros((len(names) + 1, len(names) + 1), bool)
        first, second = both.reshape(-1, 2).T + 1
        table[first, second] = table[second, first] = True
    return _on_device(PlaceTable(one.astype(np.float32), row, around, number, table))


@functools.lru_cache(maxsize=4)
def _path_table(paths: SurfacePaths) -> PathTable:
    table = paths.table
    nearest = np.asarray(table.nearest, np.int32)
    found = PathTable(paths._longest, table.rows, nearest, table.to_nearest, table.from_nearest)
    return _on_device(found)


def _on_device(tables):
    # Known values, also where a program is being traced.
    with jax.ensure_compile_time_eval():
        return jax.tree.map(jnp.asarray, tables)


def _slim_faces(paths, allowed: Float[np.ndarray, "F"]) -> Int[np.ndarray, "S"]:
    """The faces whose folds reach no farther than bounds by seeds are good for.

    None where listing what is near them would take more than `_MOST_LISTED` bytes.
    """
    seeds = paths.table.to_nearest
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
