"""untangle_pose: less overlap than before or the same pose, whatever the solver."""

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import embedded_body, mocap

from spt_jax import self_intersection_penalty, untangle_pose
from spt_jax.fit import untangle

QUICK = {"rays": 64, "weights": (0.1, 1.0, 10.0), "steps_per_weight": 20}


def frame(name, dtype="float32"):
    pose = mocap().pose[list(mocap().names).index(name)]
    return embedded_body().pose_from_smpl(jnp.asarray(pose, dtype))


def overlap(pose, rays=128):
    body = embedded_body()
    return float(self_intersection_penalty(body(pose).vertices, body.faces, rays=rays))


def test_real_poses_come_free():
    body = embedded_body()
    poses = jnp.stack([frame("crawl/0092"), frame("punch/0024")])
    seen = []
    result = untangle_pose(body, poses, **QUICK, on_step=lambda *step: seen.append(step))
    assert result.pose.shape == poses.shape and result.vertices.shape == (2, 12272, 3)
    assert result.before.volume.shape == result.after.ratio.shape == result.steps.shape == (2,)
    for k in range(2):
        assert result.before.volume[k] == pytest.approx(overlap(poses[k]), rel=1e-5)
        assert result.after.volume[k] == pytest.approx(overlap(result.pose[k]), rel=1e-3, abs=1e-9)
    assert (result.before.volume > 5e-5).all()
    assert (result.after.volume < 0.2 * result.before.volume).all()
    assert (result.after.ratio < result.before.ratio).all()
    np.testing.assert_array_equal(result.pose[:, 0], poses[:, 0])  # the root stays
    np.testing.assert_allclose(result.vertices, body(result.pose).vertices, atol=1e-6)
    # One report a weight, the steps counted up.
    assert [stage for stage, _, _ in seen[:3]] == [0, 1, 2] and len(seen) <= 6
    assert seen[1][1] > seen[0][1] and seen[2][1] == result.steps[0]


def test_a_pose_without_overlap_comes_back_to_the_bit():
    pose = frame("backflip/0002")
    result = untangle_pose(embedded_body(), pose, **QUICK)
    np.testing.assert_array_equal(result.pose, pose)
    assert result.steps == 0 and result.before.volume == result.after.volume == 0


def test_shape_and_translation_are_used_and_kept(x64):
    body = embedded_body()
    pose = frame("punch/0024", "float64")
    shape, translation = jnp.array([2.0, -1.0]), jnp.array([0.3, 1.0, -0.2])
    result = untangle_pose(body, pose, shape=shape, translation=translation, **QUICK)
    assert result.pose.dtype == jnp.float64
    posed = body(result.pose, shape, translation).vertices
    np.testing.assert_allclose(result.vertices, posed, atol=1e-9)
    before = self_intersection_penalty(body(pose, shape).vertices, body.faces, rays=128)
    assert result.before.volume == pytest.approx(float(before), rel=0.1)  # other rays
    assert result.after.volume < 0.2 * result.before.volume


def test_the_best_pose_seen_is_kept(monkeypatch):
    """A second weight that undoes the first one: the pose after the first comes back."""
    pose = frame("punch/0024")
    descend = untangle._descend

    def undoing(search, body, fixed, moved, weight, max_steps):
        if weight > 1.0:
            return -3.0 * moved, max_steps
        return descend(search, body, fixed, moved, weight, max_steps)

    monkeypatch.setattr(untangle, "_descend", undoing)
    first = untangle_pose(embedded_body(), pose, rays=64, weights=(1.0,), steps_per_weight=10)
    both = untangle_pose(embedded_body(), pose, rays=64, weights=(1.0, 2.0), steps_per_weight=10)
    assert first.after.volume < 0.9 * first.before.volume
    np.testing.assert_array_equal(both.pose, first.pose)
    assert both.steps == 20


def test_a_sample_of_real_frames_loses_its_overlap():
    """The benchmark's claim on three of its frames, with its own settings: 99 %, none worse."""
    poses = jnp.stack([frame("getup_facedown/0115"), frame("spinkick/0037"), frame("jump/0027")])
    result = untangle_pose(embedded_body(), poses)
    reduction = 1 - np.asarray(result.after.volume / result.before.volume)
    assert np.median(reduction) > 0.99 and reduction.min() > 0.95
    assert np.isfinite(result.vertices).all()


def test_never_worse_than_the_start():
    """A solver that only makes things worse gets the pose given back."""
    pose = frame("punch/0024")
    climbing = optx.GradientDescent(learning_rate=-0.05, rtol=1e-9, atol=1e-9)
    result = untangle_pose(
        embedded_body(), pose, rays=64, weights=(10.0,), steps_per_weight=3, solver=climbing
    )
    np.testing.assert_array_equal(result.pose, pose)
    assert result.after.volume == result.before.volume > 0
    assert result.steps == 3


@pytest.mark.parametrize(
    ("pose", "options", "message"),
    [
        (
            np.zeros((24, 3), "float32"),
            {},
            r"shape \(\.\.\., 52, 3\): got \(24, 3\)",
        ),
        (np.full((52, 3), np.nan, "float32"), {}, "pose must be finite: got 156 values"),
        (np.zeros((0, 52, 3), "float32"), {}, "at least one pose"),
        (np.zeros((52, 3), "float32"), {"weights": ()}, "weights must be positive"),
        (np.zeros((52, 3), "float32"), {"weights": (1.0, -1.0)}, "weights must be positive"),
        (np.zeros((52, 3), "float32"), {"rays": 0}, "rays must be from 1"),
        (np.zeros((52, 3), "float32"), {"rays": 4000}, "up to 2048"),
        (np.zeros((52, 3), "float32"), {"steps_per_weight": 0}, "steps_per_weight must be"),
        (
            np.zeros((52, 3), "float32"),
            {"translation": np.zeros((2, 3))},
            "translation must be one",
        ),
        (np.zeros((52, 3), "float32"), {"translation": np.float32(0)}, "translation must be one"),
        (np.zeros((52, 3), "float32"), {"shape": np.array([np.nan])}, "shape must be finite"),
    ],
)
def test_wrong_input(pose, options, message, untyped):
    with pytest.raises(ValueError, match=message):
        untangle_pose(embedded_body(), pose, **options)
