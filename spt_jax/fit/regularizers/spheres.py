"""The paper's rival "RE + SA": spheres in place of the surface."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.regularizers._base import Regularizer, as_weights
from spt_jax.fit.spheres.model import BodySpheres
from spt_jax.fit.spheres.penalty import sphere_penalty

_CENTIMETER = 0.01


class Spheres(Regularizer):
    """Spheres in place of the surface ("RE + SA", Pons-Moll et al. 2015), in cm^2.

    Attributes:
        spheres: `BodySpheres` of the body; fitted to it if None.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Spheres
        >>> body = load_body()
        >>> shape, translation = jnp.zeros((1, body.num_shape)), jnp.zeros((1, 3))
        >>> rest = Variables(jnp.zeros((1, body.num_joints, 3)), shape, translation)
        >>> float(Spheres().prepared(body, 1).energy(body, rest, rest))  # no sphere is in another
        0.0
    """

    name: ClassVar[str] = "spheres"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(0.1, 1.0))
    spheres: BodySpheres | None = None

    def prepared(self, body: BodyModel, people: int) -> "Spheres":
        """With the spheres of the body."""
        if people > 1:
            raise ValueError(
                'regularizer must be "spt" or "none" for several people in one scene: got '
                '"spheres", which knows one body\'s own parts.'
            )
        if self.spheres is not None:
            return self
        return dataclasses.replace(self, spheres=BodySpheres.fit(body))

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Sum of squared depths of the spheres in each other, in cm^2."""
        if self.spheres is None:
            raise ValueError("spheres must be known: call prepared(body, people) first.")
        found = sphere_penalty(self.spheres, body, now.pose, now.shape, now.translation)
        return jnp.sum(found) / _CENTIMETER**2
