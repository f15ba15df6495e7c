"""Small convex solids are recognized quickly: they do not intersect themselves.

On some dozens of triangles the search for intersections is hundreds of calls of NumPy, each on next
to nothing.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import cross, dot
from spt_jax.overlap.triangles.faces_cache import FacesCache
from spt_jax.overlap.triangles.manifold import manifold_of
from spt_jax.overlap.triangles.pair_planes import ROUNDING

# Beyond, the search is hardly slower than all vertices against all planes.
_MOST_FACES = 256
# How far from one the number of times that the surface goes round its middle may seem to be.
_NEARLY = 1e-6


@dataclass(frozen=True)
class _Shape:
    """What follows from the faces: whether they are one closed surface, and its corners."""

    closed: bool
    used: Int[np.ndarray, "U"]
    corners: Int[np.ndarray, "3 F"]


def _shape(faces: Int[np.ndarray, "F 3"], count: int) -> _Shape:
    used, corners = np.unique(faces.T, return_inverse=True)
    manifold = manifold_of(faces, count)
    parts = np.unique(manifold.part[faces]) if manifold.is_given else []
    return _Shape(len(parts) == 1, used, corners.reshape(3, -1))


_shapes = FacesCache(_shape)


def is_small_convex_solid(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rounding: float
) -> bool:
    """Whether a mesh is one closed surface of few triangles, the whole of a convex solid's.

    Every vertex lies behind every triangle's plane or, but for rounding, in it, and the surface
    goes round the middle of its vertices once. Then it is the boundary of their hull, and it
    overlaps itself nowhere by more than rounding does. A `False` says nothing.

    Args:
        vertices: positions, finite.
        faces: indices of each triangle's corners.
        rounding: machine epsilon of the numbers that the vertices came in.
    """
    if not 4 <= len(faces) <= _MOST_FACES:
        return False
    shape = _shapes.of(faces, len(vertices))
    if not shape.closed:
        return False
    points = vertices[shape.used]
    points = points - points.mean(axis=0)
    size = np.abs(points).max()
    if not size > 0:
        return False
    points /= size
    a, b, c = points[shape.corners]
    normal = cross(b - a, c - a)
    length = np.sqrt(dot(normal, normal))
    # A plane is known where its triangle is not a line, to far more digits than are compared.
    if not length.min() > np.sqrt(rounding):
        return False
    normal /= length[:, None]
    offset = dot(normal, a)
    # Seen from the middle: all planes are farther out than rounding could put them.
    if not offset.min() > np.sqrt(rounding):
        return False
    if (points @ normal.T - offset).max() > max(ROUNDING, rounding):
        return False
    return bool(abs(_turns(a, b, c) - 1) < _NEARLY)


def _turns(a, b, c) -> float:
    """How often triangles go round the origin (van Oosterom and Strackee 1983)."""
    p, q, r = (np.sqrt(dot(x, x)) for x in (a, b, c))
    solid = dot(a, cross(b, c))
    return float(
        np.arctan2(solid, p * q * r + dot(a, b) * r + dot(b, c) * p + dot(c, a) * q).sum()
        / (2 * np.pi)
    )
