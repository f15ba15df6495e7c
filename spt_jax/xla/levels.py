"""Counters along each ray and the overlaps that they enclose, as `overlap.rays.levels`.

A gap of winding number w counts w (w - 1) / 2 times, so an interval of level l, of which w_out at
its ends is l - 1, counts |l - 1| times. One cumulative sum counts for all rays, since every ray's
signs sum to zero. A second sort, by level and place, puts the crossing that opens an interval next
to the one that closes it.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.rays.levels import THINNEST
from spt_jax.xla.arrays import cumulative_sum, take
from spt_jax.xla.beam import Screen
from spt_jax.xla.crossings import DEPTH_STEPS, Crossings


class Intervals(NamedTuple):
    """The overlapped intervals on the rays of a strip.

    Attributes:
        ends: the triangles that each interval begins and ends at.
        around: the triangles that open and close the solid around it; -1 where none does.
        barycentric: of the points where the ray crosses `ends`.
        outer: w_out at both ends, which is the interval's level less one: positive on penetrating
            sheets, negative on inverted ones, 0 at unused places.
        length: from end to end, in the mesh's unit; 0 at unused places. The interval counts
            |w_out| times.
    """

    ends: Int[Array, "N 2"]
    around: Int[Array, "N 2"]
    barycentric: Float[Array, "N 2 3"]
    outer: Int[Array, "N"]
    length: Float[Array, "N"]

    @property
    def size(self) -> Float[Array, ""]:
        """The lengths, each as often as it counts: times the area of a ray, the overlap volume."""
        counted = jnp.abs(self.outer).astype(self.length.dtype) * self.length
        # In two steps: float32 sums of many small lengths lose less.
        counted = jnp.pad(counted, (0, -len(counted) % 256))
        return counted.reshape(256, -1).sum(axis=1).sum()


def most_levels(size: int) -> int:
    """The deepest level that can be determined where so many crossings are sorted."""
    return 2**30 // size - 2


def find_overlaps(
    screen: Screen,
    faces: Int[Array, "F 3"],
    crossings: Crossings,
    begin: Int[Array, ""],
    columns: int,
) -> tuple[Intervals, Int[Array, ""]]:
    """The intervals of a strip whose first row is `begin`, and its deepest level."""
    size = len(crossings.ray)
    valid = crossings.sign != 0
    # A crossing's level is the larger of the winding numbers on its two sides.
    level = cumulative_sum(crossings.sign) + (crossings.sign < 0).astype(jnp.int32)
    most = most_levels(size)
    deepest = jnp.max(jnp.where(valid, jnp.abs(level), 0))
    place = jnp.arange(size, dtype=jnp.int32)
    key = (jnp.clip(level, -most, most) + most) * size + place
    # Of one array alone: a sort that carries no second array takes a seventh of the time.
    key = jnp.sort(jnp.where(valid, key, jnp.iinfo(jnp.int32).max))
    # Along a ray the crossings of one level open and close in turn.
    opens, closes = (key[start::2] % size for start in (0, 1))
    levels = key[::2] // size - most
    used = (key[1::2] < jnp.iinfo(jnp.int32).max) & (levels != 1)

    pair = jnp.stack([opens, closes], axis=1)
    ends, ray = take(crossings.face, pair), take(crossings.ray, opens)
    corners = take(_table(screen), take(faces, ends.reshape(-1)))  # (K, 3, 6)
    row = jnp.repeat(begin + ray // columns, 2).astype(screen.pixel.dtype)
    column = jnp.repeat(ray % columns, 2).astype(screen.pixel.dtype)
    barycentric = _barycentric(corners, row, column)
    # Relative to one corner of the two triangles, where float32 is exact to a millionth of a pixel.
    base = jnp.repeat(corners[::2, 0, 4], 2)
    depth = (barycentric * _relative(corners, 2, base)).sum(axis=1).reshape(-1, 2)
    length = jnp.where(used, depth[:, 1] - depth[:, 0], jnp.zeros_like(depth[:, 0]))

    # Intervals within an outermost one, of level 2 or 0, form a run with it.
    outermost = used & ((levels == 2) | (levels == 0))
    starts = jnp.zeros(size, jnp.int32).at[opens].add(outermost.astype(jnp.int32))
    run = take(cumulative_sum(starts), opens)
    of_run = jnp.zeros(size, length.dtype).at[run].add(length)
    kept = used & (take(of_run, run) > _thinnest(screen))
    return Intervals(
        ends=ends,
        around=_around(key, opens, closes, levels, crossings.face, most),
        barycentric=barycentric.reshape(-1, 2, 3),
        outer=jnp.where(kept, levels - 1, 0),
        length=jnp.where(kept, length, jnp.zeros_like(length)) * screen.pixel[0],
    ), deepest


def thickness(screen: Screen) -> Float[Array, ""]:
    """The mesh's extent along the rays, in the width of a pixel."""
    depth = screen.depth.whole + screen.depth.part
    return depth.max() - depth.min()


def _thinnest(screen: Screen) -> Float[Array, ""]:
    # Twice what the sort may confuse, as on the host; in float32 that is rounding of the depth.
    rounding = max(1.0 / DEPTH_STEPS, 2.0 * float(jnp.finfo(screen.pixel.dtype).eps))
    return thickness(screen) * max(2.0 * rounding, THINNEST)


def _table(screen: Screen) -> Float[Array, "V 6"]:
    fixed = screen.column, screen.row, screen.depth
    return jnp.stack([part for one in fixed for part in one], axis=1)


def _relative(
    corners: Float[Array, "K 3 6"], axis: int, base: Float[Array, "K"]
) -> Float[Array, "K 3"]:
    return (corners[:, :, 2 * axis] - base[:, None]) + corners[:, :, 2 * axis + 1]


def _barycentric(
    corners: Float[Array, "K 3 6"], row: Float[Array, "K"], column: Float[Array, "K"]
) -> Float[Array, "K 3"]:
    x0, x1, x2 = _relative(corners, 0, column).T
    y0, y1, y2 = _relative(corners, 1, row).T
    weights = jnp.stack([x1 * y2 - y1 * x2, x2 * y0 - y2 * x0, x0 * y1 - y0 * x1])
    total = weights.sum(axis=0)
    weights = weights / jnp.where(total != 0, total, jnp.ones_like(total))[None, :]
    weights = jnp.clip(weights, 0.0, 1.0)
    # A triangle with no area on the screen was crossed by rounding alone: take its center.
    whole = weights.sum(axis=0)
    weights = weights / jnp.where(whole > 0, whole, jnp.ones_like(whole))[None, :]
    third = jnp.full_like(weights, 1.0 / 3.0)
    return jnp.where((whole > 0)[None, :], weights, third).T


def _around(key, opens, closes, levels, face, most) -> Int[Array, "N 2"]:
    # To rise to a level a ray has to pass the one below, so the nearest crossings of that level
    # before and after, on whichever ray, are on the same one.
    size = len(face)
    below = jnp.maximum((levels - 1 + most) * size + opens, 0)
    close = jnp.clip(jnp.searchsorted(key, below).astype(jnp.int32), 1, size - 1)
    found = take(face, take(key, jnp.stack([close - 1, close], axis=1)) % size)
    return jnp.where((levels > 1)[:, None], found, -1)


def kept_only(intervals: Intervals, counted: Bool[Array, "N"]) -> Intervals:
    """The intervals without the excluded ones."""
    return intervals._replace(
        outer=jnp.where(counted, intervals.outer, 0),
        length=jnp.where(counted, intervals.length, jnp.zeros_like(intervals.length)),
    )
