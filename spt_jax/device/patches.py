"""Connected patches of vertices within overlaps: each counts whole or not at all."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def only_counted(
    label: Int[Array, "V"], faces: Int[Array, "F 3"], counted: Bool[Array, "V"]
) -> Int[Array, "V"]:
    """The labels of the patches in which a vertex is counted, 0 elsewhere.

    Vertices of class not 0 that share a triangle are one patch. A counted vertex of class 0 counts
    for the patches that its triangles touch: it is a corner of a triangle cut by the rim.
    """
    inside = label != 0

    def spread(state):
        _, kept = state
        # Over triangles, from any corner to all of class not 0.
        touched = kept[faces].any(axis=1)
        wider = jnp.zeros_like(kept).at[faces.reshape(-1)].max(jnp.repeat(touched, 3))
        wider = kept | (wider & inside)
        return (wider != kept).any(), wider

    touched = counted[faces].any(axis=1)
    start = jnp.zeros_like(counted).at[faces.reshape(-1)].max(jnp.repeat(touched, 3)) & inside
    _, kept = jax.lax.while_loop(lambda state: state[0], spread, (start.any(), start))
    return jnp.where(kept, label, 0)
