"""Which side of its own triangles a direction takes from a vertex.

The nearest part of their cone decides by the side that it shows: a triangle, an edge with the
sum of its normals, or the apex with the sum of all, weighed by their angles (Baerentzen and
Aanaes 2005, https://doi.org/10.1109/TVCG.2005.49).
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def within_cone(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], step: Float[Array, "3"]
) -> tuple[Bool[Array, "V"], Bool[Array, "V"]]:
    """Whether a step from each vertex leads to the inner side of its triangles.

    And whether they have an inner side: not on the boundary of a hole.
    """
    num = len(vertices)
    of = faces.T.reshape(-1)
    after, before = (jnp.roll(faces.T, turn, axis=0).reshape(-1) for turn in (-1, 1))
    # Around the vertex what is after it in one triangle is before it in the next.
    closed = jnp.zeros(num, jnp.int32).at[of].add(after - before) == 0
    apex = vertices[of]
    e, f = _unit(vertices[after] - apex), _unit(vertices[before] - apex)
    normal = jnp.cross(e, f)
    sin, cos = jnp.sqrt((normal * normal).sum(axis=1)), (e * f).sum(axis=1)
    height, along_e, along_f = ((w * step[None, :]).sum(axis=1) for w in (normal, e, f))
    height = height / jnp.where(sin > 0, sin, jnp.ones_like(sin))
    beside = (along_e > cos * along_f) & (along_f > cos * along_e)
    along = jnp.maximum(jnp.maximum(along_e, along_f), 0.0)
    distance = jnp.where(beside, height**2, 1.0 - along**2)  # squared
    # A triangle without area is nobody's nearest part.
    distance = jnp.where(sin > 0, distance, jnp.inf)
    nearest = jnp.full(num, jnp.inf, vertices.dtype).at[of].min(distance)
    weighed = height * jnp.where(distance < 1.0, jnp.ones_like(sin), jnp.arctan2(sin, cos))
    # Both triangles of an edge have the same distance but for rounding.
    slack = 16 * float(jnp.finfo(vertices.dtype).eps)
    deciding = (distance <= nearest[of] * (1 + slack)) & (sin > 0)
    side = jnp.zeros(num, vertices.dtype).at[of].add(jnp.where(deciding, weighed, 0.0))
    return side < 0, closed


def _unit(vectors: Float[Array, "K 3"]) -> Float[Array, "K 3"]:
    norm = jnp.sqrt((vectors * vectors).sum(axis=1, keepdims=True))
    return vectors / jnp.where(norm > 0, norm, jnp.ones_like(norm))
