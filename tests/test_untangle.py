"""untangle_pose: less overlap than before or the same pose, whatever the solver."""

import ipctk
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import body_faces, embedded_body, mocap

from spt_jax import self_intersection_penalty, untangle_pose
from spt_jax.untangle import pose as untangle

QUICK = {"folds": "count", "rays": 64, "weights": (0.1, 1.0, 10.0), "steps_per_weight": 20}


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

    def undoing(search, body, fixed, moved, margin, weight):
        if weight > 1.0:
            return -3.0 * moved, search.steps_per_weight
        return descend(search, body, fixed, moved, margin, weight)

    monkeypatch.setattr(untangle, "_descend", undoing)
    options = {"folds": "count", "rays": 64, "steps_per_weight": 10}
    first = untangle_pose(embedded_body(), pose, weights=(1.0,), **options)
    both = untangle_pose(embedded_body(), pose, weights=(1.0, 2.0), **options)
    assert first.after.volume < 0.9 * first.before.volume
    np.testing.assert_array_equal(both.pose, first.pose)
    assert both.steps == 20


def test_collisions_go_and_nothing_else_moves():
    """A real frame with its default settings, judged by ipctk and by distances of our own."""
    body = embedded_body()
    pose = frame("cartwheel/0149")
    result = untangle_pose(body, pose)
    assert result.before.crossings > 20 and result.before.volume > 1e-7
    assert result.after.crossings == 0 and result.after.volume == 0
    assert result.after.total_volume > 0  # the armpits are left as they are
    moved = np.linalg.norm(result.vertices - body(pose).vertices, axis=1)
    assert moved.mean() < 0.002 and moved.max() < 0.02


def test_folds_alone_move_nothing():
    body = embedded_body()
    pose = frame("run/0005")
    result = untangle_pose(body, pose)
    assert result.before.total_volume > 1e-5 and result.before.crossings == 0
    assert result.before.volume == 0 and result.steps == 0
    np.testing.assert_array_equal(result.pose, pose)
    np.testing.assert_array_equal(result.vertices, body(pose).vertices)


def test_folds_go_by_the_vertices():
    """Afterwards ipctk finds no intersection at all."""
    body = embedded_body()
    pose = frame("run/0005")
    result = untangle_pose(body, pose, folds="remove")
    np.testing.assert_array_equal(result.pose, pose)
    assert result.before.total_crossings > 50 and result.after.total_crossings == 0
    assert has_intersections(body(pose).vertices)
    assert not has_intersections(result.vertices)
    moved = np.linalg.norm(result.vertices - body(pose).vertices, axis=1)
    assert moved.max() < 0.05 and np.mean(moved > 0) < 0.5


def has_intersections(vertices) -> bool:
    vertices, faces = np.asarray(vertices, np.float64), body_faces().astype(np.int32)
    mesh = ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces)
    return ipctk.has_intersections(mesh, vertices)


def test_never_worse_than_the_start():
    """A solver that only makes things worse gets the pose given back."""
    pose = frame("punch/0024")
    climbing = optx.GradientDescent(learning_rate=-0.05, rtol=1e-9, atol=1e-9)
    result = untangle_pose(
        embedded_body(),
        pose,
        folds="count",
        rays=64,
        weights=(10.0,),
        steps_per_weight=3,
        solver=climbing,
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
        (np.zeros((52, 3), "float32"), {"folds": "keep"}, "folds must be one of 'ignore'"),
        (np.zeros((52, 3), "float32"), {"margin": -0.1}, "margin must be finite and not neg"),
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
