"""Where a fit starts: turned and placed so that the resting body looks like the keypoints."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from spt_jax.body.rotations import axis_angle_from_matrix
from spt_jax.fit.problem.objective import Objective
from spt_jax.fit.problem.variables import Variables

# Directions from which the body is looked at, evenly over the sphere (24 degrees apart); what is
# between them is left to the solver.
_NUM_VIEWS = 64

# Keypoints of the trunk keep their distances; how far the others move away from where the mean
# pose has them is not known, and a seventh of the weight is enough to distinguish up from down.
_TRUNK = ("pelvis", "hip", "spine1", "spine2", "spine3", "neck", "collar", "shoulder")
_LIMB_WEIGHT = 0.15

# Against the unexplained share of the keypoints' spread: a body upside down costs 0.06, one that
# shows its back 0.002. Only where the keypoints leave it open do they decide.
_UPRIGHT, _FACING = 0.03, 0.001

# Starts are at least this far apart, in degrees.
_APART = 50.0

# A body nearer than 0.5 m or farther than 200 m is a misunderstanding; one point alone has no
# size, and then the body stands 4 m away.
_NEAREST, _FARTHEST, _USUAL = 0.5, 200.0, 4.0


def orientation_starts(objective: Objective, count: int) -> Float[Array, "count D"]:
    """The variables of `count` starts, the most likely first.

    The body at rest is looked at from all sides; for each side the rotation in the image, the size
    and the place that bring it nearest to the keypoints are a linear problem in complex numbers.
    The sides that leave the least unexplained are taken, each far enough from those before it. The
    two mirror images that a flat trunk has under a distant camera are thus both among them.

    Args:
        objective: of one person; what it holds fixed is kept.
        count: how many.
    """
    camera = objective.viewer.camera
    dtype = objective.keypoints.dtype
    base = objective.start
    rest = base.pose[objective.figure.rows].at[0].set(0.0)
    origin = Variables(rest, base.shape, jnp.zeros(3, dtype))
    points, joints, _ = objective.figure.posed(origin)
    weights = objective.confidence * jnp.asarray(_trunk_weights(objective.names), dtype)
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(dtype).tiny)
    center, focal = camera.center.astype(dtype)[None], camera.focal.astype(dtype)[None]
    image = (objective.keypoints - center) / focal
    image_center = jnp.sum(weights[:, None] * image, axis=0) / total
    body_center = jnp.sum(weights[:, None] * points, axis=0) / total
    views = jnp.asarray(_views(_NUM_VIEWS), dtype)

    from_center = image - image_center[None]
    target = _as_complex(weights[:, None] * from_center)
    seen = _as_complex(jnp.einsum("vij,kj->vki", views, points - body_center[None]))
    overlap = jnp.sum(jnp.conj(seen) * target[None], axis=-1)
    size = jnp.sum(weights[None] * jnp.abs(seen) ** 2, axis=-1)
    spread = jnp.sum(weights[:, None] * from_center**2)
    told = (size > 1e-6 * total) & (spread > 1e-12 * total)
    size = jnp.where(told, size, 1.0)
    scale = jnp.where(told, jnp.abs(overlap) / size, 1.0 / _USUAL)
    angle = jnp.where(told, jnp.angle(overlap), 0.0)
    explained = jnp.where(told, jnp.abs(overlap) ** 2 / size, 0.0)
    unexplained = 1 - explained / jnp.where(spread > 0, spread, 1.0)
    turned = _in_image(angle) @ views
    # The body's up against the image's, and whether it faces the camera.
    score = unexplained + _UPRIGHT * (1 + turned[:, 1, 1]) + _FACING * (1 + turned[:, 2, 2])
    chosen = _spread_out(score, turned, count)

    distance = jnp.clip(1 / scale[chosen], _NEAREST, _FARTHEST)
    at = jnp.concatenate([image_center, jnp.ones(1, dtype)])[None] * distance[:, None]
    over = camera.rotation.astype(dtype).T
    root = over @ turned[chosen]
    moved = at @ over.T - jnp.einsum("sij,j->si", root, body_center - joints[0]) - joints[:1]

    def packed(root, moved):
        pose = rest.at[0].set(axis_angle_from_matrix(root))
        return objective.repacked(Variables(pose, base.shape, moved))

    return jax.vmap(packed)(root, moved)


def _trunk_weights(names: tuple[str, ...]) -> list[float]:
    bare = [name.removeprefix("left_").removeprefix("right_") for name in names]
    return [1.0 if name in _TRUNK else _LIMB_WEIGHT for name in bare]


def _as_complex(points: Float[Array, "*batch axes"]) -> Complex[Array, "*batch"]:
    return jax.lax.complex(points[..., 0], points[..., 1])


def _in_image(angle: Float[Array, "N"]) -> Float[Array, "N 3 3"]:
    cosine, sine, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1]
    return jnp.stack(rows, axis=-1).reshape(-1, 3, 3)


def _views(count: int) -> Float[np.ndarray, "N 3 3"]:
    """Rotations from the body to cameras all around it: rows right, down and forward."""
    # A spiral of equal areas; the golden angle keeps neighboring turns apart.
    k = np.arange(count) + 0.5
    height = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - height**2)
    forward = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], axis=1)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _spread_out(score: Float[Array, "N"], rotations: Float[Array, "N 3 3"], count: int) -> Array:
    def choose(score, _):
        best = jnp.argmin(score)
        cosine = (jnp.sum(rotations[best][None] * rotations, axis=(1, 2)) - 1) / 2
        # Where all that is left is near, the least bad is taken.
        return jnp.where(cosine > np.cos(np.radians(_APART)), score + 10.0, score), best

    return jax.lax.scan(choose, score, length=count)[1]
