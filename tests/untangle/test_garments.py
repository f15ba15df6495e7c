"""`untangle_mesh(fixed=)`: what may not move stays to the bit; sheets come out of solids."""

import numpy as np
import pytest
import trimesh
from helpers import body_faces, box, embedded_body, join, sphere

from spt_jax import sheet_report, untangle_mesh


def shirt(inwards=0.0, waves=0.0):
    """The embedded body and, as a sheet, the skin of its trunk moved inwards; the body's count."""
    body = embedded_body()
    vertices = np.asarray(body.template, np.float64)
    trunk = np.isin(body.part_groups, [body.joint_names.index(f"spine{k}") for k in (1, 2, 3)])
    used, faces = np.unique(body_faces()[trunk], return_inverse=True)
    normals = np.array(trimesh.Trimesh(vertices, body_faces(), process=False).vertex_normals)
    x, y = vertices[used, :2].T
    way = waves * np.sin(30 * x) * np.sin(25 * y) - inwards
    cloth = vertices[used] + way[:, None] * normals[used]
    joined = np.concatenate([body_faces(), faces.reshape(-1, 3) + len(vertices)])
    return np.concatenate([vertices, cloth]), joined, len(vertices)


def as_sheet(vertices, faces, count):
    cloth = faces[(faces >= count).all(axis=1)] - count
    return sheet_report(vertices[count:], cloth, vertices[:count], body_faces())


@pytest.mark.parametrize(
    ("inwards", "waves", "farthest"),
    [pytest.param(0.01, 0.0, 0.03, marks=pytest.mark.slow), (-0.005, 0.01, 0.012)],
)
def test_a_shirt_comes_out_of_a_body_that_stays(inwards, waves, farthest):
    vertices, faces, count = shirt(inwards, waves)
    before = as_sheet(vertices, faces, count)
    found = untangle_mesh(vertices, faces, fixed=np.arange(len(vertices)) < count)
    np.testing.assert_array_equal(found.vertices[:count], vertices[:count])
    after = as_sheet(found.vertices, faces, count)
    assert not before.is_free and after.is_free and found.is_free
    assert found.before.volume > 0 == found.after.volume
    assert found.before.intersecting_pairs == before.intersecting_pairs
    assert before.depth < found.largest_displacement < farthest
    assert found.flipped_triangles == 0
    # Nothing to do the second time.
    again = untangle_mesh(found.vertices, faces, fixed=np.arange(len(vertices)) < count)
    np.testing.assert_array_equal(again.vertices, found.vertices)
    assert again.moved == 0 and again.is_free


def test_pinned_vertices_of_a_garment_stay(dtype):
    ball = sphere(0.5, subdivisions=3)
    tube = trimesh.creation.cylinder(0.48, 0.6, sections=48).subdivide()
    used, faces = np.unique(tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5], return_inverse=True)
    cloth = np.array(tube.vertices)[used] + [0.0, 0.0, 0.35]
    vertices = np.concatenate([ball[0], cloth]).astype(dtype)
    joined = np.concatenate([ball[1], faces.reshape(-1, 3) + len(ball[0])])
    fixed = (np.arange(len(vertices)) < len(ball[0])) | (vertices[:, 2] > 0.6)
    found = untangle_mesh(vertices, joined, fixed=fixed)
    assert found.is_free and found.vertices.dtype == dtype and found.before.ratio > 0
    np.testing.assert_array_equal(found.vertices[fixed], vertices[fixed])


def test_a_closed_solid_gives_way_to_a_fixed_one():
    vertices, faces = join(sphere(subdivisions=3), sphere(1.0, (1.8, 0.1, 0.2), subdivisions=3))
    fixed = np.arange(len(vertices)) < len(vertices) // 2
    for mask in (fixed, ~fixed):
        found = untangle_mesh(vertices, faces, fixed=mask)
        assert found.is_free and found.moved > 0
        np.testing.assert_array_equal(found.vertices[mask], vertices[mask])


def test_where_nothing_may_move_nothing_does():
    vertices, faces = join(box(), box(center=(0.6, 0.2, 0.1)))
    found = untangle_mesh(vertices, faces, fixed=np.ones(len(vertices), bool))
    assert not found.is_free and found.moved == 0
    np.testing.assert_array_equal(found.vertices, vertices)


def test_a_mask_that_does_not_fit_is_named():
    vertices, faces = box()
    for fixed in (np.arange(8), np.ones(7, bool), [0, 1]):
        with pytest.raises(ValueError, match=r"fixed must be a mask.*8 vertices.*np\.isin"):
            untangle_mesh(vertices, faces, fixed=np.asarray(fixed))
