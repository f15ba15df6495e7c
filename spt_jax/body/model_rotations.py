"""Rotations as the models of body-models write them."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spt_jax.body.rotations import matrix_from_axis_angle

MATRICES = ("rotmat", "matrix")
"""Kinds of rotations that are 3 x 3."""

# Axis angles of body-models have no derivative at zero (version 0.26): a millionth of a radian in
# place of none turns nothing that could be seen.
_NO_TURN, _HARDLY = 1e-12, 1e-6


def axis_of(kind: str) -> int:
    """Which axis of a list of rotations runs over them."""
    return -3 if kind in MATRICES else -2


def as_rotation(vectors: Float[Array, "*batch 3"], kind: str) -> Float[Array, "..."]:
    """Axis angles as rotations of another kind."""
    if kind in MATRICES:
        return matrix_from_axis_angle(vectors)
    from nanomanifold import SO3

    none = jnp.sum(vectors**2, axis=-1, keepdims=True) < _NO_TURN
    vectors = jnp.where(none, vectors + _HARDLY, vectors)
    with as_written():
        return SO3.convert(vectors, src="axis_angle", dst=kind, xp=jnp)  # type: ignore


@contextmanager
def as_written() -> Iterator[None]:
    """Shapes and dtypes promote as the packages expect it, whatever the caller has set."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
