"""Rigs of glTF: posed as its specification has it, and put back into their files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_rigs import hard_rig, slow_vertices, unpacked

from spt_jax import check_mesh, load_body
from spt_jax.io import load_rig, write_rig


@pytest.fixture(scope="module", params=[False, True], ids=["", "mirrored"])
def rig(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("rigs") / "hard.glb"
    path.write_bytes(hard_rig(mirrored=request.param))
    return load_rig(path, scale=1.0, dtype=jnp.zeros(()).dtype)


def posed(rig, clip, dtype=jnp.float32):
    arrays = (jnp.asarray(x, dtype) for x in (clip.pose, clip.shape, clip.translation))
    vertices = np.asarray(rig.body(*arrays).vertices)[:, rig.rows]
    vertices[:, rig.rows < 0] = np.nan
    return vertices


def test_every_frame_is_what_the_specification_says(rig):
    clip = rig.clip("all", frames_per_second=5.0)
    assert clip.times.tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    content = rig.path.read_bytes()
    want = [slow_vertices(content, "all", time) for time in clip.times]
    extent = np.ptp(want[0], axis=0).max()
    assert 0.5 < extent < 5
    assert np.nanmax(np.abs(posed(rig, clip) - want)) < 3e-6 * extent


def test_the_pose_without_an_animation_is_the_files_own(rig):
    clip = rig.clip()
    assert clip.frame_rate is None and rig.body.shape_names[:2] == ("bulge", "caps")
    assert clip.shape[0, :2].tolist() == [0.0, 0.5]
    want = slow_vertices(rig.path.read_bytes())
    assert np.nanmax(np.abs(posed(rig, clip)[0] - want)) < 3e-6


def test_joints_parts_and_seams(rig):
    body = rig.body
    # No joint for the node between, nor for what nothing moves above the root.
    assert body.joint_names == ("root", "spine", "matrix", "tip") and body.parents == (-1, 0, 1, 2)
    assert body.bones == (0, 1, 2, 3, 1)  # the spine was bound twice
    assert body.shifting == (3,) and body.scaling == (1,)
    assert body.shape_names[2:] == tuple(
        f"{name} {axis}" for name in ("tip translation", "spine scale") for axis in "xyz"
    )
    assert any("floor" in note for note in rig.notes)
    # 65 of the tube with its seam, 27 and 14: the seam's nine are joined.
    assert len(rig.rows) == 65 + 65 + 27 + 14 and body.num_vertices == 56 + 27 + 14
    vertices = body(jnp.zeros(body.pose_shape)).vertices
    check_mesh(vertices, body.faces).raise_if_unfit()
    np.testing.assert_allclose(np.asarray(body.weights).sum(axis=1), 1, atol=1e-6)


def test_turns_are_about_the_worlds_axes_and_the_root_turns_all(rig):
    body = rig.body
    rest = body(jnp.zeros(body.pose_shape))
    turned = body(jnp.zeros(body.pose_shape).at[0, 2].set(jnp.pi / 2))
    root = np.asarray(rest.joints[0])
    away = np.asarray(rest.vertices) - root
    want = np.stack([-away[:, 1], away[:, 0], away[:, 2]], axis=1) + root
    # Scales stand before and after rotations: only what scales evenly turns as a solid.
    np.testing.assert_allclose(turned.joints[0], rest.joints[0], atol=1e-6)
    np.testing.assert_allclose(turned.vertices, want, atol=2e-6)
    moved = body(jnp.zeros(body.pose_shape), translation=jnp.array([1.0, 2, 3])).vertices
    np.testing.assert_allclose(moved, away + root + [1, 2, 3], atol=1e-6)


def test_a_motion_goes_back_into_the_file_and_all_else_stays(rig, tmp_path):
    clip = rig.clip("all", frames_per_second=5.0)
    pose = clip.pose.copy()
    pose[:, 2] += [0.3, -0.2, 0.1]
    given = rig.path.read_bytes()
    assert rig.write(tmp_path / "out.glb", clip.with_pose(pose)) == ("all untangled",)
    content = (tmp_path / "out.glb").read_bytes()
    before, data = unpacked(given)
    after, more = unpacked(content)
    # The matrix that an animation may not turn is taken apart; what was there else, is.
    matrix = after["nodes"].pop(4)
    assert "matrix" not in matrix and before["nodes"].pop(4)["name"] == matrix["name"]
    for kind in before:
        if kind not in ("accessors", "bufferViews", "buffers", "animations"):
            assert after[kind] == before[kind], kind
        elif kind != "buffers":
            assert after[kind][: len(before[kind])] == before[kind], kind
    assert more[0].startswith(data[0])
    again = load_rig(tmp_path / "out.glb", scale=1.0)
    assert again.animations == ("all", "all untangled")
    new = again.clip("all untangled", frames_per_second=5.0)
    np.testing.assert_allclose(new.pose, pose, atol=1e-6)
    np.testing.assert_allclose(new.shape, clip.shape, atol=1e-6)
    want = slow_vertices(content, "all untangled", 0.6)
    assert np.nanmax(np.abs(posed(again, new)[3] - want)) < 3e-6
    assert np.nanmax(np.abs(posed(rig, clip)[3] - want)) > 1e-3


def test_a_body_model_goes_through_a_file_and_comes_back(tmp_path):
    body = load_body(num_shape=1)
    pose = jax.random.normal(jax.random.key(0), (3, 52, 3)) * 0.4
    place = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0]])
    file = tmp_path / "body.glb"
    write_rig(file, body, pose, translation=place, frames_per_second=24.0, name="x")
    rig = load_rig(file)
    clip = rig.clip("x")
    assert clip.frame_rate == 24 and rig.body.parents == body.parents
    assert rig.body.joint_names == body.joint_names and rig.notes == ()
    np.testing.assert_array_equal(rig.body.faces, body.faces)
    want = body(pose, translation=place).vertices
    assert np.abs(posed(rig, clip) - want).max() < 3e-6
    shape = jnp.array([0.7])
    np.testing.assert_allclose(rig.body.template, body.template)
    zero = jnp.zeros((52, 3))
    np.testing.assert_allclose(rig.body(zero, shape).vertices, body.rest(shape), atol=1e-6)
    assert repr(rig.body.rest_surface) == repr(body.rest_surface)
