"""What a pose is likely to be: a Gaussian, a mixture of them, or a function of the user's."""

from abc import abstractmethod
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax.fit.problem.variables import rows_at

#: A prior as a function: from axis-angle (J, 3) to numbers whose squares sum to the cost.
PriorFunction = Callable[[Float[Array, "J 3"]], Float[Array, "..."]]


class PosePrior(eqx.Module):
    """What a fit pays for an unlikely pose, as a sum of squares.

    Make your own by deriving from it; `residuals` is asked about whole bodies then.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.fit import PosePrior
        >>> class Straight(PosePrior):  # fit_pose(..., terms=Terms(prior=Straight())) takes it
        ...     def middle(self):
        ...         return jnp.zeros((3, 3))
        ...
        ...     def residuals(self, pose):
        ...         return pose[1:].reshape(-1)
        >>> float(Straight()(jnp.ones((3, 3))))
        6.0
    """

    @abstractmethod
    def middle(self) -> Float[Array, "J 3"]:
        """Where a search starts: axis-angle of every joint, in radians; the root's is not used."""

    @abstractmethod
    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "R"]:
        """What is unlikely of a pose; the squares sum to the cost."""

    def __call__(self, pose: Float[Array, "J 3"]) -> Float[Array, ""]:
        """The cost of a pose; differentiates as `residuals` does."""
        return jnp.sum(self.residuals(pose) ** 2)

    def of_joints(self, joints: Sequence[int]) -> "PosePrior":
        """The prior of the joints that a fit moves, the root first; the others stay."""
        return _PartOfPose(self, self.middle(), tuple(joints))

    def around(self, pose: Float[Array, "J 3"]) -> "PosePrior":
        """For a fit whose joints that do not move are those of a pose."""
        del pose
        return self


class _PartOfPose(PosePrior):
    """A prior of whole bodies that is asked about the joints that move."""

    whole: PosePrior
    held: Float[Array, "J 3"]
    joints: tuple[int, ...] = eqx.field(static=True)

    def middle(self) -> Float[Array, "M 3"]:
        return rows_at(self.held, self.joints)

    def residuals(self, pose: Float[Array, "M 3"]) -> Float[Array, "D"]:
        everything = self.held.astype(pose.dtype).at[np.array(self.joints)].set(pose)
        return self.whole.residuals(everything)

    def around(self, pose: Float[Array, "J 3"]) -> "PosePrior":
        return _PartOfPose(self.whole, pose, self.joints)


class FunctionPosePrior(PosePrior):
    """A function as a prior.

    Attributes:
        function: from axis-angle (J, 3) of the whole body to an array whose squares sum to the
            cost, such as the latent code of a network's encoder. It is traced under jit and
            differentiated in both modes. A function that holds arrays should be an equinox Module.
        mean: where a search starts.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.fit import FunctionPosePrior
        >>> prior = FunctionPosePrior(lambda pose: 2 * pose[1:], jnp.zeros((3, 3)))
        >>> float(prior(jnp.ones((3, 3))))
        24.0
    """

    function: PriorFunction
    mean: Float[Array, "J 3"]

    def middle(self) -> Float[Array, "J 3"]:
        """The mean."""
        return self.mean

    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "D"]:
        """What the function returns, in one row."""
        return jnp.asarray(self.function(pose)).reshape(-1).astype(pose.dtype)


class GaussianPosePrior(PosePrior):
    """A Gaussian over the joint rotations of a body, the root left out.

    Its cost is the squared Mahalanobis distance from the mean: twice the negative logarithm of the
    density, less a constant. `pose_prior` makes one for a body from poses.

    Attributes:
        mean: axis-angle of every joint, in radians; the root's is zero and ignored.
        whitening: W with W^T W the inverse covariance of all joints but the root.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.problem.learned_priors import pose_prior
        >>> prior = pose_prior(load_body().joint_names)
        >>> float(prior(prior.mean)), bool(prior(prior.mean + 0.1) > 0)
        (0.0, True)
    """

    mean: Float[Array, "J 3"]
    whitening: Float[Array, "D D"]

    def middle(self) -> Float[Array, "J 3"]:
        """The mean."""
        return self.mean

    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "D"]:
        """Deviations in units of the standard deviation; their squares sum to the cost."""
        away = (pose - self.mean.astype(pose.dtype))[1:].reshape(-1)
        return self.whitening.astype(pose.dtype) @ away

    def of_joints(self, joints: Sequence[int]) -> "GaussianPosePrior":
        """The Gaussian of some joints, the root first, whatever the others do."""
        mean = rows_at(self.mean, joints)
        return GaussianPosePrior(mean, _marginal(self.whitening, joints))


class MixturePosePrior(PosePrior):
    """The likeliest Gaussian of several, as SMPLify has it (Bogo et al. 2016, section 3.1).

    The cost of a pose is the least over the components k of

        Mahalanobis distance^2 from mean k - 2 log(weight k |whitening k|) + constant,

    in place of the logarithm of the sum, and the constant makes the likeliest pose cost nothing.
    `mixture_prior` makes one from poses.

    Attributes:
        weights: of the components, summing to 1.
        means: axis-angle of every joint, in radians.
        whitenings: W with W^T W the inverse covariance of all joints but the root.

    Differentiation: every mode, of the component that is the least.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.fit import MixturePosePrior
        >>> means = jnp.zeros((2, 2, 3)).at[1, 1, 0].set(2.0)
        >>> prior = MixturePosePrior(jnp.full(2, 0.5), means, jnp.stack([jnp.eye(3)] * 2))
        >>> [float(prior(pose)) for pose in (means[0], means[1], means[1] + 0.5)]
        [0.0, 0.0, 0.75]
    """

    weights: Float[Array, "C"]
    means: Float[Array, "C J 3"]
    whitenings: Float[Array, "C D D"]

    def middle(self) -> Float[Array, "J 3"]:
        """The mean of all components."""
        return jnp.einsum("c,cjk->jk", self.weights.astype(self.means.dtype), self.means)

    @property
    def offsets(self) -> Float[Array, "C"]:
        """What a component's own mean costs; 0 for the likeliest."""
        scale = jnp.linalg.slogdet(self.whitenings)[1]
        logarithms = jnp.log(self.weights.astype(scale.dtype)) + scale
        return 2 * (jnp.max(logarithms) - logarithms)

    def residuals(self, pose: Float[Array, "J 3"]) -> Float[Array, "R"]:
        """Deviations from the least component, and the root of what its mean costs."""
        away = (pose[None] - self.means.astype(pose.dtype))[:, 1:].reshape(len(self.means), -1)
        rows = jnp.einsum("cij,cj->ci", self.whitenings.astype(pose.dtype), away)
        offsets = self.offsets.astype(pose.dtype)
        best = jnp.argmin(jnp.sum(rows**2, axis=-1) + offsets)
        constant = jax.lax.stop_gradient(jnp.sqrt(offsets[best]))
        return jnp.concatenate([rows[best], constant[None]])

    def of_joints(self, joints: Sequence[int]) -> "MixturePosePrior":
        """The mixture of some joints, the root first, whatever the others do."""
        means = jnp.stack([rows_at(mean, joints) for mean in self.means])
        smaller = jnp.stack([_marginal(one, joints) for one in self.whitenings])
        return MixturePosePrior(self.weights, means, smaller)


def _marginal(whitening: Float[Array, "D D"], joints: Sequence[int]) -> Float[Array, "M M"]:
    """The whitening of some joints, the root first, whatever the others do."""
    rows = np.array([3 * (k - 1) + axis for k in joints if k for axis in range(3)], np.int32)
    # What is known needs no program: XLA took 0.7 s for what NumPy does in a millisecond.
    traced = isinstance(whitening, Tracer)
    xp, known = (jnp, whitening) if traced else (np, np.float64(whitening))
    inverse = xp.linalg.inv(known)
    covariance = (inverse @ inverse.T)[rows[:, None], rows[None, :]]
    smaller = xp.linalg.inv(xp.linalg.cholesky(covariance))
    return jnp.asarray(smaller, whitening.dtype)
