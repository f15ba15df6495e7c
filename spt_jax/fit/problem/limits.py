"""The ranges of the joints, and what it costs to leave them."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.fit.problem.variables import rows_at

# Beyond a range, one unit of cost for the square of this angle, in radians.
_LIMIT_SCALE = 0.1

_FREE = (-np.inf, np.inf)
# Ranges of the axis-angle components in radians, in SMPL's axes (x to the body's left, y up, z
# forward) and from its T-pose, of left joints and of those in the middle: what hinges allow
# (an elbow bends about y, a knee about x, and neither the other way), and wide bounds that keep
# the trunk, head, wrists and feet from turning round. Hips and shoulders have ranges that
# components cannot say; only how far they turn out and about the bone is bounded.
_LEFT_RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "hip": ((-2.6, 0.8), (-0.9, 1.2), (-0.8, 1.2)),
    "knee": ((-0.05, 2.6), (-0.3, 0.3), (-0.2, 0.2)),
    "ankle": ((-0.9, 0.8), (-0.6, 0.7), (-0.7, 0.7)),
    "foot": ((-0.8, 0.5), (-0.2, 0.2), (-0.2, 0.2)),
    "collar": ((-0.3, 0.3), (-0.5, 0.3), (-0.3, 0.6)),
    "shoulder": ((-1.9, 1.6), (-2.2, 1.2), (-1.7, 1.5)),
    "elbow": ((-0.8, 0.8), (-2.6, 0.05), (-0.4, 0.4)),
    "wrist": ((-0.9, 0.9), (-0.7, 0.7), (-1.3, 1.3)),
}
_MIDDLE_RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "spine1": ((-0.5, 0.8), (-0.5, 0.5), (-0.5, 0.5)),
    "spine2": ((-0.5, 0.8), (-0.5, 0.5), (-0.5, 0.5)),
    "spine3": ((-0.5, 0.8), (-0.5, 0.5), (-0.5, 0.5)),
    "neck": ((-0.7, 0.8), (-0.8, 0.8), (-0.6, 0.6)),
    "head": ((-0.7, 0.7), (-0.8, 0.8), (-0.6, 0.6)),
}


class JointLimits(eqx.Module):
    """Ranges of the joints' axis-angle components, with a cost beyond them.

    The cost is the sum of ((angle beyond the range) / 0.1 rad)^2. `joint_limits` has a body's.

    Attributes:
        low, high: in radians, one row a joint; infinite where there is no bound.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.fit.problem.limits import JointLimits
        >>> limits = JointLimits(jnp.full((2, 3), -0.5), jnp.full((2, 3), 0.5))
        >>> pose = jnp.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])  # 0.1 rad beyond
        >>> print(f"{limits(pose):.2f}")
        1.00
    """

    low: Float[Array, "J 3"]
    high: Float[Array, "J 3"]

    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "J 3"]:
        """Angles beyond the range in units of 0.1 rad; their squares sum to the cost."""
        low, high = self.low.astype(pose.dtype), self.high.astype(pose.dtype)
        return (pose - jnp.clip(pose, low, high)) / _LIMIT_SCALE

    def __call__(self, pose: Float[Array, "J 3"]) -> Float[Array, ""]:
        """The cost of a pose; differentiates in reverse and forward mode."""
        return jnp.sum(self.residuals(pose) ** 2)

    def of_joints(self, joints: Sequence[int]) -> "JointLimits":
        """The ranges of some joints."""
        return JointLimits(rows_at(self.low, joints), rows_at(self.high, joints))


def joint_limits(
    joint_names: Sequence[str],
    ranges: Mapping[str, Sequence[tuple[float, float]]] | None = None,
) -> JointLimits:
    """The ranges of a body's joints, by their SMPL names; other joints are free.

    Knees and elbows bend one way; trunk, head, wrists and feet have wide bounds.

    Args:
        joint_names: of the body, the root first.
        ranges: for some joints, three (low, high) pairs in radians, about x, y and z, in place of
            the table's.

    Raises:
        ValueError: a joint that the body lacks, or a range that is not low <= high, three times.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.problem.limits import joint_limits
        >>> names = load_body().joint_names
        >>> print(joint_limits(names).high[names.index("left_knee")])
        [2.6 0.3 0.2]
    """
    bounds = np.array([_range_of(name) for name in joint_names], np.float32)
    for name, given in (ranges or {}).items():
        if name not in joint_names:
            raise ValueError(f"ranges must name joints of the body: got {name!r}.")
        rows = np.asarray(given, np.float32)
        if rows.shape != (3, 2) or not (rows[:, 0] <= rows[:, 1]).all():
            raise ValueError(
                f"ranges must be three (low, high) pairs in radians: got {given!r} for {name!r}."
            )
        bounds[list(joint_names).index(name)] = rows
    return JointLimits(jnp.asarray(bounds[..., 0]), jnp.asarray(bounds[..., 1]))


def _range_of(name: str) -> tuple[tuple[float, float], ...]:
    side, _, part = name.partition("_")
    if side in ("left", "right") and part in _LEFT_RANGES:
        x, y, z = _LEFT_RANGES[part]
        if side == "left":
            return x, y, z
        return x, (-y[1], -y[0]), (-z[1], -z[0])
    return _MIDDLE_RANGES.get(name, (_FREE, _FREE, _FREE))
