"""Hands as the family of SMPL has them: a mean pose and principal components of finger rotations.

Romero, Tzionas, Black 2017, "Embodied Hands": the axis-angle vectors of a hand's 15 joints, one
after the other, are `mean + coefficients @ components`.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Hand(eqx.Module):
    """The hand components of a model.

    Attributes:
        side: "left" or "right".
        joints: the rows of a pose that are this hand's, in the components' order.
        components: one row for each component, 3 numbers for each joint, in radians.
        mean: the mean pose, in radians.
    """

    side: str = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    components: Float[Array, "C P"]
    mean: Float[Array, "P"]

    def __check_init__(self):
        width = 3 * len(self.joints)
        if self.side not in ("left", "right"):
            raise ValueError(f'side must be "left" or "right": got {self.side!r}.')
        if self.components.ndim != 2 or self.components.shape[1] != width:
            raise ValueError(
                f"components must have shape (C, {width}), 3 numbers for each of "
                f"{len(self.joints)} joints: got {tuple(self.components.shape)}."
            )
        if self.mean.shape != (width,):
            raise ValueError(f"mean must have shape ({width},): got {tuple(self.mean.shape)}.")

    def pose(self, coefficients: Float[Array, "*batch K"], flat: bool) -> Float[Array, "..."]:
        """Rotations (..., joints, 3) of the first K components; without the mean where `flat`."""
        dtype = coefficients.dtype
        used = self.components[: coefficients.shape[-1]].astype(dtype)
        rows = jnp.sum(
            coefficients[..., :, None] * used.reshape(_ones(coefficients) + used.shape), -2
        )
        if not flat:
            rows = rows + self.mean.astype(dtype).reshape(_ones(coefficients) + self.mean.shape)
        return rows.reshape(*rows.shape[:-1], len(self.joints), 3)


def _ones(coefficients) -> tuple[int, ...]:
    return (1,) * (coefficients.ndim - 1)


def posed_hands(
    hands: Sequence[Hand],
    pose: Float[Array, "*#batch J 3"],
    left: Float[Array | np.ndarray, "*#batch K"] | None,
    right: Float[Array | np.ndarray, "*#batch L"] | None,
    flat: bool,
) -> Float[Array, "..."]:
    """The pose with its fingers as the coefficients say; see `BodyModel.with_hands`."""
    given = {"left": left, "right": right}
    known = {hand.side: hand for hand in hands}
    for side, value in given.items():
        if value is None:
            continue
        if side not in known:
            has = f"has those of the {' and '.join(known)} hand" if known else "has none"
            raise ValueError(
                f"{side} must be None for a body without components of that hand: this body {has}; "
                "give the rotations of the finger joints in pose."
            )
        coefficients = jnp.asarray(value)
        if not jnp.issubdtype(coefficients.dtype, jnp.floating):
            raise TypeError(f"{side} must be floating-point: got dtype {coefficients.dtype}.")
        hand, count = known[side], coefficients.shape[-1] if coefficients.ndim else 0
        if not 0 < count <= len(hand.components):
            raise ValueError(
                f"{side} must hold 1 to {len(hand.components)} coefficients in its last axis: got "
                f"shape {tuple(coefficients.shape)}."
            )
        fingers = hand.pose(coefficients.astype(pose.dtype), flat)
        batch = jnp.broadcast_shapes(pose.shape[:-2], fingers.shape[:-2])
        pose = jnp.broadcast_to(pose, (*batch, *pose.shape[-2:]))
        fingers = jnp.broadcast_to(fingers, (*batch, *fingers.shape[-2:]))
        pose = pose.at[..., np.array(hand.joints), :].set(fingers)
    return pose
