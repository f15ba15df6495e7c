"""Pairs of triangles against each other's planes: which may cross, and which touch."""

import numpy as np

from spt_jax.overlap.triangles.pair_boxes import Shape, cross
from spt_jax.overlap.triangles.pair_layout import Layout

# Relative to the size of what is multiplied, far above float64's rounding.
ROUNDING = 1e-14
# A vertex beside a triangle by less than this part of its size, in the same plane, is on it.
_BESIDE = 1e-3
# Nearer than this part of the mesh's longest side is on the same spot, as `_THINNEST` in
# `vertex_winding.py`: no screen shows the mesh larger by more than the root of three.
_CONTACT = 2e-7


def not_apart(layout: Layout, shape: Shape, t, u):
    """The pairs that neither's plane keeps apart, and vertices that lie on the other triangle."""
    contacts = []
    for turn in (0, 1):
        x, y = (t, u) if turn else (u, t)
        height, margin = _heights(shape, shape.corner.take(x, axis=2), shape.extent.take(x), y)
        reach = _CONTACT * shape.span * shape.length.take(y)
        np.maximum(margin, reach, out=margin)
        kept = np.flatnonzero((height.min(axis=0) <= margin) & (height.max(axis=0) >= -margin))
        height, reach = height.take(kept, axis=1), reach.take(kept)
        near = np.flatnonzero(np.abs(height).min(axis=0) <= reach)
        if len(near):
            x, y = x[kept[near]], y[kept[near]]
            contacts.append(_contacts(layout, shape, x, y, reach[near]))
        t, u = t[kept], u[kept]
    return t, u, np.concatenate(contacts) if contacts else np.zeros(0, np.int64)


def _contacts(layout: Layout, shape: Shape, x, y, reach):
    """The corners of triangles x that lie on triangles y, not only in the same plane."""
    points, normal = shape.corner.take(x, axis=2), shape.normal.take(y, axis=1)
    on = np.abs(_heights(shape, points, shape.extent.take(x), y)[0]) <= reach
    a, b, c = shape.corner.take(y, axis=2).transpose(1, 0, 2)
    sense, square = layout.sense.take(y), dot(normal, normal)
    for start, end in ((a, b), (b, c), (c, a)):
        along = cross(normal, end - start) * sense
        inward = dot(along[:, None], points - start[:, None])
        on &= inward >= -_BESIDE * square
    corner, pair = np.nonzero(on)
    return layout.corners[corner, x[pair]]


def straddles(shape: Shape, points, extent, slot):
    """Whether points (3, N, M) lie on both sides of the planes of M triangles, or may."""
    height, margin = _heights(shape, points, extent, slot)
    return (height.min(axis=0) <= margin) & (height.max(axis=0) >= -margin)


def _heights(shape: Shape, points, extent, slot):
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
