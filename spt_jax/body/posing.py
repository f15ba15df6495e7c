"""A model's equations: shape, pose blend shapes and skinning together, compiled once."""

from functools import partial
from typing import TYPE_CHECKING, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax.body.rotations import matrix_from_axis_angle, quaternion_from_axis_angle
from spt_jax.body.skinning import (
    blend_shapes,
    displacement,
    forward_kinematics,
    lift,
    linear_blend_skinning,
)

if TYPE_CHECKING:
    from spt_jax.body.model import BodyModel

# What pose blend shapes are linear in. "matrices": R - I of all joints but the root (SMPL, MANO,
# FLAME, SMAL). "quaternions": (x, y, z, w - 1) of all joints (SUPR). "star": the same without the
# root, and then the second shape coefficient (Osman et al. 2020, "STAR", equation 5).
PoseFeatures = Literal["matrices", "quaternions", "star"]
POSE_FEATURES = get_args(PoseFeatures)


def count_features(kind: PoseFeatures, joints: int) -> int:
    """How many numbers the pose blend shapes of a model of so many joints are linear in."""
    return {"matrices": 9 * (joints - 1), "quaternions": 4 * joints, "star": 4 * joints - 3}[kind]


def feature_columns(
    kind: PoseFeatures, joints: Int[np.ndarray, "K"], count: int
) -> Int[np.ndarray, "_"]:
    """Which features are those of some joints, the root among them, of a model of `count`."""
    if kind == "quaternions":
        return (4 * joints[:, None] + np.arange(4)).reshape(-1)
    each = 9 if kind == "matrices" else 4
    columns = (each * (joints[1:, None] - 1) + np.arange(each)).reshape(-1)
    return columns if kind == "matrices" else np.append(columns, 4 * (count - 1))


def pose_features(
    kind: PoseFeatures,
    angles: Float[Array, "*batch J 3"],
    rotations: Float[Array, "*batch J 3 3"],
    betas: Float[Array, "*shapes B"] | None,
) -> Float[Array, "..."]:
    """What a pose's blend shapes are linear in; zero at rest, but for STAR's shape coefficient.

    Args:
        kind: of the features.
        angles: the pose.
        rotations: the same as matrices.
        betas: shape coefficients, with as many batch axes, which broadcast.
    """
    dtype = rotations.dtype
    batch = rotations.shape[:-3]
    if kind == "matrices":
        bend = rotations[..., 1:, :, :] - jnp.eye(3, dtype=dtype).reshape(
            (1,) * len(batch) + (1, 3, 3)
        )
        return bend.reshape(*batch, -1)
    start = 0 if kind == "quaternions" else 1
    unit = quaternion_from_axis_angle(angles[..., start:, :])
    bend = jnp.concatenate([unit[..., 1:], unit[..., :1] - 1], axis=-1).reshape(*batch, -1)
    if kind == "quaternions":
        return bend
    if betas is None or betas.shape[-1] < 2:
        girth = jnp.zeros((*batch, 1), dtype)
    else:
        girth = betas[..., 1:2]
    both = jnp.broadcast_shapes(batch, girth.shape[:-1])
    return jnp.concatenate(
        [jnp.broadcast_to(x, (*both, x.shape[-1])) for x in (bend, girth)], axis=-1
    )


# Compiled here as well as by the caller: outside jit that is one compilation, not one for each of
# 200 small operations (a first call of 1.5 s, not 4 s).
@partial(jax.jit, static_argnames="batch_rank")
def pose_body(
    body: "BodyModel", angles, betas, expression, shift, batch_rank: int
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Vertices and joints of a body, in the dtype of `angles`; `BodyModel` says the equations.

    Args:
        body: the model.
        angles: pose, (..., J, 3).
        betas, expression, shift: shape, expression and translation, or None.
        batch_rank: how many batch axes they have together.
    """
    dtype = angles.dtype
    # Equal ranks from the start: jax_numpy_rank_promotion="raise" is respected.
    angles = lift(angles, batch_rank, 2)
    rotations = matrix_from_axis_angle(angles)
    vertices = lift(blend_shapes(body.template, body.shape_basis, betas, dtype), batch_rank, 2)
    joints = blend_shapes(body.joint_template, body.joint_shape_basis, betas, dtype)
    joints = lift(joints, batch_rank, 2)
    if expression is not None:
        assert body.expression_basis is not None and body.joint_expression_basis is not None
        vertices = vertices + lift(displacement(body.expression_basis, expression), batch_rank, 2)
        joints = joints + lift(displacement(body.joint_expression_basis, expression), batch_rank, 2)
    if body.pose_basis is not None:
        lifted = None if betas is None else lift(betas, batch_rank, 1)
        features = pose_features(body.pose_features, angles, rotations, lifted)
        vertices = vertices + displacement(body.pose_basis, features)
    world, positions = forward_kinematics(rotations, joints, body.parents)
    weights = body.weights.astype(dtype)
    vertices = linear_blend_skinning(vertices, weights, world, positions, joints)
    if shift is not None:
        shift = lift(shift, batch_rank, 1)[..., None, :]
        vertices, positions = vertices + shift, positions + shift
    return vertices, positions
