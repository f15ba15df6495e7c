"""The parameters of a body, as fits exchange them."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


class Variables(NamedTuple):
    """A body's parameters: axis-angle in radians, shape coefficients, metres."""

    pose: Float[Array, "*batch J 3"]
    shape: Float[Array, "*batch B"]
    translation: Float[Array, "*batch 3"]


def rows_at(rows: Float[Array, "J 3"], joints: Sequence[int]) -> Float[Array, "M 3"]:
    """The rows of some joints; in NumPy where they are known, which needs no program."""
    known = rows if isinstance(rows, Tracer) else np.asarray(rows)
    return jnp.asarray(known[np.array(joints)])
