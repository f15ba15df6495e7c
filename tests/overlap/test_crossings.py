"""Crossings against brute force, and the law that a closed mesh's signs cancel on every ray."""

import dataclasses

import numpy as np
import pytest
import trimesh
from helpers import (
    body_faces,
    box,
    cast_rays,
    inverted,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sphere,
    winding_number,
)

from spt_jax.overlap.rays import crossings as crossings_module
from spt_jax.overlap.rays.beam import ScreenPoints, aim, orthogonal_directions, screen_frame
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import find_overlaps, winding_numbers


def signs_per_ray(found):
    return np.bincount(found.ray, found.sign)


def brute_force(beam, points, faces):
    """Every ray against every triangle, by barycentric coordinates; rays in general position."""
    found = []
    for f, corners in enumerate(faces):
        x, y, z = points.column[corners], points.row[corners], points.depth[corners]
        rows, columns = np.mgrid[0 : beam.shape[0], 0 : beam.shape[1]]
        part = []
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            part.append((x[i] - columns) * (y[j] - rows) - (y[i] - rows) * (x[j] - columns))
        part = np.array(part)
        inside = (part > 0).all(axis=0) | (part < 0).all(axis=0)
        for r, c in np.argwhere(inside):
            weights = part[:, r, c] / part[:, r, c].sum()
            sign = 1 if part[0, r, c] > 0 else -1
            found.append((r * beam.shape[1] + c, weights @ z, f, sign))
    return sorted(found)


@pytest.mark.parametrize("rays", [7, 16, (9, 23)])
def test_crossings_equal_brute_force(rng, rays):
    mesh = join(
        moved(box(), random_rotation(rng)),
        moved(sphere(0.7, subdivisions=1), random_rotation(rng), (0.4, 0.3, 0.2)),
    )
    for direction in rng.normal(size=(3, 3)):
        beam, points, found = cast_rays(mesh, direction, rays)
        expected = brute_force(beam, points, mesh[1])
        assert len(expected) > 30
        assert list(found.ray) == [ray for ray, *_ in expected]
        assert list(found.face) == [face for _, _, face, _ in expected]
        assert list(found.sign) == [sign for *_, sign in expected]


def test_wide_keys_sort_like_packed_ones(rng, monkeypatch):
    mesh = moved(sphere(subdivisions=3), random_rotation(rng))
    _, _, packed = cast_rays(mesh, (0.2, 0.3, 1.0), 64)
    monkeypatch.setattr(crossings_module, "_FEWEST_DEPTH_BITS", 64)
    _, _, wide = cast_rays(mesh, (0.2, 0.3, 1.0), 64)
    np.testing.assert_array_equal(packed.ray, wide.ray)
    np.testing.assert_array_equal(packed.sign, wide.sign)
    assert np.mean(packed.face == wide.face) > 0.999


@pytest.mark.parametrize("direction", [(0, 0, -1), (-1, 0, 0), (0, 1, 0)])
@pytest.mark.parametrize("subdivisions", [0, 2])
def test_rays_aimed_at_vertices_and_edges_cancel(direction, subdivisions):
    """A lattice-aligned cube: every vertex and every edge lies on rays, faces are parallel."""
    cube = box((8.0, 8.0, 8.0))
    for _ in range(subdivisions):
        cube = tuple(map(np.asarray, trimesh.remesh.subdivide(*cube)))
    frame = screen_frame(np.array(direction, float))
    u, v, depth = frame @ cube[0].T
    beam, _ = aim(cube[0], np.array(direction, float), (8, 8))
    points = ScreenPoints(u + 4.0, v + 4.0, depth)  # pixel 1: corners on integer points exactly
    beam = dataclasses.replace(beam, shape=(10, 10))
    found = cast(beam, points, cube[1])
    assert found.open_rays == 0
    assert len(found.ray) == 2 * 8 * 8  # half-open: 8 of the 9 lattice lines a side
    np.testing.assert_array_equal(signs_per_ray(found), 0)
    assert set(winding_numbers(found)) == {0, 1}


@pytest.mark.parametrize("rays", [64, 512, (100, 300)])
def test_a_turned_cube_seen_along_its_diagonal_and_axes_cancels(rays):
    cube = box((1.0, 1.0, 1.0), (0.1, 0.2, 0.3))
    for direction in [(1, 1, 1), (1, 1, 0), *orthogonal_directions(3)]:
        _, _, found = cast_rays(cube, direction, rays)
        assert found.open_rays == 0
        assert not signs_per_ray(found).any()


def test_signs_cancel_on_two_hundred_posed_bodies():
    faces = body_faces()
    for k, v in enumerate(posed_bodies(np.linspace(0, 1085, 200).astype(int))):
        for direction in orthogonal_directions(3):
            _, _, found = cast_rays((v, faces), direction, 64 + k)  # other rays for each body
            assert found.open_rays == 0
            assert len(found.ray) == found.met > 500
            assert not signs_per_ray(found).any()


def test_counters_are_winding_numbers_on_the_body(rng):
    """At the middle of random gaps of a posed body, against libigl's exact winding number."""
    faces = body_faces()
    (vertices,) = posed_bodies(["crawl/0092"])
    for direction in orthogonal_directions(3):
        beam, points, found = cast_rays((vertices, faces), direction, 256)
        winding = winding_numbers(found)
        same_ray = found.ray[1:] == found.ray[:-1]
        corners = faces[found.face]
        row, column = np.divmod(found.ray, beam.shape[1])
        depth = _plane_depth(points, corners, column, row)
        gap = np.flatnonzero(same_ray & (np.diff(depth) > 2e-4))
        overlapped = gap[winding[gap] > 1]
        chosen = np.concatenate([rng.choice(gap, 300), rng.choice(overlapped, 100)])
        middle = (depth[chosen] + depth[chosen + 1]) / 2
        screen = np.stack(
            [
                (column[chosen] + beam.origin[0]) * beam.pixel[0],
                (row[chosen] + beam.origin[1]) * beam.pixel[1],
                middle,
            ]
        )
        expected = winding_number((vertices, faces), (beam.frame.T @ screen).T)
        np.testing.assert_allclose(winding[chosen], expected, atol=1e-6)


def _plane_depth(points, corners, column, row):
    x, y, z = points.column[corners], points.row[corners], points.depth[corners]
    matrix = np.stack([x, y, np.ones_like(x)], axis=1)
    target = np.stack([column, row, np.ones(len(row))], axis=1).astype(float)
    weights = np.linalg.solve(matrix + 1e-15 * np.eye(3), target[..., None])[..., 0]
    return np.einsum("kc,kc->k", weights, z)


def test_an_open_mesh_loses_only_the_rays_through_its_hole():
    vertices, faces = sphere(subdivisions=3)
    _, _, whole = cast_rays((vertices, faces), (0, 0, -1), 64)
    hole = whole.face[len(whole.face) // 2]
    _, _, found = cast_rays((vertices, np.delete(faces, hole, axis=0)), (0, 0, -1), 64)
    lost = set(whole.ray[whole.face == hole])
    assert found.open_rays == len(lost) > 0
    assert set(whole.ray) - set(found.ray) == lost
    assert not signs_per_ray(found).any()


def test_meshes_without_extent_have_no_crossings():
    vertices = np.full((4, 3), 0.3)
    faces = np.array([[0, 1, 2], [0, 2, 1]])
    _, _, found = cast_rays((vertices, faces), (0, 0, -1), 64)
    assert len(found.ray) == 0 and found.open_rays == 0


@pytest.mark.parametrize("seed", range(8))
def test_rays_left_out_of_the_sort_meet_no_overlap(seed):
    """Random stacks of solids, inverted ones among them: what is kept gives the same overlaps."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(rng.integers(1, 6)):
        part = sphere(rng.uniform(0.2, 0.8), subdivisions=1)
        part = moved(part, random_rotation(rng), rng.uniform(-0.8, 0.8, 3))
        parts.append(inverted(part) if rng.random() < 0.3 else part)
    vertices, faces = join(*parts)
    for direction in rng.normal(size=(2, 3)):
        beam, points = aim(vertices, direction, 40)
        everything = find_overlaps(beam, points, faces, cast(beam, points, faces))
        kept = cast(beam, points, faces, simple_rays=False)
        assert len(kept.ray) < kept.met
        found = find_overlaps(beam, points, faces, kept)
        for name, value in vars(everything).items():
            np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
