"""Priors learned from poses, for the joints of a body."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2
from scipy.linalg import solve_triangular

from spt_jax.body import load_mocap
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.fit.problem.priors import GaussianPosePrior, MixturePosePrior

# No axis of a joint is held more tightly than this, in radians. The embedded motion capture never
# turns collars, wrists and feet, and bends the three spine joints alike; real people do not.
_LEAST_DEVIATION = 0.15

# Of joints that the poses do not hold, such as fingers.
_OTHER_DEVIATION = 0.3

# After these the shares of the embedded poses no longer change.
_EM_STEPS = 30


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
        >>> from spt_jax.fit import pose_prior
        >>> prior = pose_prior(load_body().joint_names)
        >>> bool(prior(prior.mean) < prior(-prior.mean))
        True
    """
    known, rows = _known_rows(joint_names, poses, pose_joints)
    mean, whitening = _gaussian(joint_names, known, rows, np.ones(len(rows)))
    return GaussianPosePrior(jnp.asarray(mean, jnp.float32), jnp.asarray(whitening, jnp.float32))


def mixture_prior(
    joint_names: Sequence[str],
    components: int = 8,
    poses: Float[np.ndarray, "N P 3"] | None = None,
    pose_joints: Sequence[str] | None = None,
) -> MixturePosePrior:
    """A mixture of Gaussians of a set of poses, for the joints of a body.

    By expectation maximization from k-means; the same poses give the same mixture. The poses are
    completed, and joints kept from being held too tightly, as `pose_prior` does it.

    Args:
        joint_names: of the body, the root first.
        components: how many Gaussians; SMPLify has 8.
        poses: axis-angle in radians, at least two; the embedded motion capture if None.
        pose_joints: names of the poses' joints; those of SMPL's layout of that many joints if None.

    Returns:
        MixturePosePrior for `joint_names`.

    Raises:
        ValueError: as `pose_prior`; components that are no whole number from 1 to that of the poses
            and their mirror images.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import mixture_prior
        >>> prior = mixture_prior(load_body().joint_names, 3)
        >>> prior.means.shape  # fit_pose(..., terms=Terms(prior=prior)) takes it
        (3, 52, 3)
    """
    known, rows = _known_rows(joint_names, poses, pose_joints)
    shares, parts = _clusters(rows, components)
    made = [_gaussian(joint_names, known, rows, part) for part in parts]
    means, whitenings = (np.stack(arrays) for arrays in zip(*made, strict=True))
    return MixturePosePrior(
        *(jnp.asarray(array, jnp.float32) for array in (shares, means, whitenings))
    )


def _known_rows(
    joint_names: Sequence[str],
    poses: Float[np.ndarray, "N P 3"] | None,
    pose_joints: Sequence[str] | None,
) -> tuple[list[int], Float[np.ndarray, "M D"]]:
    """The joints that the poses hold, and those of the poses and of their mirror images in rows."""
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

    return known, rows


def _gaussian(
    joint_names: Sequence[str],
    known: list[int],
    rows: Float[np.ndarray, "N D"],
    share: Float[np.ndarray, "N"],
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "E E"]]:
    """Mean and whitening of all joints from weighted rows of the known ones."""
    count = len(joint_names)
    mean = np.zeros((count, 3))
    middle, spread = _moments(rows, share)
    mean[known] = middle.reshape(-1, 3)
    covariance = np.eye(3 * count) * _OTHER_DEVIATION**2
    entries = np.array([3 * k + axis for k in known for axis in range(3)], np.int64)
    covariance[np.ix_(entries, entries)] = spread
    return mean, np.linalg.inv(np.linalg.cholesky(covariance[3:, 3:]))


def _moments(
    rows: Float[np.ndarray, "N D"], share: Float[np.ndarray, "N"]
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D D"]]:
    total = share.sum()
    middle = share @ rows / total
    away = rows - middle
    # Of equal shares numpy.cov's, which divides by one less than their number.
    spread = (away * share[:, None]).T @ away / max(total - share.max(), share.max())
    return middle, spread + _LEAST_DEVIATION**2 * np.eye(rows.shape[1])


def _clusters(
    rows: Float[np.ndarray, "N D"], components: int
) -> tuple[Float[np.ndarray, "C"], Float[np.ndarray, "C N"]]:
    """The components' weights, and what each row counts for in each of them."""
    whole = isinstance(components, (int, np.integer)) and not isinstance(components, bool)
    if not whole or not 1 <= components <= len(rows):
        raise ValueError(
            f"components must be a whole number from 1 to the number of poses, {len(rows)}: got "
            f"{components!r}."
        )
    if components == 1:
        return np.ones(1), np.ones((1, len(rows)))
    _, label = kmeans2(rows, components, minit="++", rng=np.random.default_rng(0))
    parts = (label[None] == np.arange(components)[:, None]) + 1e-3
    for _ in range(_EM_STEPS):
        parts = parts / parts.sum(axis=0)
        logs = np.empty_like(parts)
        for k, part in enumerate(parts):
            middle, spread = _moments(rows, part)
            factor = np.linalg.cholesky(spread)
            white = solve_triangular(factor, (rows - middle).T, lower=True)
            half = np.log(np.diag(factor)).sum()
            logs[k] = np.log(part.sum()) - half - 0.5 * (white**2).sum(axis=0)
        parts = np.exp(logs - logs.max(axis=0))
    parts = parts / parts.sum(axis=0)
    # A component without poses is no component; the least share keeps its moments finite.
    parts = np.maximum(parts, 1e-9)
    return parts.sum(axis=1) / parts.sum(), parts


def _mirrored(name: str, names: Sequence[str]) -> str:
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side) and other + name.removeprefix(side) in names:
            return other + name.removeprefix(side)
    return name
