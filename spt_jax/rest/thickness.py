"""How thick a solid is at each vertex of its surface; NumPy and SciPy only."""

import numpy as np
import scipy
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, dot, summed

# Over the surface, what is thick makes thick what lies around it: so many lengths away, the radius
# is one length less. Tips and sharp edges, where only small balls fit, are as thick as what is
# behind them; half a metre from the trunk, an arm is as thick as an arm.
_FADING = 4.0
# A ball is found in about six steps: each is the next vertex that the last one holds.
_MOST_STEPS = 64
# Of the radius: what a ball may hold less of without being smaller.
_CLOSE = 1e-6


def local_radii(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    graph: "scipy.sparse.csr_array",
) -> Float[np.ndarray, "V"]:
    """The radius of the largest balls inside the surface that touch it around each vertex.

    A ball that touches the surface in a vertex and lies behind it shrinks until it holds no vertex
    (the shrinking ball of Ma, Bae and Choi 2012); the largest one around, less a quarter of the
    way to it along the edges, is the vertex's. 0 where no triangle has an area.

    Args:
        vertices: positions.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        graph: the edges' lengths, symmetric.
    """
    radius = np.zeros(len(vertices))
    normal = _vertex_normals(vertices, faces)
    used = np.flatnonzero(normal.any(axis=1))
    if not len(used):
        return radius
    radius[used] = _shrinking_balls(vertices[used], normal[used])
    return _spread(radius, used, graph)


def _vertex_normals(vertices, faces):
    normals = area_normals(vertices, faces)
    total = summed(faces.ravel(), np.repeat(normals, 3, axis=0), len(vertices))
    size = np.sqrt(dot(total, total))
    return total / np.where(size > 0, size, 1.0)[:, None]


def _shrinking_balls(points, normal):
    """Of each point the radius of the ball behind it that holds no other."""
    tree = scipy.spatial.cKDTree(points)
    radius = np.full(len(points), np.linalg.norm(np.ptp(points, axis=0)) / 2)
    active = np.arange(len(points))
    for _ in range(_MOST_STEPS):
        if not len(active):
            break
        center = points[active] - radius[active, None] * normal[active]
        distance, nearest = tree.query(center)
        away = points[active] - points[nearest]
        depth = dot(away, normal[active])
        held = (distance < (1 - _CLOSE) * radius[active]) & (depth > 0)
        active, away, depth = active[held], away[held], depth[held]
        radius[active] = dot(away, away) / (2 * depth)
    return radius


def _spread(radius, used, graph):
    """The largest radius around, less what lies between: one search from all vertices at once."""
    largest = radius.max()
    if not largest > 0:
        return radius
    count = len(radius)
    start = _FADING * (largest - radius[used]) / largest
    # A node behind all vertices has a way to each; sparse graphs take an entry of 0 for none.
    ways = scipy.sparse.coo_array(
        (
            np.concatenate([graph.data / largest, np.maximum(start, np.finfo(float).tiny)]),
            (
                np.concatenate(
                    [np.repeat(np.arange(count), np.diff(graph.indptr)), np.full(len(used), count)]
                ),
                np.concatenate([graph.indices, used]),
            ),
        ),
        shape=(count + 1, count + 1),
    )
    way = scipy.sparse.csgraph.dijkstra(ways.tocsr(), indices=count)[:count]
    return np.where(np.isfinite(way), largest * np.maximum(1 - way / _FADING, 0.0), 0.0)
