"""Functions of a list of meshes, asked for a batch of any shape, also under `vmap`."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

# function(vertices (N, V, 3), faces (1 or N, F, 3), shared) -> a pytree of arrays (N, ...)
ManyMeshes = Callable[[Array, Array, Any], Any]


def as_more_meshes(function: ManyMeshes) -> ManyMeshes:
    """Wrap a function so that `vmap` folds its axis into the leading mesh axis and calls it once.

    Without this, `vmap` would allocate the arrays of all lanes at once. What all meshes share is
    not batched.
    """
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def batched(axis_size, in_batched, vertices, faces, shared):
        meshes = lanes_as_meshes(axis_size, in_batched[:2], vertices, faces)
        found = mapped(*meshes, shared)
        found = jax.tree.map(lambda x: x.reshape(axis_size, -1, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return mapped


def lanes_as_meshes(
    size: int, batched: Sequence[bool], vertices: Any, faces: Any = None
) -> tuple[Array, ...]:
    """Vertices (N, V, 3) and faces (1 or N, F, 3) of every lane as those of one longer list.

    Args:
        size: how many lanes there are.
        batched: which of the two have a leading axis for the lanes.
        vertices: of N meshes.
        faces: theirs; None: not asked for.
    """
    if not batched[0]:
        vertices = jnp.broadcast_to(vertices[None], (size, *vertices.shape))
    count = vertices.shape[1]
    vertices = vertices.reshape(size * count, *vertices.shape[2:])
    if faces is None:
        return (vertices,)
    if batched[1] or faces.shape[0] > 1:
        if not batched[1]:
            faces = faces[None]
        faces = jnp.broadcast_to(faces, (size, count, *faces.shape[-2:]))
        faces = faces.reshape(size * count, *faces.shape[-2:])
    return vertices, faces


def over_batch(
    function: ManyMeshes,
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
    shared: Any,
) -> Any:
    """The function of every mesh of the batch, which share their faces; without a derivative."""
    batch = vertices.shape[:-2]
    flat = jax.lax.stop_gradient(vertices).reshape(math.prod(batch), *vertices.shape[-2:])
    found = function(flat, jax.lax.stop_gradient(faces)[None], shared)
    return jax.tree.map(lambda x: x.reshape(batch + x.shape[1:]), found)
