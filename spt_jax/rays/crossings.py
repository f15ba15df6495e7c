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

from spt_jax.rays.beam import Beam, ScreenPoints

# Depth is quantised only for the sort; below this many bits the packed key would confuse sheets
# that are a few micrometres apart on a body, and a wider two-part sort takes over.
_FEWEST_DEPTH_BITS = 20
_MOST_DEPTH_BITS = 32

# (a > b) + 2 (b > c) + 4 (a > c) -> the order of corners that sorts rows a, b, c; the codes 2 + 0
# and so on that contradict themselves cannot occur.
_SORTED_CORNERS = np.array(
    [[0, 1, 2], [1, 0, 2], [0, 2, 1], [0, 1, 2], [0, 1, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
)
_EVEN = np.array([True, False, False, True, True, True, True, False])


@dataclass(frozen=True)
class Crossings:
    """Crossings of one beam with a mesh, sorted by ray and then by depth.

    Attributes:
        ray: flat index row * columns + column of the ray.
        face: the triangle that is crossed.
        sign: +1 where the ray enters (the triangle faces it), -1 where it leaves.
        depth_quantum: two crossings nearer than this may stand in the wrong order.
        open_rays: rays whose signs do not sum to zero, because the mesh has a hole there. They
            are dropped: nothing on them can be classified.
    """

    ray: Int[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    sign: Int[np.ndarray, "N"]
    depth_quantum: float
    open_rays: int


def cast(beam: Beam, points: ScreenPoints, faces: Int[np.ndarray, "F 3"]) -> Crossings:
    """All crossings of the beam's rays with the triangles, sorted along each ray."""
    near = points.depth.min(initial=0.0)
    thickness = points.depth.max(initial=near) - near
    spans = _spans(points, faces)

    columns = beam.shape[1]
    face_bits = max(len(faces) - 1, 1).bit_length()
    ray_bits = (beam.shape[0] * columns).bit_length()
    depth_bits = min(_MOST_DEPTH_BITS, 62 - ray_bits - face_bits)
    packed = depth_bits >= _FEWEST_DEPTH_BITS
    if not packed:
        depth_bits = min(40, 62 - ray_bits)
    steps = float((1 << depth_bits) - 1)
    per_unit = steps / thickness if thickness > 0 else 0.0

    # One repeat, then takes: np.repeat costs three times a take (DESIGN, section 1).
    of_span = np.repeat(np.arange(len(spans.width)), spans.width)
    step = np.arange(len(of_span)) - (np.cumsum(spans.width) - spans.width)[of_span]
    first_ray = spans.row * columns + spans.first_column
    quantised = ((spans.first_depth - near) * per_unit)[of_span]
    quantised += (spans.depth_step * per_unit)[of_span] * step
    np.clip(quantised, 0.0, steps, out=quantised)

    # At equal depth a ray enters before it leaves; either order makes a gap of no length.
    if packed:
        fixed = (first_ray << (depth_bits + 1 + face_bits)) | (
            (spans.leaves.astype(np.int64) << face_bits) | spans.face
        )
        key = fixed[of_span]
        key += step << (depth_bits + 1 + face_bits)
        key += quantised.astype(np.int64) << (1 + face_bits)
        # Packed into one integer, nothing has to be gathered after the sort: 1.2 ms for 160,000
        # crossings, where an argsort takes about 4 ms.
        key = key.view(np.uint64)
        key.sort()
        key = key.view(np.int64)
        ray = key >> (depth_bits + 1 + face_bits)
        sign = 1 - 2 * ((key >> face_bits) & 1)
        face = key & ((1 << face_bits) - 1)
    else:
        key = ((first_ray[of_span] + step) << depth_bits) | quantised.astype(np.int64)
        order = np.lexsort((spans.leaves[of_span], key))
        ray = key[order] >> depth_bits
        face = spans.face[of_span][order]
        sign = 1 - 2 * spans.leaves[of_span][order].astype(np.int64)
    return _without_open_rays(ray, face, sign, 1.0 / per_unit if per_unit else 0.0)


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


def _spans(points: ScreenPoints, faces: Int[np.ndarray, "F 3"]) -> _Spans:
    x, y, z = points.column, points.row, points.depth
    first_row = np.ceil(y).astype(np.int64)
    a, b, c = first_row[faces].T
    code = (a > b) + 2 * (b > c) + 4 * (a > c)
    face = np.flatnonzero((a != b) | (b != c))  # the others lie between two rows
    code = code[face]
    low, mid, high = np.take_along_axis(faces[face], _SORTED_CORNERS[code], axis=1).T
    even = _EVEN[code]

    # Three edges a triangle, each from its lower to its higher end: low-high, low-mid, mid-high.
    start = np.stack([low, low, mid], axis=1)
    end = np.stack([high, mid, high], axis=1)
    rise = y[end] - y[start]
    # An edge between two lattice rows covers none of them, so its slope is never used.
    inverse_rise = 1.0 / np.where(first_row[end] > first_row[start], rise, 1.0)
    edge_x, edge_y, edge_z = x[start].ravel(), y[start].ravel(), z[start].ravel()
    slope_x = ((x[end] - x[start]) * inverse_rise).ravel()
    slope_z = ((z[end] - z[start]) * inverse_rise).ravel()

    count = first_row[high] - first_row[low]
    of_face = np.repeat(np.arange(len(face)), count)
    row = np.arange(len(of_face)) + (first_row[low] - (np.cumsum(count) - count))[of_face]
    long = 3 * of_face
    short = long + 1 + (row >= first_row[mid][of_face])

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


def _without_open_rays(ray, face, sign, depth_quantum: float) -> Crossings:
    open_rays = 0
    if len(ray):
        first = np.flatnonzero(np.concatenate([[True], ray[1:] != ray[:-1]]))
        is_open = np.add.reduceat(sign, first) != 0
        open_rays = int(np.count_nonzero(is_open))
        if open_rays:
            closed = ~np.repeat(is_open, np.diff(np.append(first, len(ray))))
            ray, face, sign = ray[closed], face[closed], sign[closed]
    return Crossings(ray, face, sign, depth_quantum, open_rays)
