"""Two overlapping spheres as JAX sees them, for the tests of the penalty."""

import contextlib
import logging

import jax
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


@contextlib.contextmanager
def compiled_names():
    """What JAX compiles meanwhile."""
    names = []
    handler = logging.Handler()
    handler.emit = lambda record: names.append(record.getMessage())
    logger = logging.getLogger("jax._src.interpreters.pxla")
    propagates, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        with jax.log_compiles():
            yield names
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
