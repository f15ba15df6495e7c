"""How far the spheres of a posed body collide: depths, and their squares as a loss."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.body.skinning import lift
from spt_jax.fit.spheres.model import BodySpheres, Tree, as_arguments, at_rest, posed_on

# Distances at rest round differently from those in a pose; a pair that the shape alone brings
# together may come this part nearer for nothing.
_SLACK = 1e-5


def sphere_penalty(
    spheres: BodySpheres,
    body: BodyModel,
    pose: Float[Array | np.ndarray, "*#batch J 3"],
    shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
    translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
) -> Float[Array, "*batch"]:
    """How far the spheres of a posed body collide, as a loss.

    The sum over pairs (i, j) that may collide of max(0, reach - |c_i - c_j|)^2, the squared depth,
    with reach = r_i + r_j, or the centers' distance at rest where the shape alone already brings
    the spheres together. So it is zero in the zero pose, for every shape. The paper says only
    "the intersection between spheres"; SMPLify's capsules are turned into Gaussians
    exp(-d^2 / (s_i^2 + s_j^2)), which push parts that do not touch. The depth is zero there and,
    unlike the volume of the lens, does not lose its force when spheres barely touch or when one
    is inside the other.

    Args:
        spheres: fitted to the body.
        body, pose, shape: as in `BodySpheres.posed`; the global orientation changes nothing.
        translation: of the body; it changes nothing, and is taken so that terms are called alike.

    Returns:
        One number per body, in m^2, in the dtype of `pose`.

    Raises:
        TypeError, ValueError: as the body does.

    Differentiation: every mode; finite everywhere, zero between spheres that share their center.
        Once differentiable in all, twice but where spheres begin to touch.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body, load_mocap
        >>> from spt_jax.fit.spheres.model import BodySpheres
        >>> from spt_jax.fit.spheres.penalty import sphere_penalty
        >>> body, mocap = load_body(), load_mocap()
        >>> spheres = BodySpheres.fit(body)
        >>> punch = body.pose_from_smpl(mocap.pose[mocap.names.index("punch/0007")])
        >>> penalty = sphere_penalty(spheres, body, jnp.stack([punch, 0 * punch]))
        >>> bool(penalty[0] > 1e-3), float(penalty[1])
        (True, 0.0)
    """
    angles, betas = as_arguments(body, pose, shape)
    return jnp.sum(_depths(spheres, Tree(body), angles, betas) ** 2, axis=(-2, -1))


def sphere_depths(
    spheres: BodySpheres,
    body: BodyModel,
    pose: Float[Array | np.ndarray, "*#batch J 3"],
    shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
) -> Float[Array, "*batch S S"]:
    """How deep each pair of spheres collides, in metres: what `sphere_penalty` squares and sums.

    Args:
        spheres, body, pose, shape: as in `sphere_penalty`.

    Returns:
        Depths above the diagonal; zero where a pair does not collide or is excluded.

    Raises:
        TypeError, ValueError: as the body does.

    Differentiation: as `sphere_penalty`; one-sided where spheres begin to touch.
    """
    angles, betas = as_arguments(body, pose, shape)
    return _depths(spheres, Tree(body), angles, betas)


@jax.jit
def _depths(spheres: BodySpheres, tree: Tree, angles, betas):
    centers, radii = posed_on(spheres, tree, angles, betas)
    rank = centers.ndim - 2
    _, rest, _ = at_rest(spheres, tree, betas, angles.dtype)
    # All pairs, not a gather of the included ones: the gradient of a gather is a scatter.
    reach = radii[..., :, None] + radii[..., None, :]
    reach = jnp.minimum(reach, lift((1 - _SLACK) * _distances(rest), rank, 2))
    counts = spheres.counts.reshape((1,) * rank + spheres.counts.shape)
    return jnp.where(counts, jnp.maximum(reach - _distances(centers), 0.0), 0.0)


def _distances(points):
    """Between all pairs; where two coincide zero, with a derivative of zero."""
    square = jnp.sum((points[..., :, None, :] - points[..., None, :, :]) ** 2, axis=-1)
    apart = square > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)
