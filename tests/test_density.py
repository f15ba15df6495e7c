"""rays="auto": the same lattice as rays everywhere, the thinnest overlaps found, work bounded."""

import dataclasses

import numpy as np
import pytest
from helpers import (
    bent_tube,
    body_faces,
    box,
    inverted,
    join,
    lens_volume,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
)

from spt_jax.overlap.measure import measure
from spt_jax.overlap.rays import density
from spt_jax.overlap.rays.beam import orthogonal_directions
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import find_overlaps
from spt_jax.overlap.rays.tiles import Tiles
from spt_jax.overlap.triangles import closed_form


@pytest.fixture(autouse=True)
def only_rays(monkeypatch):
    """As if no overlap could be measured in closed form."""
    solve = closed_form.solve

    def unsolved(*mesh):
        found = solve(*mesh)
        none = np.zeros_like(found.solved)
        return dataclasses.replace(found, solved=none, volume=0.0 * found.volume)

    monkeypatch.setattr(closed_form, "solve", unsolved)


def auto(mesh, directions=3):
    return measure(*mesh, sampling("auto", directions))


def length_everywhere(mesh, beam):
    """The overlap on the same lattice with rays over the whole screen."""
    vertices, faces = mesh
    column, row, depth = beam.frame @ vertices.T
    points = density.ScreenPoints(
        column / beam.pixel[0] - beam.origin[0], row / beam.pixel[1] - beam.origin[1], depth
    )
    whole = dataclasses.replace(beam, tiles=None)
    return find_overlaps(whole, points, faces, cast(whole, points, faces)).length.sum()


def soup(rng):
    """Closed parts of all sizes, flat and thin ones and one inside out, thrown together."""
    parts = [sphere(0.7, subdivisions=2), box((2.0, 1.5, 0.01)), inverted(sphere(0.2))]
    parts += [box(rng.uniform(0.02, 0.8, 3)) for _ in range(4)]
    return join(*(moved(p, random_rotation(rng), rng.uniform(-0.7, 0.7, 3)) for p in parts))


MESHES = {
    "soup": soup,
    "nested needle": lambda rng: join(
        sphere(), moved(box((1.2, 0.003, 0.003)), random_rotation(rng))
    ),
    "tube in itself": lambda rng: moved(bent_tube(0.4, 0.3, 0.05), random_rotation(rng)),
    "deep spheres": lambda rng: join(sphere(), sphere(center=(0.05, 0.02, 0.01))),
    "crossed plates": lambda rng: join(box((2, 2, 0.01)), box((2, 0.01, 2), (0.1, 0.2, 0.3))),
    "body": lambda rng: (posed_bodies(["crawl/0012"])[0], body_faces()),
}


@pytest.mark.parametrize("name", MESHES)
def test_nothing_is_lost_outside_the_tiles(name, rng):
    mesh = MESHES[name](rng)
    for probe in auto(mesh).beams:
        if probe.beam.shape[0] * probe.beam.shape[1] > 5e7:
            continue
        everywhere = length_everywhere(mesh, probe.beam)
        assert everywhere > 0
        assert probe.overlaps.length.sum() == pytest.approx(everywhere, rel=1e-9)


def test_a_body_against_fine_rays():
    vertices, faces = posed_bodies(["dance_a/0010"])[0], body_faces()
    fine = measure(vertices, faces, sampling(2048))
    found = auto((vertices, faces))
    assert found.volume == pytest.approx(fine.volume, rel=2e-3)
    pull = [m.gradient("boundary", "vertex") for m in (found, fine)]
    assert np.linalg.norm(pull[0].sum(0) - pull[1].sum(0)) < 0.01 * np.abs(pull[1]).sum()


def test_a_millimetre_of_overlap_in_a_scene_of_two_metres(rng):
    """Two plates edge to edge, 1 mm into each other along a side of 1 m."""
    thick = 0.02
    first, second = box((1, 1, thick)), box((1, 0.9, thick / 2), (0.999, 0.013, 0.001))
    for turn in (np.eye(3), random_rotation(rng)):
        mesh = moved(join(first, second), turn)
        found = auto(mesh)
        assert found.volume == pytest.approx(0.001 * 0.9 * thick / 2, rel=0.02)
        for probe in found.beams:
            assert probe.volume > 0


def test_the_lens_of_two_spheres():
    pair = join(sphere(subdivisions=5), sphere(center=(1.1, 0.3, 0.2), subdivisions=5))
    expected = lens_volume(np.linalg.norm([1.1, 0.3, 0.2]))
    assert auto(pair).volume == pytest.approx(expected, rel=4e-3)


def test_without_overlap_no_ray_is_cast(rng):
    free = join(sphere(), moved(box((3, 3, 0.1)), random_rotation(rng), (0, 0, 4)))
    found = auto(free)
    assert found.volume == 0 and not found.gradient("boundary", "vertex").any()
    assert not found.beams


@pytest.mark.parametrize("name", MESHES)
def test_rays_are_bounded(name, rng):
    for probe in auto(MESHES[name](rng)).beams:
        most = max(density.MOST_MARKED, (256 * 1.1 + 2) ** 2)
        assert 0 < probe.beam.num_rays <= most


def test_finite_differences_hold(rng):
    """The lattice stays where it is: central differences are the gradient, one direction."""
    pair = join(sphere(0.6, subdivisions=2), sphere(0.5, (0.7, 0.1, 0.2), subdivisions=2))
    mesh = moved(pair, random_rotation(rng))  # else some faces are seen edge-on
    velocity = rng.normal(size=mesh[0].shape)
    for direction in orthogonal_directions(3):
        exact = np.sum(auto(mesh, [direction]).gradient("boundary", "vertex") * velocity)
        step = 1e-6
        values = [
            auto((mesh[0] + s * velocity, mesh[1]), [direction]).volume for s in (step, -step)
        ]
        assert (values[0] - values[1]) / (2 * step) == pytest.approx(exact, rel=1e-3)


def test_the_volume_is_continuous_while_parts_come_together():
    """From apart to overlapping, in steps: no jump is larger than the quadrature's own error."""
    first, second = sphere(0.5, subdivisions=3), sphere(0.5, subdivisions=3)
    depth = np.linspace(-0.01, 0.2, 43)
    volumes = [auto(join(first, moved(second, None, (1.0 - d, 0.01, 0.02)))).volume for d in depth]
    assert (np.diff(volumes) >= -2e-3 * np.array(volumes[1:])).all()
    assert volumes[0] == 0 and volumes[-1] == pytest.approx(lens_volume(0.8, 0.5), rel=0.05)


def test_tiles_number_their_pixels_row_by_row(rng):
    tiles = Tiles(3, rng.random((7, 5)) < 0.4)
    row, column = tiles.locate(np.arange(tiles.num_pixels))
    assert tiles.marked[row // 3, column // 3].all()
    assert len(set(zip(row.tolist(), column.tolist(), strict=True))) == 9 * tiles.marked.sum()
    np.testing.assert_array_equal(tiles.number(row, column), np.arange(tiles.num_pixels))
    assert (np.diff(row) >= 0).all()


def test_spans_are_clipped_to_marked_tiles(rng):
    tiles = Tiles(4, rng.random((6, 9)) < 0.5)
    row = rng.integers(0, 24, 50)
    first = rng.integers(0, 36, 50)
    width = rng.integers(1, 37 - first)
    span, start, length = tiles.clip(row, first, width)
    inside = np.zeros((50, 36), int)
    for s, c, w in zip(span, start, length, strict=True):
        inside[s, c : c + w] += 1
    columns = np.arange(36)
    wanted = (columns >= first[:, None]) & (columns < (first + width)[:, None])
    wanted &= tiles.marked[row[:, None] // 4, columns // 4]
    np.testing.assert_array_equal(inside, wanted)
