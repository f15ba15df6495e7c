"""What a pose is likely to be: a Gaussian learned from poses, and the ranges of the joints."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax.body import load_mocap
from spt_jax.body.poses import SMPL_LAYOUTS

# No axis of a joint is held more tightly than this, in radians. The embedded motion capture never
# turns collars, wrists and feet, and bends the three spine joints alike; real people do not.
_LEAST_DEVIATION = 0.15

# Of joints that the poses do not hold, such as fingers.
_OTHER_DEVIATION = 0.3

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


class GaussianPosePrior(eqx.Module):
    """A Gaussian over the joint rotations of a body, the root left out.

    Its cost is the squared Mahalanobis distance from the mean: twice the negative logarithm of the
    density, less a constant. `pose_prior` makes one for a body from poses.

    Attributes:
        mean: axis-angle of every joint, in radians; the root's is zero and does not count.
        whitening: W with W^T W the inverse covariance of all joints but the root.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.terms.priors import pose_prior
        >>> prior = pose_prior(load_body().joint_names)
        >>> float(prior(prior.mean)), bool(prior(prior.mean + 0.1) > 0)
        (0.0, True)
    """

    mean: Float[Array, "J 3"]
    whitening: Float[Array, "D D"]

    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "D"]:
        """Deviations in units of the standard deviation; their squares sum to the cost."""
        away = (pose - self.mean.astype(pose.dtype))[1:].reshape(-1)
        return self.whitening.astype(pose.dtype) @ away

    def __call__(self, pose: Float[Array, "J 3"]) -> Float[Array, ""]:
        """The cost of a pose; differentiates in every mode."""
        return jnp.sum(self.residuals(pose) ** 2)

    def of_joints(self, joints: Sequence[int]) -> "GaussianPosePrior":
        """The Gaussian of some joints, the root first, whatever the others do."""
        rows = np.array([3 * (k - 1) + axis for k in joints if k for axis in range(3)], np.int32)
        # What is known needs no program: XLA took 0.7 s for what NumPy does in a millisecond.
        traced = isinstance(self.whitening, Tracer)
        xp, whitening = (jnp, self.whitening) if traced else (np, np.float64(self.whitening))
        inverse = xp.linalg.inv(whitening)
        covariance = (inverse @ inverse.T)[rows[:, None], rows[None, :]]
        smaller = xp.linalg.inv(xp.linalg.cholesky(covariance))
        return GaussianPosePrior(_at(self.mean, joints), jnp.asarray(smaller, self.whitening.dtype))


def pose_prior(
    joint_names: Sequence[str],
    poses: Float[np.ndarray, "N P 3"] | None = None,
    pose_joints: Sequence[str] | None = None,
) -> GaussianPosePrior:
    """The Gaussian of a set of poses, for the joints of a body.

    The set is completed by its mirror image, so that left and right are alike. Joints that the
    poses never turn keep a deviation of 0.15 rad an axis, joints that they lack 0.3 rad about rest.

    Args:
        joint_names: of the body, the root first.
        poses: axis-angle in radians, at least two; the embedded motion capture if None.
        pose_joints: names of the poses' joints; those of SMPL's layout of that many joints if None.

    Returns:
        GaussianPosePrior for `joint_names`.

    Raises:
        ValueError: fewer than two poses, another shape than (N, P, 3), values that are not finite,
            or a number of joints that needs `pose_joints`.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.terms.priors import pose_prior
        >>> prior = pose_prior(load_body().joint_names)
        >>> bool(prior(prior.mean) < prior(-prior.mean))
        True
    """
    if poses is None:
        mocap = load_mocap()
        poses, pose_joints = mocap.pose, mocap.joints
    poses = np.asarray(poses, np.float64)
    if poses.ndim != 3 or poses.shape[-1] != 3 or len(poses) < 2:
        raise ValueError(
            f"poses must have shape (N, P, 3) with N of at least 2: got {poses.shape}; give "
            "axis-angle rows."
        )
    if not np.isfinite(poses).all():
        raise ValueError("poses must be finite: got values that are not; leave such poses out.")
    if pose_joints is None:
        if poses.shape[1] not in SMPL_LAYOUTS:
            raise ValueError(
                f"pose_joints must name the joints of poses: got none for {poses.shape[1]} joints; "
                f"it may be left out for {sorted(SMPL_LAYOUTS)}."
            )
        pose_joints = SMPL_LAYOUTS[poses.shape[1]]
    if len(pose_joints) != poses.shape[1]:
        raise ValueError(
            f"pose_joints must name every joint of poses: got {len(pose_joints)} names for "
            f"{poses.shape[1]} joints."
        )
    # Mirrored in the plane x = 0: the other side's joint, turned the other way about y and z.
    other = [pose_joints.index(_mirrored(name, pose_joints)) for name in pose_joints]
    both = np.concatenate([poses, poses[:, other] * [1.0, -1.0, -1.0]])
    known = [k for k, name in enumerate(joint_names) if k and name in pose_joints]
    rows = both[:, [pose_joints.index(joint_names[k]) for k in known]].reshape(len(both), -1)

    count = len(joint_names)
    mean = np.zeros((count, 3))
    mean[known] = rows.mean(axis=0).reshape(-1, 3)
    covariance = np.eye(3 * count) * _OTHER_DEVIATION**2
    entries = np.array([3 * k + axis for k in known for axis in range(3)], np.int64)
    spread = np.cov(rows, rowvar=False).reshape(len(entries), len(entries))
    covariance[np.ix_(entries, entries)] = spread + _LEAST_DEVIATION**2 * np.eye(len(entries))
    whitening = np.linalg.inv(np.linalg.cholesky(covariance[3:, 3:]))
    return GaussianPosePrior(jnp.asarray(mean, jnp.float32), jnp.asarray(whitening, jnp.float32))


def _mirrored(name: str, names: Sequence[str]) -> str:
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side) and other + name.removeprefix(side) in names:
            return other + name.removeprefix(side)
    return name


class JointLimits(eqx.Module):
    """Ranges of the joints' axis-angle components, with a cost beyond them.

    The cost is the sum of ((angle beyond the range) / 0.1 rad)^2. `joint_limits` has a body's.

    Attributes:
        low, high: in radians, one row a joint; infinite where there is no bound.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.fit.terms.priors import JointLimits
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
        return JointLimits(_at(self.low, joints), _at(self.high, joints))


def _at(rows: Float[Array, "J 3"], joints: Sequence[int]) -> Float[Array, "M 3"]:
    known = rows if isinstance(rows, Tracer) else np.asarray(rows)
    return jnp.asarray(known[np.array(joints)])


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
        >>> from spt_jax.fit.terms.priors import joint_limits
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
