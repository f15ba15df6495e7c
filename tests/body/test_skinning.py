"""Laws of spt_jax.body.skinning; test_body_model.py compares it with the slow reference."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers_body import PARENTS, slow_rotation

from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.body.skinning import (
    ancestor_doublings,
    forward_kinematics,
    linear_blend_skinning,
)


def test_doublings_are_the_ancestors_one_two_four_steps_up():
    for parents in PARENTS.values():
        count, depth = len(parents), 0
        for k, row in enumerate(ancestor_doublings(tuple(parents))):
            for joint, above in enumerate(row):
                way = [joint]
                while parents[way[-1]] >= 0:
                    way.append(parents[way[-1]])
                depth = max(depth, len(way))
                assert above == (way[2**k] if len(way) > 2**k else count)
        assert 2 ** (k + 1) >= depth > 2**k


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
