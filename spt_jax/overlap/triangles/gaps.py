"""How far triangles are apart, at least: along axes that may part them."""

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.arrays.pieces import pieces
from spt_jax.overlap.triangles.box_words import STEPS, Shape

# What rounding may take from a distance of points none of whose coordinates is above one.
_ROUNDED = 1e-12


def gaps(
    shape: Shape, t: Int[np.ndarray, "N"], u: Int[np.ndarray, "N"], enough: float
) -> Float[np.ndarray, "N"]:
    """Lower bounds on the distances of pairs of triangles; not above zero where none was found.

    Two triangles that do not meet are parted along an axis of the coordinates, a normal of either,
    or an axis that is square to a side of each, or to a side and the normal.

    Args:
        shape: the triangles.
        t, u: their slots.
        enough: of pairs farther apart than this no more axes are tried.
    """
    high = (shape.high.take(x, axis=1) for x in (t, u))
    low = (shape.low.take(x, axis=1) for x in (u, t))
    steps = np.maximum.reduce([x - y for x, y in zip(low, high, strict=True)]).max(axis=0)
    found = steps * (shape.span / STEPS)
    left = np.flatnonzero(found <= enough)
    for part in pieces(len(left), 18):
        at = left[part]
        found[at] = _by_axes(shape, t[at], u[at], found[at], enough)
    return found * (1 - 1e-6) - _ROUNDED


def _by_axes(shape: Shape, t, u, gap, enough: float):
    one, other = (shape.corner.take(x, axis=2) for x in (t, u))
    for x in (t, u):
        _widen(gap, shape.normal.take(x, axis=1), one, other)
    left = np.flatnonzero(gap <= enough)
    one, other = one[:, :, left], other[:, :, left]
    for turn in (0, 1):
        some = gap[left]
        sides = [[x[:, (k + 1) % 3] - x[:, k] for k in range(3)] for x in (one, other)]
        if turn:
            axes = (cross(side, across) for side in sides[0] for across in sides[1])
        else:
            axes = (cross(cross(of[0], of[1]), side) for of in sides for side in of)
        for axis in axes:
            _widen(some, axis, one, other)
        gap[left] = some
        kept = np.flatnonzero(some <= enough)
        left, one, other = left[kept], one[:, :, kept], other[:, :, kept]
    return gap


def _widen(gap, axis, one, other) -> None:
    """The gap along the axis, where it is wider than those before."""
    length = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    at, there = (axis[0] * x[0] + axis[1] * x[1] + axis[2] * x[2] for x in (one, other))
    wide = np.maximum(_lowest(at) - _highest(there), _lowest(there) - _highest(at))
    np.maximum(gap, wide / np.where(length > 0, length, np.inf), out=gap)


def _lowest(x):
    return np.minimum(np.minimum(x[0], x[1]), x[2])


def _highest(x):
    return np.maximum(np.maximum(x[0], x[1]), x[2])
