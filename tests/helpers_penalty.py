"""Two overlapping spheres as JAX sees them, for the tests of the penalty."""

import jax.numpy as jnp
import numpy as np
from helpers import join, sphere

from spt_jax import self_intersection_penalty

PAIR = join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2))
FACES = PAIR[1].astype(np.int32)
HALF = len(PAIR[0]) // 2


def loss(vertices, faces=FACES):
    return self_intersection_penalty(vertices, faces, rays=48)


def as_jax(mesh, dtype):
    return jnp.asarray(mesh[0], dtype)
