"""Connected patches of the surface within overlaps: what is known of one vertex holds for all."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def spread(
    seeds: Bool[Array, "V"], members: Bool[Array, "V"], faces: Int[Array, "F 3"]
) -> Bool[Array, "V"]:
    """The members that a path over triangles connects with a seed, through members alone.

    A seed that is no member passes on to the members of its triangles: it is a corner of a triangle
    that an intersection contour cuts.
    """

    def over_triangles(vertices):
        touched = vertices[faces].any(axis=1)
        wider = jnp.zeros_like(vertices).at[faces.reshape(-1)].max(jnp.repeat(touched, 3))
        return wider & members

    def step(state):
        _, reached = state
        wider = reached | over_triangles(reached)
        return (wider != reached).any(), wider

    start = (seeds & members) | over_triangles(seeds)
    return jax.lax.while_loop(lambda state: state[0], step, (start.any(), start))[1]
