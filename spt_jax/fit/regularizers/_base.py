"""What a regularizer is."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables


def as_weights(weights: Any) -> Float[Array, "stages"]:
    """Weights of the stages as an array.

    Raises:
        ValueError: none at all, or negative or not finite ones.
    """
    if isinstance(weights, Tracer):  # as when a regularizer is prepared inside jit
        return jnp.atleast_1d(weights)
    return jnp.asarray(checked_weights(weights))


def checked_weights(weights: Any) -> Float[np.ndarray, "stages"]:
    """Weights of the stages that are known.

    Raises:
        ValueError: none at all, or negative or not finite ones.
    """
    rows = np.atleast_1d(np.asarray(weights, np.float64))
    if rows.ndim != 1 or not rows.size or not np.isfinite(rows).all() or rows.min() < 0:
        raise ValueError(
            f"weights must be finite and not negative, one for each stage: got {weights!r}."
        )
    return rows


class Regularizer(eqx.Module):
    """A term that `fit_pose` adds to the keypoints' in stages, its weight rising.

    Make your own by deriving from it: `energy` gets the parameters of one or several people, with
    one leading axis, in the world's axes, and is differentiated in reverse mode under jit.

    Attributes:
        weights: one for each stage, against a reprojection term in which a keypoint that is off by
            its expected error counts 1.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Regularizer, as_weights
        >>> class Still(Regularizer):
        ...     name = "still"
        ...     weights: jax.Array = eqx.field(converter=as_weights, default=(1.0, 10.0))
        ...
        ...     def energy(self, body, start, now):
        ...         return jnp.sum((now.pose - start.pose) ** 2)
        >>> body = load_body()  # fit_pose(body, ..., regularizer=Still()) takes it
        >>> people = Variables(jnp.zeros((2, 52, 3)), jnp.zeros((2, 10)), jnp.zeros((2, 3)))
        >>> float(Still().energy(body, people, people))
        0.0
    """

    name: ClassVar[str]
    weights: eqx.AbstractVar[Float[Array, "stages"]]

    def prepared(self, body: BodyModel, people: int) -> "Regularizer":
        """Itself with what it has to know of the body; called outside jit."""
        del body, people
        return self

    @abstractmethod
    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """The term without its weight.

        Args:
            body: the model.
            start: the parameters (N, ...) before the first stage.
            now: the parameters (N, ...).
        """
