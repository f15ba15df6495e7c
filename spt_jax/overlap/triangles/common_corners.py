"""Triangles of different parts with corners in one place, kept apart by a plane through these.

Where flush sides are meshed alike, most of the triangles that are near each other have a corner or
two in the very same place, and each of their signs is a tie. But the push that decides ties
(`predicates.py`) moves the two surfaces' vertices apart there by eps times a difference that is
known, so one plane can show that the pushed triangles have nothing in common:

       \\   |             |   /            all of the first is above d.x = 0 but for corners that
        \\ p|             |q /             lie on it, all of the second below; and the corners on
         \\ |             | /              it are pushed apart along d:
          \\|             |/
           x  eps d ->   x'                      min d.push(x) > max d.push(x')

The direction d is any vector for which that holds of the exact coordinates. For one common corner
it runs between the two triangles; for two it is a product e x m of the edge between them and some
m, so that the edge lies in the plane exactly, whatever rounding says of d; for three it is the
normal. Heights and pushes are compared with room for rounding, so a pair that is said to be apart
is, and pairs of which nothing can be said are left to the signs.
"""

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.triangles.determinants import largest_of
from spt_jax.overlap.triangles.pair_planes import dot
from spt_jax.overlap.triangles.predicates import Predicates

# Far above what rounding adds to products with a direction whose length is `_TILT` or so.
_ROUNDING = 1e-12
# How far directions lean to the normal, along which vertices are pushed. Heights above a flat side
# that was turned in float32 are 1e-6 of its triangles' size: they allow for much more.
_TILT = 8.0
# Pairs that are sampled to estimate how often corners lie in one place.
_SAMPLE, _COMMON = 128, 0.05


def are_common(predicates: Predicates, first: Int[np.ndarray, "3 N"], second) -> bool:
    """Whether many of these pairs of triangles have a corner in one place.

    Args:
        predicates: has the vertices.
        first, second: (3, N), corners.
    """
    step = max(first.shape[1] // _SAMPLE, 1)
    alike = _alike(predicates.points, first[:, ::step], second[:, ::step])
    return float(alike.any(axis=(0, 1)).mean()) > _COMMON


def apart(predicates: Predicates, first: Int[np.ndarray, "3 N"], second) -> Bool[np.ndarray, "N"]:
    """Which pairs of triangles are shown to have nothing in common once vertices are pushed.

    Args:
        predicates: has the vertices and their pushes.
        first, second: (3, N), corners.
    """
    alike = _alike(predicates.points, first, second)
    of_first, of_second = alike.any(axis=1), alike.any(axis=0)
    count = alike.sum(axis=(0, 1))
    # Of a triangle without an area, one corner may lie in the place of several.
    count[(of_first.sum(axis=0) != count) | (of_second.sum(axis=0) != count)] = 0
    found = np.zeros(first.shape[1], bool)
    for common, test in enumerate((_by_corner, _by_edge, _by_normal), 1):
        some = np.flatnonzero(count == common)
        if len(some):
            # The corner that is like no other one comes first: the common one of one, or the one
            # that is not of two.
            lone = [of[:, some] == (common == 1) for of in (of_first, of_second)]
            corners = [_from(x[:, some], at) for x, at in zip((first, second), lone, strict=True)]
            found[some] = test(predicates, *corners)
    return found


def _alike(points, first, second):
    """(3, 3, N), which corners of the first triangle lie in which places of the second's."""
    p, q = points.take(first, axis=1), points.take(second, axis=1)
    alike = p[0][:, None] == q[0]
    for k in (1, 2):
        alike &= p[k][:, None] == q[k]
    return alike


def _from(corners, chosen):
    """The corners in turn, from the chosen one on."""
    start = np.where(chosen[0], 0, np.where(chosen[1], 1, 2))
    column = np.arange(corners.shape[1])
    return np.stack([corners[(start + k) % 3, column] for k in range(3)])


def _by_corner(predicates: Predicates, first, second):
    """Of triangles with one common corner, which comes first."""
    x = predicates.points.take(first[0], axis=1)
    arms = [
        [predicates.points.take(corner, axis=1) - x for corner in corners[1:]]
        for corners in (first, second)
    ]
    gap = predicates.push.take(first[0], axis=1) - predicates.push.take(second[0], axis=1)
    with np.errstate(all="ignore"):
        (p, q), (r, s) = arms
        middle = _unit(_unit(p) + _unit(q)) - _unit(_unit(r) + _unit(s))
        normal = _unit(cross(p, q))
        d = middle + _TILT * np.sign(dot(normal, gap)) * normal
        found = dot(d, gap) > _ROUNDING * largest_of(gap)
        for arm in (p, q):
            found &= dot(d, arm) > _ROUNDING * largest_of(arm)
        for arm in (r, s):
            found &= dot(d, arm) < -_ROUNDING * largest_of(arm)
    return found


def _by_edge(predicates: Predicates, first, second):
    """Of triangles with two common corners, which come last."""
    x, y = (predicates.points.take(corner, axis=1) for corner in first[1:])
    e = y - x
    p, q = (predicates.points.take(corners[0], axis=1) - x for corners in (first, second))
    pushes, others = ([predicates.push.take(k, axis=1) for k in of[1:]] for of in (first, second))
    gap = (pushes[0] + pushes[1]) - (others[0] + others[1])
    with np.errstate(all="ignore"):
        normal = _unit(cross(e, p))
        inward, square = cross(normal, e), dot(e, e)
        lean = _TILT * np.sign(dot(normal, gap)) / square
        d = cross(e, lean * inward - normal / np.sqrt(square))
        found = dot(d, p) > _ROUNDING * largest_of(p)
        found &= dot(d, q) < -_ROUNDING * largest_of(q)
        found &= _pushed_apart(d, pushes, others, _ROUNDING)
    return found


def _by_normal(predicates: Predicates, first, second):
    """Of triangles all of whose corners are common."""
    x, y, z = (predicates.points.take(corner, axis=1) for corner in first)
    pushes, others = ([predicates.push.take(k, axis=1) for k in of] for of in (first, second))
    d = cross(y - x, z - x)
    room = _ROUNDING * largest_of(y - x) * largest_of(z - x)
    return _pushed_apart(d, pushes, others, room) | _pushed_apart(d, others, pushes, room)


def _pushed_apart(d, pushes, others, room):
    """Whether all of the pushes lead farther along d than all of the others."""
    least = np.minimum.reduce([dot(d, push) for push in pushes])
    most = np.maximum.reduce([dot(d, push) for push in others])
    largest = np.maximum.reduce([largest_of(push) for push in (*pushes, *others)])
    return least - most > room * largest


def _unit(x):
    return x / np.sqrt(dot(x, x))
