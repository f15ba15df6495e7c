"""The keypoints, the prior and the limits alone."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.regularizers._base import Regularizer, as_weights


class Nothing(Regularizer):
    """No term: the keypoints, the prior and the limits alone ("RE only")."""

    name: ClassVar[str] = "none"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(0.0,))

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Zero."""
        return jnp.zeros((), now.pose.dtype)
