"""Whether two triangles intersect."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def triangles_intersect(
    vertices: Float[Array, "V 3"], first: Int[Array, "N 3"], second: Int[Array, "N 3"]
) -> Bool[Array, "N"]:
    """Whether an edge of one passes through the other, pair by pair; contact is no intersection.

    An edge does not pass through a triangle with which it shares a vertex.
    """
    first_corners, second_corners = vertices[first], vertices[second]
    same = first[:, :, None] == second[:, None, :]
    found = _edges_through(first_corners, second_corners, same.any(axis=2))
    return found | _edges_through(second_corners, first_corners, same.any(axis=1))


def _edges_through(
    edges: Float[Array, "N 3 3"], triangle: Float[Array, "N 3 3"], shared: Bool[Array, "N 3"]
) -> Bool[Array, "N"]:
    found = jnp.zeros(len(edges), bool)
    a, b, c = (triangle[:, k] for k in range(3))
    normal = jnp.cross(b - a, c - a)
    side = [_dot(edges[:, k] - a, normal) for k in range(3)]
    for k in range(3):
        start, end = edges[:, k], edges[:, (k + 1) % 3]
        along = end - start
        # Six times the volumes that the edge's line spans with the triangle's sides.
        around = [_dot(along, jnp.cross(p - start, q - start)) for p, q in ((a, b), (b, c), (c, a))]
        inside = (around[0] > 0) & (around[1] > 0) & (around[2] > 0)
        inside |= (around[0] < 0) & (around[1] < 0) & (around[2] < 0)
        free = ~(shared[:, k] | shared[:, (k + 1) % 3])
        found |= free & inside & (side[k] * side[(k + 1) % 3] < 0)
    return found


def _dot(x: Float[Array, "N 3"], y: Float[Array, "N 3"]) -> Float[Array, "N"]:
    return (x * y).sum(axis=1)
