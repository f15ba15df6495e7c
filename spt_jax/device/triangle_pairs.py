"""Whether two triangles pass through each other."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def cross_each_other(
    vertices: Float[Array, "V 3"], first: Int[Array, "N 3"], second: Int[Array, "N 3"]
) -> Bool[Array, "N"]:
    """Whether an edge of one goes through the other, pair by pair; contact is no crossing."""
    first_corners, second_corners = vertices[first], vertices[second]
    found = _edges_through(first_corners, second_corners)
    return found | _edges_through(second_corners, first_corners)


def _edges_through(edges: Float[Array, "N 3 3"], triangle: Float[Array, "N 3 3"]):
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
        found |= inside & (side[k] * side[(k + 1) % 3] < 0)
    return found


def _dot(x: Float[Array, "N 3"], y: Float[Array, "N 3"]) -> Float[Array, "N"]:
    return (x * y).sum(axis=1)
