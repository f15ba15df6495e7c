"""The part of a body that keypoints see: a few joints and a few vertices."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax.body import BodyModel
from spt_jax.body.posing import feature_columns
from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.body.skinning import (
    blend_shapes,
    displacement,
    forward_kinematics,
    linear_blend_skinning,
)
from spt_jax.fit.problem.variables import Variables
from spt_jax.keypoints import KeypointRegressor

# A joint that moves a landmark with less than a hundredth of its weight is not determined by it.
_LEAST_WEIGHT = 0.01


class PosedFigure(NamedTuple):
    """A figure in a pose."""

    points: Float[Array, "K 3"]  # the keypoints, in metres
    joints: Float[Array, "M 3"]  # in metres
    rotations: Float[Array, "M 3 3"]  # of the joints, in the world


class Figure(eqx.Module):
    """A body without the joints that no keypoint hangs on and without all vertices but landmarks.

    On the embedded body with SMPL's joints it has 22 of 52 joints, and its derivatives cost half.

    Attributes:
        body: those joints and vertices.
        regressor: the keypoints of it.
        moving: of each of its joints, the number in the whole body.
    """

    body: BodyModel
    regressor: KeypointRegressor
    moving: tuple[int, ...] = eqx.field(static=True)

    @property
    def rows(self) -> Int[np.ndarray, "M"]:
        """`moving`, to index with."""
        return np.array(self.moving)

    def posed(self, moved: Variables) -> PosedFigure:
        """The figure in a pose: as `body` does it, with the rotations at hand.

        Had the root's rotation been asked for besides `body`'s own, the gradient of a fit would
        have had two such in it: a fifth of what its loop compiles.
        """
        body, dtype = self.body, moved.pose.dtype
        rotations = matrix_from_axis_angle(moved.pose)
        rest = blend_shapes(body.joint_template, body.joint_shape_basis, moved.shape, dtype)
        world, joints = forward_kinematics(rotations, rest, body.parents)
        vertices = blend_shapes(body.template, body.shape_basis, moved.shape, dtype)
        if len(vertices):
            if body.pose_basis is not None:
                bend = rotations[1:] - jnp.eye(3, dtype=dtype)[None]
                vertices = vertices + displacement(body.pose_basis, bend.reshape(-1))
            weights = body.weights.astype(dtype)
            vertices = linear_blend_skinning(vertices, weights, world, joints, rest)
        shift = moved.translation[None]
        joints, vertices = joints + shift, vertices + shift
        return PosedFigure(self.regressor(joints, vertices), joints, world)


def make_figure(body: BodyModel, regressor: KeypointRegressor) -> Figure:
    """The figure of a body for a set of keypoints.

    A joint moves if a keypoint lies on it or below it: fingers do where any of them is seen. The
    root always does. What other joints do to landmarks, under a hundredth of their weight, is left
    to those that move.
    """
    vertices = np.array(regressor.vertices, np.int32)
    skin = np.asarray(body.weights)[vertices]
    # Rows that lie nowhere on the body are left out of fits.
    rows = slice(None) if regressor.placed is None else np.array(regressor.placed)
    weight = np.abs(np.asarray(regressor.joint_weights)[rows]).sum(axis=0)
    weight = weight + np.abs(np.asarray(regressor.vertex_weights)[rows]).sum(axis=0) @ skin
    seen = weight > _LEAST_WEIGHT
    seen[0] = True
    for joint in range(len(body.parents) - 1, 0, -1):
        seen[body.parents[joint]] |= seen[joint]
    moving = np.flatnonzero(seen)
    few = body.at_vertices(vertices)
    share = skin[:, moving]
    share = share / np.maximum(share.sum(axis=1, keepdims=True), np.finfo(share.dtype).tiny)
    dtype = body.weights.dtype
    basis = few.pose_basis
    if basis is not None:
        columns = feature_columns(body.pose_features, moving, body.num_joints)
        basis = jnp.asarray(np.asarray(basis)[..., columns])
    smaller = BodyModel(
        template=few.template,
        shape_basis=few.shape_basis,
        joint_template=jnp.asarray(np.asarray(body.joint_template)[moving]),
        joint_shape_basis=jnp.asarray(np.asarray(body.joint_shape_basis)[moving]),
        weights=jnp.asarray(share, dtype),
        faces=few.faces,
        parents=tuple(
            -1 if joint == 0 else int(np.searchsorted(moving, body.parents[joint]))
            for joint in moving
        ),
        joint_names=tuple(body.joint_names[joint] for joint in moving),
        pose_basis=basis,
        pose_features=body.pose_features,
    )
    points = KeypointRegressor(
        names=regressor.names,
        vertices=tuple(range(len(vertices))),
        joint_weights=regressor.joint_weights[:, moving],
        vertex_weights=regressor.vertex_weights,
        placed=regressor.placed,
    )
    return Figure(smaller, points, tuple(int(joint) for joint in moving))
