"""A body as SMPL-X has it: eyeballs of their own in the head, and a hole in the mouth."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mocap
from helpers_body import smplx_like
from helpers_fit import camera

from spt_jax import fit_pose, intersection_report, keypoint_regressor, load_body, untangle_pose


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("smplx") / "SMPLX_LIKE.npz"
    np.savez(path, **smplx_like())
    return path


@pytest.fixture(scope="module")
def body(file):
    with pytest.warns(UserWarning, match=r"SMPLX_LIKE\.npz has 1 hole of \d\d edges") as said:
        found = load_body(file, dtype="float32")
    assert len(said) == 1 and "fans close wherever overlap is measured" in str(said[0].message)
    return found


def found_in(body, vertices):
    return intersection_report(vertices, body.faces, rest_surface=body.rest_surface)


def test_at_rest_nothing_collides(body):
    report = found_in(body, body.template)
    assert report.is_free and report.volume == 0 and report.ratio == 0
    assert report.total_volume > 1e-5  # what the eyeballs have in common with the head
    (hole,) = report.holes
    assert 12 < hole.edges < 60 and hole.size < 0.01


def test_eyes_that_look_about_do_not_collide(body):
    pose = np.zeros((55, 3), np.float32)
    for name in ("left_eye", "right_eye"):
        pose[body.joint_names.index(name)] = 0.4, -0.5, 0.0
    pose[body.joint_names.index("head")] = 0.3, 0.5, -0.1
    assert found_in(body, body(pose).vertices).is_free


@pytest.mark.long
@pytest.mark.parametrize("name", ["cartwheel/0103", "roll/0052", "crawl/0012"])
def test_frames_are_freed(body, name):
    pose = body.pose_from_smpl(jnp.asarray(mocap().pose[mocap().names.index(name)]))
    result = untangle_pose(body, pose)
    assert bool(result.is_free) and float(result.after.volume) == 0
    assert found_in(body, result.vertices).is_free


@pytest.mark.long
def test_a_fit_ends_without_overlap(body):
    pose = body.pose_from_smpl(jnp.asarray(mocap().pose[mocap().names.index("punch/0013")]))
    regressor = keypoint_regressor(body, "smpl22")
    posed = body(pose)
    keypoints = camera().project(
        regressor(posed.joints, posed.vertices[np.array(regressor.vertices, int)])
    )
    found = fit_pose(body, keypoints, camera(), layout="smpl22")
    assert found_in(body, found.vertices).is_free
