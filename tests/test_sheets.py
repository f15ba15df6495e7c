"""An open sheet beside closed solids: the area inside and the depth, in closed form and exact."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import body_faces, box, embedded_body, inverted, join, random_rotation, sphere

from spt_jax import RestSurface, classify_vertices, sheet_penalty, sheet_report
from spt_jax.overlap.sheets import SheetInSolids

EPS = float(np.finfo(np.float64).eps)


@functools.cache
def grid(count=9, size=3.0):
    """A square in the plane z = 0."""
    x, y = np.meshgrid(*2 * (np.linspace(-size / 2, size / 2, count),), indexing="ij")
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = (number[i : count - 1 + i, j : count - 1 + j] for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), faces


def measured(sheet, solid):
    faces = np.concatenate([solid[1], sheet[1] + len(solid[0])])
    return SheetInSolids(np.concatenate([solid[0], sheet[0]]), faces, len(solid[1]), EPS)


def area_of_section(solid, normal, origin):
    """Of the plane's polygon in a solid, by trimesh's section and the shoelace formula."""
    path = trimesh.Trimesh(*solid, process=False).section(normal, origin)
    total = np.zeros(3)
    for loop in path.discrete:
        total += np.cross(loop[:-1] - origin, loop[1:] - origin).sum(axis=0) / 2
    return np.linalg.norm(total)


def test_a_plane_in_solids(rng):
    for _ in range(3):
        turn, at = random_rotation(rng), rng.normal(scale=0.2, size=3)
        sheet = (grid()[0] @ turn.T + at, grid()[1])
        ball = sphere(subdivisions=3)
        found = measured(sheet, ball)
        expected = area_of_section(ball, turn[:, 2], at)  # which joins points within 1e-8
        assert found.area()[0] == pytest.approx(expected, rel=1e-7)
        # Which side of the sheet is out does not matter, nor the order of its faces.
        for other in (sheet[1][:, ::-1], rng.permutation(sheet[1])):
            assert measured((sheet[0], other), ball).area()[0] == pytest.approx(
                found.area()[0], rel=1e-12
            )
        inside = found.depths > 0
        radius = np.linalg.norm(found.vertices, axis=1)
        assert (radius[inside] < 1).all() and found.pairs > 20
        assert (radius[len(ball[0]) :][found.depths[len(ball[0]) :] == 0] > 0.97).all()


def test_the_gradients_are_exact(rng):
    turn = random_rotation(rng)
    sheet = (grid()[0] @ turn.T + 0.1, grid()[1])
    solid = join(sphere(subdivisions=2), box(center=(0.9, 0.3, 0.2)))  # which overlap
    found, step = measured(sheet, solid), 1e-6
    pulls = found.area()[1], found.depth()[1]
    for _ in range(3):
        motion = step * rng.normal(size=found.vertices.shape)
        ends = [
            SheetInSolids(found.vertices + s * motion, found.faces, found.solids, EPS)
            for s in (1, -1)
        ]
        slopes = [ends[0].area()[0] - ends[1].area()[0], ends[0].depth()[0] - ends[1].depth()[0]]
        for pull, slope in zip(pulls, slopes, strict=True):
            assert np.sum(pull * motion) == pytest.approx(slope / 2, rel=1e-6, abs=1e-14)


def test_solids_that_overlap_count_once_each():
    sheet = (0.2 * grid()[0] + [0.25, 0.0, 0.01], grid()[1])
    one, other = box(), box(center=(0.3, 0.1, 0.0))
    areas = [measured(sheet, solid).area()[0] for solid in (one, other, join(one, other))]
    assert areas[2] == pytest.approx(areas[0] + areas[1], rel=1e-12) and min(areas) > 0.1
    hollow = join(box((2, 2, 2)), inverted(box()))  # in the cavity there is nothing
    assert measured((0.1 * grid()[0], grid()[1]), hollow).area()[0] == 0


def test_a_shirt_on_a_body():
    """The skin of the trunk as a sheet, once inflated and once shrunk by a centimetre."""
    body = embedded_body()
    trunk = np.isin(body.part_groups, [body.joint_names.index(f"spine{k}") for k in (1, 2, 3)])
    used, faces = np.unique(body_faces()[trunk], return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = np.asarray(body.template, np.float64)
    normals = np.array(trimesh.Trimesh(vertices, body_faces(), process=False).vertex_normals)
    out = sheet_report((vertices + 0.01 * normals)[used], faces, vertices, body_faces())
    assert out.is_free and out.deepest == -1 and not out.depths.any()
    deep = sheet_report((vertices - 0.01 * normals)[used], faces, vertices, body_faces())
    assert deep.area == pytest.approx(deep.total_area, rel=1e-9) and not deep.is_free
    assert np.median(deep.depths) == pytest.approx(0.01, rel=0.1)
    assert deep.depth < 0.0101 and deep.depths[deep.deepest] == deep.depth
    assert deep.as_dict()["vertices_inside"] == len(used) and "depth" in str(deep)


def test_under_transformations(dtype):
    vertices, faces = grid(5)
    ball = sphere(subdivisions=2)
    sheets = jnp.asarray(np.stack([vertices, vertices + np.array([0.0, 0.0, 0.4])]), dtype)
    solid = jnp.asarray(ball[0], dtype)

    def loss(sheet, solid, value):
        return sheet_penalty(sheet, faces, solid, ball[1], value=value)

    for value in ("area", "depth"):
        each = jax.vmap(lambda s, value=value: loss(s, solid, value))(sheets)
        both = jax.jit(loss, static_argnums=2)(sheets, solid, value)
        assert both.dtype == dtype and both.shape == (2,)
        np.testing.assert_array_equal(each, both)
        pulls = jax.grad(lambda *x, value=value: loss(*x, value).sum(), (0, 1))(sheets, solid)
        assert pulls[0].shape == sheets.shape and pulls[1].shape == solid.shape
        push = np.asarray(pulls[0]).sum(axis=(0, 1)) + np.asarray(pulls[1]).sum(axis=0)
        assert np.abs(push).max() < 1e-5  # moving both changes nothing
    if dtype == np.float64:
        with pytest.raises(TypeError, match="one dtype"):
            loss(sheets, np.asarray(ball[0], np.float32), "area")


def test_what_is_no_solid_is_refused():
    vertices, faces = grid(5)
    with pytest.raises(ValueError, match="of the solids, mesh must have no hole"):
        sheet_report(vertices, faces, vertices, faces)
    assert np.isnan(sheet_penalty(vertices, faces, vertices, faces))
    assert np.isnan(sheet_penalty(vertices * np.nan, faces, *sphere(subdivisions=1)))
    with pytest.raises(ValueError, match="batch axes must broadcast"):
        sheet_penalty(np.stack([vertices] * 2), faces, np.stack([vertices] * 3), faces)


def test_vertices_of_sheets_are_labelled_by_where_they_lie(rng):
    """Solids as without the sheet, whatever is excluded; the sheet by whether it is in a solid."""
    first, second, sheet = box(), box(), grid(7, 1.7)
    second = (second[0] + [0.7, 0.1, 0.2], second[1])
    mixed = rng.permutation(len(sheet[1]) + 24)
    whole = join(join(first, sheet), second)
    vertices, faces = whole[0], whole[1][mixed]
    solid = np.r_[:8, len(vertices) - 8 : len(vertices)]
    alone = classify_vertices(*join(first, second)).labels
    found = np.asarray(classify_vertices(vertices, faces).labels)
    np.testing.assert_array_equal(found[solid], alone)
    assert np.any(alone)
    inside = [
        (np.abs(sheet[0] - centre) < 0.5).all(axis=1) for centre in ([0, 0, 0], [0.7, 0.1, 0.2])
    ]
    np.testing.assert_array_equal(found[8:-8], inside[0] | inside[1])
    report = sheet_report(*sheet, *join(first, second))
    np.testing.assert_array_equal(report.labels, found[8:-8])
    # Between the solids nothing counts; the sheet is where it is.
    group = np.array([0] * 12 + [1] * len(sheet[1]) + [2] * 12)[mixed]
    ignored = classify_vertices(vertices, faces, face_groups=group, ignore_groups=((0, 2),)).labels
    assert not np.asarray(ignored)[solid].any()
    np.testing.assert_array_equal(np.asarray(ignored)[8:-8], found[8:-8])
    rest = RestSurface(vertices, faces, 0.01)  # in which the solids overlap
    at_rest = np.asarray(classify_vertices(vertices, faces, rest_surface=rest).labels)
    assert not at_rest[solid].any() and at_rest[8:-8].any()
    assert not np.asarray(classify_vertices(*sheet).labels).any()
