"""Pairs of triangles against each other's planes: which may intersect, and which may touch."""

import numpy as np

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.triangles.box_words import Shape
from spt_jax.overlap.triangles.pair_layout import Layout

# Relative to the size of what is multiplied, far above float64's rounding.
ROUNDING = 1e-14


def not_apart(layout: Layout, shape: Shape, t, u, reach: float):
    """The pairs that neither's plane keeps apart; and those with a corner in the other's plane.

    Args:
        reach: how near to a plane a corner lies in it.

    Returns:
        The slots t and u of the pairs; and (2, N), slots with such a corner, and of such a plane.
    """
    near_corners = []
    together = np.zeros(len(t), bool)  # in one plane, and not apart in it
    for turn in (0, 1):
        x, y = (t, u) if turn else (u, t)
        height, margin = heights(shape, shape.corner.take(x, axis=2), shape.extent.take(x), y)
        near = reach * shape.length.take(y)
        np.maximum(margin, near, out=margin)
        kept = np.flatnonzero((height.min(axis=0) <= margin) & (height.max(axis=0) >= -margin))
        height, margin, near = height.take(kept, axis=1), margin.take(kept), near.take(kept)
        together = together.take(kept)
        flat = np.flatnonzero((np.abs(height).max(axis=0) <= margin) & ~together)
        if len(flat):
            # Nearly all of a flat side's are apart in its plane.
            apart = _apart_in_plane(layout, shape, x[kept[flat]], y[kept[flat]], reach)
            together[flat] = True
            gone = flat[apart]
            kept, height, near = (np.delete(of, gone, axis=-1) for of in (kept, height, near))
            together = np.delete(together, gone)
        on = np.flatnonzero(np.abs(height).min(axis=0) <= near)
        near_corners.append(np.stack([x[kept[on]], y[kept[on]]]))
        t, u = t[kept], u[kept]
    return t, u, np.concatenate(near_corners, axis=1)


def _apart_in_plane(layout: Layout, shape: Shape, x, y, reach: float):
    """Which pairs of triangles in one plane are parted by the line of a side of either."""
    apart = np.zeros(len(x), bool)
    for own, other in ((x, y), (y, x)):
        normal, length = shape.normal.take(own, axis=1), shape.length.take(own)
        sense, points = layout.sense.take(own), shape.corner.take(other, axis=2)
        corner = shape.corner.take(own, axis=2)
        extent = shape.extent.take(own) + shape.extent.take(other)
        for k in range(3):
            start = corner[:, k]
            side = corner[:, (k + 1) % 3] - start
            inward = dot(cross(normal, side)[:, None] * sense, points - start[:, None])
            size = np.sqrt(dot(side, side)) * length
            apart |= inward.max(axis=0) < -np.maximum(reach, ROUNDING * extent) * size
    return apart


def heights(shape: Shape, points, extent, slot):
    """Heights of points (3, N, M) above the planes of M triangles, and what rounding may add."""
    normal, corner = shape.normal.take(slot, axis=1), shape.corner[:, 0].take(slot, axis=1)
    height = normal[0] * (points[0] - corner[0])
    height += normal[1] * (points[1] - corner[1])
    height += normal[2] * (points[2] - corner[2])
    own = shape.extent.take(slot)
    return height, ROUNDING * own * own * (own + extent)


def dot(x, y):
    """Dot products of the columns."""
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
