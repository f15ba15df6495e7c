"""untangle_pose: less overlap than before or the same pose, whatever the solver."""

import functools
import os
import subprocess
import sys

import ipctk
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import trimesh
from helpers import body_faces, embedded_body, mocap

from spt_jax import RESULTS, BodyModel, self_intersection_penalty, untangle_pose
from spt_jax.overlap.measure import Unmeasurable
from spt_jax.untangle import one_pose as untangle

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
    result = untangle_pose(body, poses, **QUICK, on_step=seen.append)
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
    # Each step of the solver is reported, in order, and the last one is among what was measured.
    first = seen[: int(result.steps[0])]
    assert [step.steps for step in first] == list(range(1, len(first) + 1))
    assert [step.stage for step in first] == sorted(step.stage for step in first)
    assert len(seen) == int(result.steps.sum()) and first[-1].stage >= 1
    assert first[-1].volume < 0.5 * first[0].volume
    assert first[-1].intersecting_pairs < first[0].intersecting_pairs
    posed = body(jnp.asarray(first[-1].pose)).vertices
    np.testing.assert_allclose(first[-1].vertices, posed, atol=1e-6)


def test_a_pose_without_overlap_comes_back_to_the_bit():
    pose = frame("backflip/0002")
    result = untangle_pose(embedded_body(), pose, **QUICK)
    np.testing.assert_array_equal(result.pose, pose)
    assert result.steps == 0 and result.before.volume == result.after.volume == 0
    assert result.is_free and result.reason == "collision-free"


@pytest.mark.slow
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
    descend = untangle.descend

    def undoing(search, body, fixed, moved, margin, weight):
        if weight > 1.0:
            return -3.0 * moved, search.steps_per_weight, RESULTS.successful
        return descend(search, body, fixed, moved, margin, weight)

    monkeypatch.setattr(untangle, "descend", undoing)
    options = {"folds": "count", "rays": 64, "steps_per_weight": 10}
    first = untangle_pose(embedded_body(), pose, weights=(1.0,), **options)
    both = untangle_pose(embedded_body(), pose, weights=(1.0, 2.0), **options)
    assert first.after.volume < 0.9 * first.before.volume
    np.testing.assert_array_equal(both.pose, first.pose)
    assert both.steps == 20 and not both.is_free


def test_collisions_go_and_nothing_else_moves():
    """A real frame with its default settings, judged by ipctk and by distances of our own."""
    body = embedded_body()
    pose = frame("cartwheel/0149")
    result = untangle_pose(body, pose)
    assert result.before.intersecting_pairs > 20 and result.before.volume > 1e-7
    assert result.after.intersecting_pairs == 0 and result.after.volume == 0
    assert result.after.total_volume > 0  # the armpits are left as they are
    assert result.is_free and result.status == RESULTS.successful
    moved = np.linalg.norm(result.vertices - body(pose).vertices, axis=1)
    assert moved.mean() < 0.002 and moved.max() < 0.02


def test_folds_alone_move_nothing():
    body = embedded_body()
    pose = frame("run/0005")
    result = untangle_pose(body, pose)
    assert result.before.total_volume > 1e-5 and result.before.intersecting_pairs == 0
    assert result.before.volume == 0 and result.steps == 0
    np.testing.assert_array_equal(result.pose, pose)
    np.testing.assert_array_equal(result.vertices, body(pose).vertices)


def test_folds_go_by_the_vertices():
    """Afterwards ipctk finds no intersection at all."""
    body = embedded_body()
    pose = frame("run/0005")
    result = untangle_pose(body, pose, folds="remove")
    np.testing.assert_array_equal(result.pose, pose)
    assert (
        result.before.total_intersecting_pairs > 50 and result.after.total_intersecting_pairs == 0
    )
    assert result.is_free and result.after.total_volume == 0
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
    assert result.steps == 3 and not result.is_free
    assert result.status != RESULTS.successful and result.reason != "collision-free"


@functools.cache
def boxes():
    """A trunk, and an arm that a joint beside it swings into the trunk; a box each."""
    trunk = trimesh.creation.box((0.4, 0.4, 0.4)).subdivide()
    arm = trimesh.creation.box((0.3, 0.1, 0.12)).subdivide()
    arm.apply_translation([0.5, 0.01, 0.02])
    count = len(trunk.vertices)
    template = np.concatenate([trunk.vertices, arm.vertices]).astype(np.float32)
    weights = np.zeros((len(template), 3), np.float32)
    weights[:count, 0] = weights[count:, 1] = 1.0
    joints = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.65, 0.0, 0.0]], np.float32)
    return BodyModel(
        template=jnp.asarray(template),
        shape_basis=jnp.zeros((len(template), 3, 1), jnp.float32).at[:, 0, 0].set(1.0),
        joint_template=jnp.asarray(joints),
        joint_shape_basis=jnp.zeros((3, 3, 1), jnp.float32),
        weights=jnp.asarray(weights),
        faces=jnp.asarray(np.concatenate([trunk.faces, arm.faces + count]), jnp.int32),
        parents=(-1, 0, 1),
        joint_names=("trunk", "arm", "tip"),
    )


def swung(angle, dtype="float32"):
    return jnp.zeros((3, 3), dtype).at[1, 1].set(angle)


@pytest.mark.parametrize(
    ("folds", "rays", "rate"),
    [
        ("ignore", None, 1e30),
        ("count", None, 1e4),
        pytest.param("ignore", 64, 1e4, marks=pytest.mark.slow),
        pytest.param("count", 64, 1e30, marks=pytest.mark.slow),
    ],
)
def test_a_solver_that_runs_away_is_told_and_its_places_are_not_taken(folds, rays, rate):
    seen = []
    running = optx.GradientDescent(learning_rate=rate, rtol=1e-9, atol=1e-9)
    result = untangle_pose(
        boxes(),
        swung(2.6),
        folds=folds,
        rays=rays,
        solver=running,
        steps_per_weight=4,
        on_step=seen.append,
    )
    assert result.before.volume > 1e-4
    for part in (result.pose, result.vertices, result.after.volume, result.after.ratio):
        assert np.isfinite(part).all()
    np.testing.assert_array_equal(result.pose, swung(2.6))
    assert result.after.volume == result.before.volume and not result.is_free
    assert result.status == RESULTS.nonlinear_divergence and "diverged" in result.reason
    # Its steps are shown as they are: at no surface, or joints turned by more than a full turn.
    far = [np.abs(np.float64(step.pose) - swung(2.6)).max() for step in seen]
    assert len(seen) >= 5
    assert any(np.isnan(step.volume) for step in seen) or max(far) > 2 * np.pi


@pytest.mark.slow
def test_the_search_goes_on_where_it_last_could_be_measured(monkeypatch, dtype):
    """Every second descent ends nowhere, in a full turn and more, or at numbers that are none."""
    descend, calls = untangle.descend, []

    def sometimes(search, body, fixed, moved, margin, weight):
        calls.append(np.array(moved))
        found, steps, ended = descend(search, body, fixed, moved, margin, weight)
        lost = jnp.full_like(found, jnp.nan) if len(calls) % 4 else 1e6 * jnp.ones_like(found)
        return (lost if len(calls) % 2 else found), steps, ended

    monkeypatch.setattr(untangle, "descend", sometimes)
    result = untangle_pose(boxes(), swung(2.6, dtype), weights=(0.1, 1.0, 10.0, 100.0, 1000.0))
    assert result.is_free and result.after.volume == 0 and result.pose.dtype == dtype
    assert all(np.isfinite(moved).all() for moved in calls) and len(calls) >= 2


@pytest.mark.slow
def test_each_pose_of_a_batch_says_how_it_ended(monkeypatch):
    descend = untangle.descend

    def fails_for_some(search, body, fixed, *rest):
        found, steps, ended = descend(search, body, fixed, *rest)
        return (found * jnp.nan if fixed[0][1, 1] > 2.7 else found), steps, ended

    monkeypatch.setattr(untangle, "descend", fails_for_some)
    monkeypatch.setattr("spt_jax.untangle.sides.descend", fails_for_some)
    poses = jnp.stack([swung(angle) for angle in (0.3, 2.6, 2.8)])
    result = untangle_pose(boxes(), poses)
    assert result.is_free.tolist() == [True, True, False]
    assert (result.status == RESULTS.nonlinear_divergence).tolist() == [False, False, True]
    assert result.reason[:2] == ["collision-free"] * 2 and "diverged" in result.reason[2]
    assert np.isfinite(result.vertices).all()


def test_a_body_that_cannot_be_measured_is_refused():
    far = np.array([3e38], np.float32)
    with pytest.raises(Unmeasurable, match="rounding allows"):
        untangle_pose(boxes(), swung(2.6), translation=np.full(3, 1e5, np.float32))
    with pytest.raises(Unmeasurable, match="vertices must be finite"):
        untangle_pose(boxes(), swung(2.6), shape=far, translation=np.full(3, 3e38, np.float32))


def test_what_is_a_fold_can_be_set():
    body, pose = embedded_body(), frame("run/0005")
    quick = {"weights": (1.0,), "steps_per_weight": 1, "margin": 0.0}
    usual, none, wide = (
        untangle_pose(body, pose, fold_distance=distance, **quick) for distance in (None, 0.0, 9.0)
    )
    assert usual.before.intersecting_pairs == 0 == wide.before.intersecting_pairs
    assert int(none.before.intersecting_pairs) > 0.9 * int(none.before.total_intersecting_pairs)
    assert none.before.volume > 0.9 * none.before.total_volume
    assert usual.before.total_volume == none.before.total_volume


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
        (np.zeros((52, 3), "float32"), {"fold_distance": -0.1}, "fold_distance must be finite"),
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


@pytest.mark.slow
def test_what_need_not_move_has_the_bits_that_the_body_gives():
    """Compiled as users compile it: the suite's own flags would hide a difference."""
    code = (
        "import jax.numpy as jnp, numpy as np; from spt_jax import *\n"
        "body, mocap = load_body(), load_mocap()\n"
        "poses = body.pose_from_smpl(jnp.asarray(mocap.pose[[108, 117, 126]]))\n"
        "for pose in poses:\n"
        "    found = untangle_pose(body, pose)\n"
        "    assert found.before.volume == 0 and (found.pose == pose).all()\n"
        "    np.testing.assert_array_equal(found.vertices, body(pose).vertices)\n"
    )
    env = os.environ | {"XLA_FLAGS": ""}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
