"""Triangles x rays -> crossings, sorted by depth along each ray (paper, Algorithm 1, lines 3-11).

A list of crossings sorted along every ray of a screen is a layered depth image. Triangles are
rasterised by scanlines with half-open intervals: a row is covered by an edge when
ceil(y0) <= row < ceil(y1), a column by a span when ceil(x_left) <= column < ceil(x_right), and an
edge's x is computed from its two end points in an order that does not depend on the triangle. A
span is the difference of its triangle's two active edges, and the two triangles of an edge use it
with opposite signs, so the signs along any ray of a closed mesh sum to zero exactly: for rays
aimed at edges and vertices, and whatever the rounding.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.rays.beam import Beam, ScreenPoints
from spt_jax.overlap.rays.tiles import Tiles

# Depth is quantised only for the sort; below this many bits the packed key would confuse sheets
# that are a few micrometres apart on a body, and a wider two-part sort takes over.
_FEWEST_DEPTH_BITS = 20
_MOST_DEPTH_BITS = 32

# (a > b) + 2 (b > c) + 4 (a > c) -> the order of corners that sorts rows a, b, c; the codes 2 + 0
# and so on that contradict themselves cannot occur.
SORTED_CORNERS = np.array(
    [[0, 1, 2], [1, 0, 2], [0, 2, 1], [0, 1, 2], [0, 1, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
)
EVEN = np.array([True, False, False, True, True, True, True, False])


@dataclass(frozen=True)
class Crossings:
    """Crossings of one beam with a mesh, sorted by ray and then by depth.

    Attributes:
        ray: number of the ray, as in `Beam.locate`.
        face: the triangle that is crossed.
        sign: +1 where the ray enters (the triangle faces it), -1 where it leaves.
        depth_quantum: two crossings nearer than this may stand in the wrong order.
        open_rays: rays whose signs do not sum to zero, because the mesh has a hole there. They
            are dropped: nothing on them can be classified.
        met: crossings in all, those that are left out counted.
    """

    ray: Int[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    sign: Int[np.ndarray, "N"]
    depth_quantum: float
    open_rays: int
    met: int


def cast(
    beam: Beam, points: ScreenPoints, faces: Int[np.ndarray, "F 3"], *, simple_rays: bool = True
) -> Crossings:
    """The crossings of the beam's rays with the triangles, sorted along each ray.

    Without `simple_rays`, rays that are seen to meet no overlap before anything is sorted are left
    out: those that enter and leave the mesh once or twice, in that order.
    """
    near = points.depth.min(initial=np.inf)
    thickness = points.depth.max(initial=-np.inf) - near
    spans = (
        _spans(points, faces) if beam.tiles is None else _spans_within(beam.tiles, points, faces)
    )

    face_bits = max(len(faces) - 1, 1).bit_length()
    ray_bits = beam.num_rays.bit_length()
    depth_bits = min(_MOST_DEPTH_BITS, 62 - ray_bits - face_bits)
    packed = depth_bits >= _FEWEST_DEPTH_BITS
    if not packed:
        depth_bits = min(40, 62 - ray_bits)
    steps = float((1 << depth_bits) - 1)
    per_unit = steps / thickness if thickness > 0 else 0.0

    # One repeat, then takes: np.repeat costs three times a take.
    of_span = np.repeat(np.arange(len(spans.width)), spans.width)
    step = np.arange(len(of_span)) - (np.cumsum(spans.width) - spans.width)[of_span]
    ray = beam.number(spans.row, spans.first_column)[of_span] + step
    depth = ((spans.first_depth - near) * per_unit)[of_span]
    depth += (spans.depth_step * per_unit)[of_span] * step
    np.clip(depth, 0.0, steps, out=depth)

    open_rays, kept = _worth_sorting(
        beam.num_rays, ray, depth, spans.leaves.astype(np.int64)[of_span], simple_rays
    )
    met = len(ray)
    if kept is not None:
        of_span, ray, depth = of_span[kept], ray[kept], depth[kept]

    # At equal depth a ray enters before it leaves; either order makes a gap of no length.
    if packed:
        # Packed into one integer, nothing has to be gathered after the sort.
        fixed = (spans.leaves.astype(np.int64) << face_bits) | spans.face
        key = fixed[of_span]
        key += ray << (depth_bits + 1 + face_bits)
        key += depth.astype(np.int64) << (1 + face_bits)
        key = key.view(np.uint64)
        key.sort()
        key = key.view(np.int64)
        ray = key >> (depth_bits + 1 + face_bits)
        sign = 1 - 2 * ((key >> face_bits) & 1)
        face = key & ((1 << face_bits) - 1)
    else:
        key = (ray << depth_bits) | depth.astype(np.int64)
        leaves = spans.leaves[of_span]
        order = np.lexsort((leaves, key))
        ray = key[order] >> depth_bits
        face = spans.face[of_span][order]
        sign = 1 - 2 * leaves[order].astype(np.int64)
    return Crossings(ray, face, sign, 1.0 / per_unit if per_unit else 0.0, open_rays, met)


def _worth_sorting(num_rays: int, ray, depth, leaves, simple_rays: bool):
    """The number of open rays, and which crossings to keep (None: all).

    Decided per ray from counts and from the first and last depth of entries and exits, before the
    sort, which costs more than all of this.
    """
    # A screen with far more rays than crossings is not worth arrays of its size.
    if num_rays > 8 * len(ray) + (1 << 20):
        used, ray = np.unique(ray, return_inverse=True)
        num_rays = len(used)
    entry_or_exit = 2 * ray + leaves
    entries, exits = np.bincount(entry_or_exit, minlength=2 * num_rays).reshape(-1, 2).T
    is_open = entries != exits
    open_rays = int(np.count_nonzero(is_open))
    if simple_rays:
        return open_rays, np.flatnonzero(~is_open[ray]) if open_rays else None
    first, last = np.full(2 * num_rays, np.inf), np.full(2 * num_rays, -np.inf)
    np.minimum.at(first, entry_or_exit, depth)
    np.maximum.at(last, entry_or_exit, depth)
    (first_entry, first_exit), (last_entry, last_exit) = (
        first.reshape(-1, 2).T,
        last.reshape(-1, 2).T,
    )
    # Two passes overlap if both entries lie before both exits; a ray that starts with an exit or
    # ends with an entry meets an inverted part; of three passes and more nothing is known yet.
    kept = (entries > 2) | ((entries == 2) & (last_entry < first_exit))
    kept |= (first_exit < first_entry) | (last_exit < last_entry)
    return open_rays, np.flatnonzero((kept & ~is_open)[ray])


@dataclass(frozen=True)
class _Spans:
    """Runs of columns in which one triangle covers one row."""

    face: Int[np.ndarray, "S"]
    row: Int[np.ndarray, "S"]
    first_column: Int[np.ndarray, "S"]
    width: Int[np.ndarray, "S"]
    leaves: np.ndarray
    first_depth: Float[np.ndarray, "S"]
    depth_step: Float[np.ndarray, "S"]


def _spans_within(tiles: Tiles, points: ScreenPoints, faces: Int[np.ndarray, "F 3"]) -> _Spans:
    # All triangles that touch a tile are there, so signs cancel on every ray of the tile.
    face = tiles.touched_by(points.row, points.column, faces)
    spans = _spans(points, faces[face])
    span, first_column, width = tiles.clip(spans.row, spans.first_column, spans.width)
    depth_step = spans.depth_step[span]
    skipped = first_column - spans.first_column[span]
    return _Spans(
        face=face[spans.face[span]],
        row=spans.row[span],
        first_column=first_column,
        width=width,
        leaves=spans.leaves[span],
        first_depth=spans.first_depth[span] + skipped * depth_step,
        depth_step=depth_step,
    )


def _spans(points: ScreenPoints, faces: Int[np.ndarray, "F 3"]) -> _Spans:
    first_row = np.ceil(points.row).astype(np.int64)
    a, b, c = first_row[faces[:, 0]], first_row[faces[:, 1]], first_row[faces[:, 2]]
    face = np.flatnonzero((a != b) | (b != c))  # the others lie between two rows
    code = ((a > b) + 2 * (b > c) + 4 * (a > c))[face]
    corners = faces.ravel()[3 * face + SORTED_CORNERS[code].T]  # (3, F): low, mid, high
    even = EVEN[code]
    x, y, z = points.column[corners], points.row[corners], points.depth[corners]
    low, mid, high = first_row[corners]

    # Three edges a triangle, each from its lower to its higher end: low-high, low-mid, mid-high.
    # The ends' order depends on their rows alone, so both triangles of an edge compute the same x.
    edge_x, edge_y, edge_z = (np.stack([w[0], w[0], w[1]]) for w in (x, y, z))
    run, rise, fall = (np.stack([w[2] - w[0], w[1] - w[0], w[2] - w[1]]) for w in (x, y, z))
    # An edge between two lattice rows covers none of them, so its slope is never used.
    rise[1, mid == low] = rise[2, high == mid] = 1.0
    slope_x, slope_z = (run / rise).ravel(), (fall / rise).ravel()
    edge_x, edge_y, edge_z = edge_x.ravel(), edge_y.ravel(), edge_z.ravel()

    count = high - low
    of_face = np.repeat(np.arange(len(face)), count)
    row = np.arange(len(of_face)) + (low - (np.cumsum(count) - count))[of_face]
    long = of_face
    short = of_face + len(face) * (1 + (row >= mid[of_face]))

    rise_long, rise_short = row - edge_y[long], row - edge_y[short]
    x_long = edge_x[long] + rise_long * slope_x[long]
    x_short = edge_x[short] + rise_short * slope_x[short]
    column_long = np.ceil(x_long).astype(np.int64)
    signed_width = np.ceil(x_short).astype(np.int64) - column_long
    kept = np.flatnonzero(signed_width)
    of_face, row, long, short = of_face[kept], row[kept], long[kept], short[kept]
    x_long, x_short, signed_width = x_long[kept], x_short[kept], signed_width[kept]

    # Interpolating between the edges, never extrapolating the plane, keeps the depth inside the
    # triangle's own range however steeply it grazes the rays.
    z_long = edge_z[long] + rise_long[kept] * slope_z[long]
    z_short = edge_z[short] + rise_short[kept] * slope_z[short]
    depth_step = (z_short - z_long) / (x_short - x_long)
    first_column = column_long[kept] + np.minimum(signed_width, 0)
    return _Spans(
        face=face[of_face],
        row=row,
        first_column=first_column,
        width=np.abs(signed_width),
        # An even order of (low, mid, high) is counter-clockwise, and faces the rays, when the
        # short edges are on the right. The columns decide, not the normal: that is what makes
        # the signs of a ray cancel exactly.
        leaves=(signed_width > 0) != even[of_face],
        first_depth=z_long + (first_column - x_long) * depth_step,
        depth_step=depth_step,
    )
