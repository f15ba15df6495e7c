"""Figures of motions: depths with known answers, and the rule of public filters."""

import csv
import json

import igl
import manifold3d
import numpy as np
import pytest
import trimesh
from helpers import box, sphere

from spt_jax.metrics import (
    MotionOverlap,
    between_meshes,
    motion_overlap,
    rejected,
    write_csv,
)
from spt_jax.overlap.depth import penetration_depths
from spt_jax.rest.surface import RestSurface


def joined(*meshes):
    start = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    return vertices, np.concatenate([f + k for (_, f), k in zip(meshes, start, strict=True)])


def test_depth_of_a_ball_in_a_box():
    """A vertex of the ball is as deep as it lies below the box's nearest side."""
    ball = sphere(radius=0.3, subdivisions=2)
    vertices, faces = joined(box(), ball)
    moving = np.stack([vertices, vertices, vertices])
    moving[1, 8:] += [0.55, 0.05, 0.02]
    moving[2, 8:] += [2.0, 0.0, 0.0]
    found = motion_overlap(moving, faces)
    for frame in range(3):
        below = (0.5 - np.abs(moving[frame, 8:])).min(axis=1)
        inside = below[below > 0]
        if frame < 2:
            assert found.largest_depth[frame] == pytest.approx(inside.max(), rel=1e-9)
            assert found.mean_depth[frame] == pytest.approx(inside.mean(), rel=1e-9)
            assert found.ratio[frame] == pytest.approx(len(inside) / len(vertices))
    assert found.is_free.tolist() == [False, False, True] and found.largest_depth[2] == 0
    assert found.intersecting_pairs.tolist()[0] == 0 < found.intersecting_pairs[1]


def test_depth_against_distances_to_every_triangle(rng):
    """The tree's answer is libigl's: the nearest triangle of all."""
    first = trimesh.creation.icosphere(subdivisions=2)
    second = first.copy().apply_scale([0.4, 1.3, 0.5]).apply_translation([0.9, 0.1, 0.2])
    vertices, faces = joined(*((np.array(m.vertices), np.array(m.faces)) for m in (first, second)))
    winding = [
        igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces), np.array(other.vertices))
        for mesh, other in ((second, first), (first, second))
    ]
    inside = np.concatenate(winding) > 0.5
    depth, nearest = penetration_depths(vertices, faces, inside)
    assert inside.sum() > 20 and not depth[~inside].any() and (nearest[~inside] == -1).all()
    split = len(first.vertices)
    for mesh, at in ((second, slice(0, split)), (first, slice(split, None))):
        chosen = inside[at]
        corners = np.array(mesh.vertices), np.array(mesh.faces)
        known = igl.point_mesh_squared_distance(vertices[at][chosen], *corners)[0]
        np.testing.assert_allclose(depth[at][chosen], np.sqrt(known), atol=1e-12)


def test_figures_move_along_with_the_mesh(rng):
    vertices, faces = joined(box(), sphere(radius=0.3, center=(0.45, 0.1, 0.0), subdivisions=2))
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    found = motion_overlap(np.stack([vertices, vertices @ turn.T + 3.0, 2 * vertices]), faces)
    assert found.largest_depth[1] == pytest.approx(found.largest_depth[0], rel=1e-6)
    assert found.largest_depth[2] == pytest.approx(2 * found.largest_depth[0], rel=1e-6)
    assert found.mean_depth[1] == pytest.approx(found.mean_depth[0], rel=1e-6)
    assert found.volume[2] == pytest.approx(8 * found.volume[0], rel=1e-6)


def test_parts_that_overlap_at_rest_are_not_deep():
    vertices, faces = joined(box(), sphere(radius=0.3, center=(0.5, 0.0, 0.0), subdivisions=2))
    rest = RestSurface(vertices, faces)
    assert motion_overlap(vertices[None], faces).largest_depth[0] > 0.2
    found = motion_overlap(vertices[None], faces, rest_surface=rest)
    assert found.is_free.all() and found.largest_depth[0] == 0


def test_the_public_rule():
    assert not rejected(np.full(500, 0.03)) and not rejected(np.zeros(0))
    assert not rejected(np.array([0.05])) and rejected(np.array([0.0, 0.0501]))
    assert not rejected(np.full(10, 0.031)) and rejected(np.full(11, 0.031))
    assert rejected(np.full(3, 0.02), deep=0.01, most_deep_frames=2)


def test_json_and_a_table():
    vertices, faces = joined(box(), sphere(radius=0.3, subdivisions=1))
    found = motion_overlap(vertices[None].astype(np.float32), faces)
    content = json.loads(json.dumps(found.as_dict()))
    assert content["frames"] == content["colliding_frames"] == 1 and content["is_rejected"]
    assert content["per_frame"]["largest_depth"] == [content["largest_depth"]]
    assert "is rejected" in str(found)
    numbers = np.arange(4)
    some = MotionOverlap(*(numbers.astype(d) for d in (float, float, int, float, float)))
    assert some.at(np.array([1, 3])).volume.tolist() == [1, 3]
    assert some.with_frames(np.array([0]), some.at(np.array([3]))).volume.tolist() == [3, 1, 2, 3]


def test_what_cannot_be_measured_is_named(untyped):
    vertices, faces = box()
    moving = np.stack([vertices] * 3)
    moving[1, 0, 0] = np.nan
    with pytest.raises(ValueError, match="1 of 3, frame 1 the first"):
        motion_overlap(moving, faces)
    with pytest.raises(ValueError, match="frames, V, 3"):
        motion_overlap(vertices, faces)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_between_meshes_against_an_exact_boolean(rng, dtype):
    first = trimesh.creation.icosphere(subdivisions=2)
    second = trimesh.creation.capsule(height=1.0, radius=0.4, count=[12, 12])
    second.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    second.apply_translation([0.8, 0.2, -0.1])
    arrays = [(m.vertices.astype(dtype), np.array(m.faces)) for m in (first, second)]
    found = between_meshes(*arrays[0], *arrays[1], contact_distance=0.05)
    solids = [
        manifold3d.Manifold(manifold3d.Mesh64(v.astype(np.float64), f.astype(np.uint64)))
        for v, f in arrays
    ]
    assert found.volume == pytest.approx((solids[0] ^ solids[1]).volume(), rel=1e-9)
    back = between_meshes(*arrays[1], *arrays[0])
    assert back.volume == pytest.approx(found.volume, rel=1e-9)
    assert back.largest_depth == found.largest_depth > 0
    np.testing.assert_array_equal(back.depth, found.other_depth)
    vertices, faces = arrays[0][0].astype(np.float64), arrays[1][1]
    signed = np.asarray(igl.signed_distance(vertices, arrays[1][0].astype(np.float64), faces)[0])
    np.testing.assert_allclose(found.depth, np.maximum(-signed, 0), atol=1e-6)
    assert found.contact_ratio == pytest.approx(np.mean(signed <= 0.05))
    assert found.mean_depth == pytest.approx(-signed[signed < 0].mean(), rel=1e-5)


def test_meshes_apart_and_one_in_the_other():
    box_vertices, faces = box()
    ball, ball_faces = sphere(radius=0.3, subdivisions=2)
    inside = between_meshes(ball, ball_faces, box_vertices, faces)
    assert inside.intersecting_pairs == 0 < inside.volume and not inside.is_free
    assert inside.largest_depth == pytest.approx(0.5 - np.abs(ball).max(axis=1).min(), abs=1e-9)
    assert inside.contact_ratio == 1.0 and not inside.other_depth.any()
    apart = between_meshes(ball + np.array([0.9, 0, 0]), ball_faces, box_vertices, faces)
    assert apart.is_free and apart.contact_ratio == 0 and apart.largest_depth == 0
    near = between_meshes(
        ball + np.array([0.801, 0, 0]), ball_faces, box_vertices, faces, contact_distance=0.01
    )
    assert 0 < near.contact_ratio < 0.1 and near.is_free
    content = json.loads(json.dumps(inside.as_dict()))
    assert content["volume_in_cubic_centimeters"] == pytest.approx(1e6 * content["volume"])
    with pytest.raises(ValueError, match="contact_distance"):
        between_meshes(ball, ball_faces, box_vertices, faces, contact_distance=-1.0)
    with pytest.raises(ValueError, match="other_vertices"):
        between_meshes(ball, ball_faces, box_vertices[None], faces)


def test_a_table_of_all_frames(tmp_path):
    deep = np.array([0.0, 0.02, 1 / 3])
    overlap = MotionOverlap(deep**2, deep, np.array([0, 5, 7]), deep, deep / 2)
    write_csv(tmp_path / "m.csv", overlap, 60.0)
    with open(tmp_path / "m.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["largest_depth"]) for row in rows] == deep.tolist()
    assert [row["is_free"] for row in rows] == ["True", "False", "False"]
    assert [float(row["time"]) for row in rows] == [0.0, 1 / 60, 2 / 60]
    with pytest.raises(ValueError, match="positive"):
        write_csv(tmp_path / "no.csv", overlap, 0.0)
    assert not (tmp_path / "no.csv").exists()
