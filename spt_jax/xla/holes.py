"""Holes on the device: closed by the host's fans before the rays are cast.

The fans are known from the faces, so they are part of the program, and their centers are linear in
the vertices: JAX carries the gradient through them.
"""

import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from spt_jax.overlap.caps import LARGEST, closed_surface
from spt_jax.overlap.triangles.manifold import Manifold, manifold_of


def closed_on_device(
    vertices: Float[Array, "*batch V 3"], faces: Any, *, everything: bool
) -> tuple[Float[Array, "*batch W 3"], Any, Bool[Array, "*batch"] | None]:
    """The surface with fans in place of its holes, its own vertices and faces first.

    Args:
        vertices: positions, with any batch axes.
        faces: those given; traced ones stay as they are, holes and all.
        everything: whether every overlap counts. Tables of what does not have no rows for fans, so
            with these the holes stay open, and a warning says so.

    Returns:
        Vertices, faces, and whether a hole is too large to be closed; None where there is no hole.

    Warns:
        UserWarning: holes that stay open.
    """
    if isinstance(faces, Tracer):
        return vertices, faces, None
    given = np.asarray(faces, np.int64)
    count = vertices.shape[-2]
    manifold = manifold_of(given, count)
    if not manifold.num_fans:
        return vertices, faces, None
    if not everything:
        warnings.warn(
            f'backend="xla" leaves out rays through {manifold.num_fans} holes where groups or a '
            'rest surface are given; backend="numpy" closes them.',
            UserWarning,
            stacklevel=3,
        )
        return vertices, faces, None
    loops = manifold.loops[: manifold.num_fans]
    centers = [vertices[..., loop, :].mean(axis=-2, keepdims=True) for loop in loops]
    wider = closed_surface(manifold, np.zeros((count, 3)), given).faces
    too_large = _too_large(vertices, given, manifold)
    return jnp.concatenate([vertices, *centers], axis=-2), wider, too_large


def _too_large(vertices, faces: np.ndarray, manifold: Manifold) -> Bool[Array, "*batch"]:
    """Whether a hole is larger than what is closed, as `overlap.caps.holes_of` has it."""
    own, first = np.unique(manifold.kept, return_index=True)
    own, first = own[own >= 0], first[own >= 0]
    part = manifold.part[manifold.faces[first, 0]]
    a, b, c = (vertices[..., faces[own, k], :] for k in range(3))
    area = 0.5 * jnp.linalg.norm(jnp.cross(b - a, c - a), axis=-1)
    found = []
    for k in range(manifold.num_fans):
        loop = manifold.loops[k]
        edges = vertices[..., loop, :] - vertices[..., np.roll(loop, 1), :]
        length = jnp.linalg.norm(edges, axis=-1).sum(axis=-1)
        around = part == manifold.part[len(manifold.origin) + k]
        found.append(length**2 > LARGEST * 4 * np.pi * area[..., around].sum(axis=-1))
    return jnp.stack(found).any(axis=0)
