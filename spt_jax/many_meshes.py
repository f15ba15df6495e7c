"""Functions of a list of meshes, asked for a batch of any shape, also under `vmap`."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

# function(vertices (N, V, 3), faces (1 or N, F, 3)) -> a pytree of arrays (N, ...)
ManyMeshes = Callable[[Array, Array], Any]


def as_more_meshes(function: ManyMeshes) -> ManyMeshes:
    """The function, under `vmap` called once with the lanes as more meshes of the same list.

    Without this, `vmap` would give every lane arrays of its own, and all of them at once.
    """
    mapped = jax.custom_batching.custom_vmap(function)

    @mapped.def_vmap
    def batched(axis_size, in_batched, vertices, faces):
        vertices_batched, faces_batched = in_batched
        if not vertices_batched:
            vertices = jnp.broadcast_to(vertices[None], (axis_size, *vertices.shape))
        num_meshes = vertices.shape[1]
        if faces_batched or faces.shape[0] > 1:
            if not faces_batched:
                faces = faces[None]
            faces = jnp.broadcast_to(faces, (axis_size, num_meshes, *faces.shape[-2:]))
            faces = faces.reshape(axis_size * num_meshes, *faces.shape[-2:])
        found = mapped(vertices.reshape(axis_size * num_meshes, *vertices.shape[2:]), faces)
        found = jax.tree.map(lambda x: x.reshape(axis_size, num_meshes, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return mapped


def over_batch(
    function: ManyMeshes,
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
) -> Any:
    """The function of every mesh of the batch, which share their faces; without a derivative."""
    batch = vertices.shape[:-2]
    flat = jax.lax.stop_gradient(vertices).reshape(math.prod(batch), *vertices.shape[-2:])
    found = function(flat, jax.lax.stop_gradient(faces)[None])
    return jax.tree.map(lambda x: x.reshape(batch + x.shape[1:]), found)
