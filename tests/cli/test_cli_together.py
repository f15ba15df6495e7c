"""`spt-jax untangle --together`: people of one file freed of themselves and of each other."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import ball_arrays

from spt_jax import load_body, untangle_motion
from spt_jax.body import BodyGroup
from spt_jax.cli import main as cli
from spt_jax.io import load_poses
from spt_jax.untangle.descent import _displacement_form, displacement_factor


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    path = tmp_path_factory.mktemp("balls") / "balls.npz"
    np.savez(path, **ball_arrays())
    return path


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Two people in three frames, as SLAHMR has them: apart, in each other, and one in himself."""
    shift = np.zeros((2, 3, 3))
    shift[1, :, 0] = (5.0, 0.05, 5.0)
    bent = np.zeros((2, 3, 21, 3))
    bent[0, 2, 17, 1] = np.radians(178.0)  # the left elbow
    path = tmp_path_factory.mktemp("pair") / "world_results.npz"
    parts = {"root_orient": np.zeros((2, 3, 3)), "pose_body": bent.reshape(2, 3, 63)}
    np.savez(path, **parts, trans=shift, betas=np.zeros((2, 16)))
    return path


@pytest.mark.long
def test_between_and_within_are_counted_apart(balls, pair, tmp_path, capsys):
    asked = ["untangle", str(pair), "--together", "--body", str(balls), "--out", str(tmp_path)]
    asked += ["--frame-by-frame"]
    assert cli.main([*asked, "--json", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    apart, crossed, bent = report["frames"]
    assert [frame["name"] for frame in report["frames"]] == [f"frame/{k:04d}" for k in range(3)]
    assert apart["people"] == ["0", "1"] and apart["before"]["volume"] == 0
    assert crossed["between"]["before"]["volume"] > 0 == crossed["within"]["before"]["volume"]
    assert bent["within"]["before"]["volume"] > 0 == bent["between"]["before"]["volume"]
    for frame in report["frames"]:
        for when in ("before", "after"):
            parts = frame["between"][when]["volume"] + frame["within"][when]["volume"]
            assert parts == pytest.approx(frame[when]["volume"], rel=1e-6, abs=1e-12)
        assert frame["is_free"] and frame["after"]["intersecting_pairs"] == 0
    assert report["files"] == ["poses_0.npz", "poses_1.npz"]
    (first,), (second,) = (load_poses(tmp_path / name) for name in report["files"])
    # Whom nothing touches stays: everybody in the first frame, the second one in the third.
    given = load_poses(pair)
    np.testing.assert_array_equal(first.pose[0, :22], given[0].pose[0])
    np.testing.assert_array_equal(second.translation[[0, 2]], given[1].translation[[0, 2]])
    body = load_body(balls)
    group = BodyGroup(body, 2)
    moved = group.pose_of(
        jnp.stack([body.pose_from_smpl(t.pose[1].astype(np.float32)) for t in (first, second)]),
        jnp.stack([jnp.asarray(t.translation[1], jnp.float32) for t in (first, second)]),
    )
    assert group(moved).vertices.shape == (2 * body.num_vertices, 3)


def test_what_does_not_go_together_is_said(balls, pair, tmp_path, capsys):
    asked = ["untangle", str(pair), "--together", "--out", str(tmp_path), "--quiet"]
    assert cli.main([*asked, "--like-input"]) == 2
    assert "leave one of them out" in capsys.readouterr().err
    np.savez(tmp_path / "nowhere.npz", poses=np.zeros((2, 66)))
    asked[1] = str(tmp_path / "nowhere.npz")
    assert cli.main(asked) == 2
    assert "without a translation" in capsys.readouterr().err


@pytest.mark.slow
def test_a_group_is_its_people_one_after_the_other(balls, rng):
    body = load_body(balls)
    group = BodyGroup(body, 2)
    poses = jnp.asarray(rng.normal(size=(3, 2, 24, 3)) * 0.3, jnp.float32)
    places = jnp.asarray(rng.normal(size=(3, 2, 3)), jnp.float32)
    shape = jnp.asarray(rng.normal(size=(2 * body.num_shape,)), jnp.float32)
    pose = group.pose_of(poses, places)
    assert pose.shape == (3, *group.pose_shape)
    found = group(pose, shape, jnp.array([0.0, 1.0, 0.0]))
    own = [
        body(poses[:, k], shape.reshape(2, -1)[k], places[:, k] + jnp.array([[0.0, 1.0, 0.0]]))
        for k in range(2)
    ]
    want = jnp.concatenate([one.vertices for one in own], axis=1)
    np.testing.assert_allclose(found.vertices, want, atol=1e-6)
    joints = jnp.concatenate([one.joints for one in own], axis=1)
    np.testing.assert_allclose(found.joints, joints, atol=1e-6)
    back, where = group.people(pose)
    np.testing.assert_array_equal(back, poses)
    np.testing.assert_array_equal(where, places)
    assert len(group.parents) == group.num_joints == 48 and group.parents[24] == -1
    assert group.free_rows.tolist() == [*range(1, 25), *range(26, 50)]
    np.testing.assert_array_equal(group.part_groups[len(body.faces) :], body.part_groups + 24)
    # What moves one moves no other: the form in blocks is the whole one.
    whole = _displacement_form(group, pose[0], shape)
    blocks = displacement_factor(group, pose[0], shape)
    stiff = 1e-3 * jnp.eye(len(whole))
    np.testing.assert_allclose(blocks @ blocks.T - stiff, whole, atol=1e-5)
    with pytest.raises(ValueError, match="rotations of joints"):
        untangle_motion(group, pose)
    with pytest.raises(ValueError, match="positive whole number"):
        BodyGroup(body, 0)
