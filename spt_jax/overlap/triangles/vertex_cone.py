"""Which side of its own triangles a direction takes from a vertex."""

import numpy as np
from jaxtyping import Bool, Float, Int


def within_cone(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sample: Int[np.ndarray, "S"],
    step: Float[np.ndarray, "3"],
) -> tuple[Bool[np.ndarray, "S"], Bool[np.ndarray, "S"]]:
    """Whether a step from the vertex along a unit vector leads to the inner side of its triangles.

    And whether they have an inner side: not on the rim of a hole.

    The nearest part of their cone decides by the side that it shows: a triangle, an edge with the
    sum of its normals, or the apex with the sum of all, weighed by their angles (Baerentzen and
    Aanaes 2005, https://doi.org/10.1109/TVCG.2005.49).
    """
    index = np.full(len(vertices), -1)
    index[sample] = np.arange(len(sample))
    corners = faces.ravel()
    of = index[corners]
    corner = np.flatnonzero(of >= 0)
    of, turn = of[corner], corner % 3
    apex = vertices[corners[corner]]
    after = corners[corner + np.array([1, 1, -2])[turn]]
    before = corners[corner + np.array([2, -1, -1])[turn]]
    # Around the vertex what is after it in one triangle is before it in the next.
    closed = np.bincount(of, after - before, len(sample)) == 0
    e, f = vertices[after] - apex, vertices[before] - apex
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    f /= np.linalg.norm(f, axis=1, keepdims=True)
    normal = np.cross(e, f)
    sin, cos = np.linalg.norm(normal, axis=1), np.einsum("ki,ki->k", e, f)
    height = normal @ step / sin
    along_e, along_f = e @ step, f @ step
    beside = (along_e > cos * along_f) & (along_f > cos * along_e)
    along = np.maximum(np.maximum(along_e, along_f), 0.0)
    distance = np.where(beside, height**2, 1.0 - along**2)  # squared
    nearest = np.full(len(sample), np.inf)
    np.fmin.at(nearest, of, distance)
    height *= np.where(distance < 1.0, 1.0, np.arctan2(sin, cos))
    # Both triangles of an edge have the same distance but for rounding. NaN, of a triangle
    # without area, is nobody's nearest part.
    deciding = (distance <= nearest[of] * (1 + 1e-9)) & np.isfinite(height)
    return np.bincount(of, np.where(deciding, height, 0.0), len(sample)) < 0, closed
