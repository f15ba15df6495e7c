"""Laws of spt_jax.body.skinning; test_body_model.py compares it with the slow reference."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from helpers_body import PARENTS, slow_rotation

from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.body.skinning import forward_kinematics, linear_blend_skinning, tree_levels


def test_levels_hold_every_joint_once_and_parents_one_level_up():
    for parents in PARENTS.values():
        levels = tree_levels(tuple(parents))
        assert sorted(joint for level in levels for joint in level) == list(range(len(parents)))
        for above, level in pairwise(levels):
            assert all(parents[joint] in above for joint in level)


def test_forward_kinematics_equals_a_walk_joint_by_joint(rng, x64):
    parents = PARENTS[55]
    vectors, joints = rng.normal(size=(55, 3)), rng.normal(size=(55, 3))
    rotations, positions = jax.jit(forward_kinematics, static_argnums=2)(
        matrix_from_axis_angle(jnp.asarray(vectors)), jnp.asarray(joints), tuple(parents)
    )
    rotations, positions = np.asarray(rotations), np.asarray(positions)
    for joint, parent in enumerate(parents):
        turn = slow_rotation(vectors[joint])
        if parent < 0:
            np.testing.assert_allclose(rotations[joint], turn, atol=1e-12)
            np.testing.assert_allclose(positions[joint], joints[joint], atol=1e-12)
        else:
            above = rotations[parent]
            bone = above @ (joints[joint] - joints[parent])
            np.testing.assert_allclose(rotations[joint], above @ turn, atol=1e-12)
            np.testing.assert_allclose(positions[joint], positions[parent] + bone, atol=1e-12)


def test_one_rigid_motion_for_all_joints_moves_the_vertices_rigidly(rng, x64):
    vertices, joints = rng.normal(size=(30, 3)), rng.normal(size=(4, 3))
    weights = rng.random((30, 4))
    weights /= weights.sum(axis=1, keepdims=True)
    turn, shift = slow_rotation(np.array([0.3, -1.0, 2.0])), np.array([1.0, -2.0, 3.0])
    got = linear_blend_skinning(
        jnp.asarray(vertices),
        jnp.asarray(weights),
        jnp.asarray(np.broadcast_to(turn, (4, 3, 3))),
        jnp.asarray(joints @ turn.T + shift),
        jnp.asarray(joints),
    )
    np.testing.assert_allclose(got, vertices @ turn.T + shift, atol=1e-12)
