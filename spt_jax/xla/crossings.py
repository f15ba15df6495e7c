"""Triangles x rays -> crossings, sorted along each ray, in arrays of fixed size.

The same half-open scanlines as `overlap.rays.crossings`, with the same guarantee: both triangles of
an edge compute its column at a row by one formula from the same numbers, so the signs along a ray
of a closed mesh sum to zero whatever the rounding. Places on the screen are relative to the start
of their edge, which keeps float32 exact to a millionth of a pixel for triangles of some pixels.

A screen is worked off in strips of rows, each as high as the arrays allow. First the triangles of a
strip are cut into segments of one row, then the segments into crossings. Three numbers per ray show
which rays may meet an overlap, most often one in ten; only their crossings are sorted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.rays.levels import NARROWEST
from spt_jax.overlap.rays.scanlines import EVEN, SORTED_CORNERS
from spt_jax.xla.arrays import cumulative_sum, expand, indices, last_within, take
from spt_jax.xla.beam import Screen

# Depths are sorted as whole numbers of this many steps, exact in float32, with a bit to spare.
DEPTH_STEPS = 2**29 - 2**7
_BEYOND = 2**30


class Rows(NamedTuple):
    """The triangles of a beam as they are cut by rows.

    Attributes:
        low, mid, high: the first rows at or above their corners, in that order.
        facing: for each triangle, 0 or 1 for even, the order (low, mid, high) going around as
            the triangle does; 2 more where it is a line on the screen.
        shape: the numbers of `_SHAPE`, by triangle.
        before: how many segments there are before each row of the screen.
    """

    low: Int[Array, "F"]
    mid: Int[Array, "F"]
    high: Int[Array, "F"]
    facing: Int[Array, "F"]
    shape: Float[Array, "F K"]
    before: Int[Array, "R"]


class Segments(NamedTuple):
    """Runs of columns in which one triangle covers one row."""

    face: Int[Array, "S"]
    row: Int[Array, "S"]
    first_column: Int[Array, "S"]
    width: Int[Array, "S"]
    leaves: Int[Array, "S"]
    narrow: Int[Array, "S"]
    depth: Float[Array, "S"]  # at the first column; both in DEPTH_STEPS
    slope: Float[Array, "S"]


class Crossings(NamedTuple):
    """The crossings of the rays that may meet an overlap, sorted by ray and then by depth.

    Attributes:
        ray: row and column of the strip as one number.
        face: the triangle that is crossed.
        sign: +1 where the ray enters, -1 where it leaves, 0 at unused places.
    """

    ray: Int[Array, "M"]
    face: Int[Array, "M"]
    sign: Int[Array, "M"]


def cut_by_rows(screen: Screen, faces: Int[Array, "F 3"], num_rows: int) -> Rows:
    """The triangles of a beam, ready to be cut into segments."""
    first_row = (screen.row.whole + jnp.ceil(screen.row.part)).astype(jnp.int32)
    first_row = jnp.clip(first_row, 0, num_rows)
    rows = take(first_row, faces)
    a, b, c = rows[:, 0], rows[:, 1], rows[:, 2]
    ab, bc, ac = (w.astype(jnp.int32) for w in (a > b, b > c, a > c))
    code = ab + 2 * bc + 4 * ac
    order = jnp.asarray(SORTED_CORNERS, jnp.int32)[code]
    low, mid, high = jnp.take_along_axis(rows, order, axis=1).T
    corners = jnp.take_along_axis(faces, order, axis=1).T  # (3, F)

    coordinates = [w for fixed in (screen.column, screen.row, screen.depth) for w in fixed]
    points = take(jnp.stack(coordinates, axis=1), corners)  # (3, F, 6)
    x_whole, x_part, y_whole, y_part, z_whole, z_part = jnp.moveaxis(points, 2, 0)

    def between(whole, part, start, end):
        return (whole[end] - whole[start]) + (part[end] - part[start])

    def along_edges(whole, part):  # low-high, low-mid, mid-high
        ends = ((0, 2), (0, 1), (1, 2))
        return jnp.stack([between(whole, part, *end) for end in ends])

    run, rise, fall = (
        along_edges(x_whole, x_part),
        along_edges(y_whole, y_part),
        along_edges(z_whole, z_part),
    )
    twice_area = jnp.abs(run[0] * rise[1] - run[1] * rise[0])
    size = jnp.abs(run[:2]).sum(axis=0) + jnp.abs(rise[:2]).sum(axis=0)
    narrow = twice_area <= NARROWEST * size
    covered = jnp.stack([high - low, mid - low, high - mid]) > 0
    # An edge between two rows covers none of them, so its slope is never used.
    rise = jnp.where(covered, rise, jnp.ones_like(rise))
    slope_x, slope_z = run / rise, fall / rise
    shape = jnp.stack(
        [
            *(x_whole[0], x_part[0], y_whole[0], y_part[0]),
            *(x_whole[1], x_part[1], y_whole[1], y_part[1]),
            *(*slope_x, *slope_z, fall[1], z_whole[0] + z_part[0]),
        ],
        axis=1,
    )
    facing = jnp.asarray(EVEN.astype(np.int32))[code] + 2 * narrow.astype(jnp.int32)
    change = jnp.zeros(num_rows + 1, jnp.int32).at[low].add(1).at[high].add(-1)
    before = cumulative_sum(cumulative_sum(change))
    before = jnp.concatenate([jnp.zeros(1, jnp.int32), before[:-1]])
    return Rows(low, mid, high, facing, shape, before)


def cut_into_segments(
    rows: Rows, begin: Int[Array, ""], end: Int[Array, ""], per_unit: Float[Array, ""], size: int
) -> Segments:
    """The segments of the rows from `begin` to before `end`, in `size` places.

    Args:
        rows: the triangles.
        begin, end: rows of the screen.
        per_unit: DEPTH_STEPS for a depth of one pixel.
        size: of the arrays. Places that are not used have no width.
    """
    first = jnp.clip(rows.low, begin, end)
    face, step, used = expand(jnp.clip(rows.high, begin, end) - first, size)
    row = take(first, face) + step
    shape = take(rows.shape, face).T
    upper = row >= take(rows.mid, face)
    start = jnp.where(upper[None, :], shape[4:8], shape[0:4])
    start_z = jnp.where(upper, shape[14], jnp.zeros_like(shape[14]))
    slope_x = jnp.where(upper, shape[10], shape[9])
    slope_z = jnp.where(upper, shape[13], shape[12])

    # The long edge of one triangle is a short edge of the next: one formula for both, and no
    # multiply-add, which a compiler may form in one place and not in another.
    x_whole, x_part, y_whole, y_part = jnp.stack([shape[0:4], start], axis=1)  # (2, S) each
    rise = (row.astype(shape.dtype)[None, :] - y_whole) - y_part
    run = jax.lax.optimization_barrier(rise * jnp.stack([shape[8], slope_x]))
    x = jax.lax.optimization_barrier(x_part + run)
    z = rise * jnp.stack([shape[11], slope_z]) + jnp.stack([jnp.zeros_like(start_z), start_z])
    columns = (x_whole + jnp.ceil(x)).astype(jnp.int32)
    signed_width = jnp.where(used, columns[1] - columns[0], 0)

    # Interpolated between the edges, never extrapolated from the plane.
    first_column = jnp.minimum(columns[0], columns[1])
    across = (x_whole[1] - x_whole[0]) + (x[1] - x[0])
    slope = (z[1] - z[0]) / jnp.where(across != 0, across, jnp.ones_like(across))
    skipped = (first_column.astype(x.dtype) - x_whole[0]) - x[0]
    depth = shape[15] + (z[0] + skipped * slope)
    facing = take(rows.facing, face)
    return Segments(
        face=face,
        row=row,
        first_column=first_column,
        width=jnp.abs(signed_width),
        leaves=((signed_width > 0) ^ (facing % 2 == 1)).astype(jnp.int32),
        narrow=facing // 2,
        depth=depth * per_unit,
        slope=slope * per_unit,
    )


class Strip(NamedTuple):
    """The screen's rows from `begin` to before `end`, each `columns` wide in arrays by ray."""

    begin: Int[Array, ""]
    end: Int[Array, ""]
    columns: int


def cast(
    segments: Segments, strip: Strip, num_rows: int, sizes: tuple[int, int]
) -> tuple[Crossings, Int[Array, ""], Int[Array, ""], Int[Array, "2"]]:
    """The crossings of a strip that are worth sorting, sorted.

    Args:
        segments: of the strip.
        strip: its rows.
        num_rows: rows of the largest screen.
        sizes: places for crossings, and for those that are sorted.

    Returns:
        The crossings, the row before which they end, how many rays are open, meeting a hole,
        and how many crossings, and how many of those sorted, the fullest of these rows has.
    """
    row = jnp.clip(segments.row - strip.begin, 0, num_rows - 1)
    per_row = jnp.zeros(num_rows, jnp.int32).at[row].add(segments.width)
    total = jnp.concatenate([jnp.zeros(1, jnp.int32), cumulative_sum(per_row)])
    height = last_within(total, jnp.int32(0), sizes[0])
    width = jnp.where(row < height, segments.width, 0)
    of, step, used = expand(width, sizes[0])

    num_rays = num_rows * strip.columns
    first_ray = row * strip.columns + segments.first_column
    ray = take(first_ray, of) + step
    depth = take(segments.depth, of)
    depth = depth + take(segments.slope, of) * step.astype(depth.dtype)
    depth = jnp.clip(depth, 0.0, float(DEPTH_STEPS)).astype(jnp.int32)
    code = take(4 * segments.face + 2 * segments.narrow + segments.leaves, of)
    worth, is_open = _worth_sorting(num_rays, ray, depth, code, used)

    # Of these rays, as many rows as there is room for.
    by_row = worth.reshape(num_rows, strip.columns).sum(axis=1, dtype=jnp.int32)
    total_worth = jnp.concatenate([jnp.zeros(1, jnp.int32), cumulative_sum(by_row)])
    height = jnp.minimum(height, last_within(total_worth, jnp.int32(0), sizes[1]))
    sought = used & (ray < height * strip.columns) & (take(worth, ray) > 0)
    kept = indices(sought, sizes[1])
    valid = kept < sizes[0]
    kept = jnp.minimum(kept, sizes[0] - 1)
    ray = jnp.where(valid, take(ray, kept), num_rays)
    # At equal depth a ray enters before it leaves, and then by triangle: nothing is left to chance.
    depth, code = take(depth, kept), take(code, kept)
    ray, depth, face = jax.lax.sort((ray, 2 * depth + code % 2, code // 4), num_keys=3)
    sign = jnp.where(ray < num_rays, 1 - 2 * (depth % 2), 0)
    rows_done = jnp.arange(num_rows, dtype=jnp.int32) < height
    is_open = is_open.reshape(num_rows, strip.columns) & rows_done[:, None]
    fullest = jnp.stack([jnp.where(rows_done, n, 0).max() for n in (per_row, by_row)])
    open_rays = is_open.sum(dtype=jnp.int32)
    return Crossings(ray, face, sign), strip.begin + height, open_rays, fullest


def _worth_sorting(
    num_rays: int,
    ray: Int[Array, "N"],
    depth: Int[Array, "N"],
    code: Int[Array, "N"],
    used: Bool[Array, "N"],
) -> tuple[Int[Array, "R"], Bool[Array, "R"]]:
    """How many crossings of each ray to sort, and which rays are open.

    As `overlap.rays.crossings._worth_sorting`: of the others, entries and exits and the depths of
    the first and the last of each show that they meet no overlap.
    """
    entry_or_exit = jnp.where(used, 2 * ray + code % 2, 2 * num_rays)
    # A triangle seen edge-on is met by rounding alone: nothing on its rays can be determined.
    farthest = jnp.where(code // 2 % 2 == 1, _BEYOND, depth)
    zeros = jnp.zeros(2 * num_rays, jnp.int32)
    count = zeros.at[entry_or_exit].add(1, mode="drop", wrap_negative_indices=False).reshape(-1, 2)
    first = (
        (zeros + _BEYOND)
        .at[entry_or_exit]
        .min(depth, mode="drop", wrap_negative_indices=False)
        .reshape(-1, 2)
    )
    last = (
        (zeros - 1)
        .at[entry_or_exit]
        .max(farthest, mode="drop", wrap_negative_indices=False)
        .reshape(-1, 2)
    )
    entries, exits = count[:, 0], count[:, 1]
    kept = (entries > 2) | ((entries == 2) & (last[:, 0] < first[:, 1]))
    kept |= (first[:, 1] < first[:, 0]) | (last[:, 1] < last[:, 0])
    is_open = entries != exits
    kept &= ~is_open & (last.max(axis=1) < _BEYOND)
    return jnp.where(kept, entries + exits, 0), is_open
