"""untangle_mesh: no edge through a triangle any more, by a judge that is not ours."""

import json

import ipctk
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
    sphere,
)

from spt_jax.cli import main
from spt_jax.mesh_files import read_mesh
from spt_jax.overlap.triangles.pairs import edge_crossings
from spt_jax.untangle.contours import contour_forces
from spt_jax.untangle.mesh import untangle_mesh
from spt_jax.untangle.spread import Spread, Surface


def intersects(vertices, faces) -> bool:
    vertices = np.asarray(vertices, np.float64)
    mesh = ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces)
    return bool(ipctk.has_intersections(mesh, vertices))


def two_spheres(distance, subdivisions=3):
    return join(
        sphere(subdivisions=subdivisions),
        sphere(center=(distance, 0.0, 0.0), subdivisions=subdivisions),
    )


@pytest.mark.parametrize("name", ["crawl/0025", "punch/0005"])
def test_posed_bodies_come_free_of_collisions_and_folds(name):
    vertices = posed_bodies([name])[0].astype(np.float32)
    faces = body_faces()
    assert intersects(vertices, faces)
    result = untangle_mesh(vertices, faces)
    assert result.free and not intersects(result.vertices, faces)
    assert result.vertices.dtype == np.float32
    assert result.before.crossings > 0 == result.after.crossings
    assert result.after.volume < 1e-3 * result.before.volume
    assert result.largest_displacement < 0.08  # in metres, for up to a litre of overlap


SHAPES = {
    "spheres": two_spheres(1.5),
    "spheres deep in each other": two_spheres(0.5),
    "boxes": join(box(), box(center=(0.5, 0.1, 0.2))),
    "one box twice": join(box(), box()),
    "a box through a box": join(box(), box((0.2, 0.2, 4.0))),
    "three": join(two_spheres(1.0), sphere(center=(0.5, 0.8, 0.0), subdivisions=3)),
    "a tube that enters itself": bent_tube(0.3, 0.3, 0.15, sides=24, steps=150),
}


@pytest.mark.parametrize(
    ("shape", "dtype"), [*((shape, np.float32) for shape in SHAPES), ("spheres", np.float64)]
)
def test_other_shapes_come_free(shape, dtype):
    vertices, faces = SHAPES[shape]
    result = untangle_mesh(vertices.astype(dtype), faces)
    assert result.free == (not intersects(result.vertices, faces))
    assert result.free and result.vertices.dtype == dtype


def test_two_spheres_go_hardly_further_than_they_must():
    """Each of the two must give way by half the depth, 0.25 on average and at least 0.25 at one."""
    vertices, faces = two_spheres(1.5)
    result = untangle_mesh(vertices, faces)
    assert result.before.volume == pytest.approx(lens_volume(1.5), rel=0.03)
    assert 0.24 < result.largest_displacement < 0.3
    shift = np.linalg.norm(result.vertices - vertices, axis=1)
    assert result.moved == np.count_nonzero(shift)
    assert result.largest_displacement == shift.max()
    assert result.median_displacement == np.median(shift[shift > 0])


def test_what_does_not_cross_comes_back_to_the_bit():
    apart = two_spheres(2.5)
    nested = join(sphere(subdivisions=3), sphere(0.5, subdivisions=2))
    seen = []
    for vertices, faces in (apart, nested):
        result = untangle_mesh(vertices, faces, on_step=lambda *step: seen.append(step))
        assert result.vertices.tobytes() == vertices.tobytes()
        assert result.free and result.moved == result.steps == 0
        assert result.largest_displacement == result.median_displacement == 0.0
    # A part within another has overlap, but nothing crosses; the result does not hide it.
    assert result.after.volume == pytest.approx(np.pi / 6, rel=0.1) and seen == []


def test_a_part_that_crosses_nothing_stays_where_it_is():
    far = sphere(center=(0.0, 9.0, 0.0), subdivisions=2)
    vertices, faces = join(two_spheres(1.9), far)
    result = untangle_mesh(vertices, faces)
    still = len(far[0])
    assert result.free and 0 < result.moved <= len(vertices) - still
    np.testing.assert_array_equal(result.vertices[-still:], vertices[-still:])


def test_it_does_not_depend_on_the_unit():
    vertices, faces = two_spheres(1.5)
    plain, large = untangle_mesh(vertices, faces), untangle_mesh(1024.0 * vertices, faces)
    # A power of two scales floating point exactly, rays and all.
    np.testing.assert_array_equal(large.vertices, 1024.0 * plain.vertices)
    assert large.steps == plain.steps


def test_turned_and_shifted_it_goes_as_far(rng):
    mesh = two_spheres(1.5)
    turned = moved(mesh, random_rotation(rng), (3.0, -2.0, 1.0))
    plain, other = untangle_mesh(*mesh), untangle_mesh(*turned)
    assert other.free
    assert other.largest_displacement == pytest.approx(plain.largest_displacement, rel=0.1)


def test_never_worse_and_bounded_when_it_cannot():
    vertices, faces = two_spheres(0.5)
    seen = []
    result = untangle_mesh(
        vertices, faces, attempts=2, steps_per_attempt=1, on_step=lambda *s: seen.append(s)
    )
    assert not result.free and result.steps == 2
    assert result.after.crossings <= result.before.crossings
    assert [step[:2] for step in seen] == [(0, 0), (1, 1)]
    assert seen[0][2] == result.before.crossings


def test_contour_forces_shorten_the_contour(rng):
    """Against finite differences: a box's corner edge cut by a large triangle's plane."""
    vertices, faces = join(box((4.0, 4.0, 4.0)), box((1.0, 1.0, 1.0), (2.0, 0.1, 0.2)))
    vertices = vertices + 0.01 * rng.normal(size=vertices.shape)
    surface = Surface(faces, len(vertices))

    def length(points):
        found = edge_crossings(points, surface.faces)
        pairs = {}
        for faces_of, face, point in zip(found.edge_faces, found.face, found.point, strict=True):
            for other in faces_of:
                pairs.setdefault(frozenset((int(other), int(face))), []).append(point)
        return sum(np.linalg.norm(np.subtract(*ends)) for ends in pairs.values() if len(ends) == 2)

    force = contour_forces(surface.faces, vertices, edge_crossings(vertices, surface.faces))
    before, step = length(vertices), 1e-4
    assert before > 3.0
    assert length(vertices + step * force) < before < length(vertices - step * force)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12)  # nothing pushes the whole


def test_spread_is_smooth_symmetric_and_stays_in_its_patch(rng):
    vertices, faces = sphere(subdivisions=3)
    surface = Surface(faces, len(vertices))
    inside = surface.within(np.array([0]), 12)  # three times the reach
    reach = np.zeros(len(vertices))
    reach[inside] = 4.0
    spread = Spread(surface, reach)
    first, second = rng.normal(size=(2, *vertices.shape))
    assert np.sum(spread(first) * second) == pytest.approx(np.sum(first * spread(second)))
    point = np.zeros(vertices.shape)
    point[0] = 1.0
    moves = spread(point)[:, 0]
    outside = np.setdiff1d(np.arange(len(vertices)), inside)
    assert (moves[outside] == 0).all() and moves[0] == moves.max() > 0
    rim = np.setdiff1d(inside, surface.within(np.array([0]), 11))
    assert np.abs(moves[rim]).max() < 0.02 * moves[0]


@pytest.mark.parametrize(
    ("mesh", "options", "message"),
    [
        ((box()[0], box()[1][1:]), {}, "boundary edges"),
        (inverted(box()), {}, "inverted component"),
        ((box()[0] * np.nan, box()[1]), {}, "NaN or infinity"),
        (box(), {"attempts": 0}, "attempts must be a positive whole number: got 0"),
        (box(), {"steps_per_attempt": 1.5}, "steps_per_attempt must be a positive whole number"),
        (box(), {"rays": 0}, "rays must be from 1"),
    ],
)
def test_bad_input_is_named(mesh, options, message, untyped):
    with pytest.raises(ValueError, match=message):
        untangle_mesh(*mesh, **options)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_a_mesh_file_is_freed_in_its_own_format(suffix, tmp_path, capsys):
    import trimesh

    file, out = tmp_path / f"pair{suffix}", tmp_path / "out"
    trimesh.Trimesh(*two_spheres(1.7, 2), process=False).export(file)
    words = ["untangle", str(file), "--out", str(out), "--rays", "256", "--json"]
    assert main([*words, "--meshes"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "report.json").read_text())
    assert report["free"] and report["before"]["crossings"] > 0 == report["after"]["crossings"]
    assert report["mesh"] == f"pair_untangled{suffix}"
    assert report["meshes"] == ["pair_before.glb", "pair_after.glb"]
    assert all((out / name).exists() for name in report["meshes"])
    vertices, faces = read_mesh(out / report["mesh"])
    assert len(vertices) == 324 and not intersects(vertices, faces)


def test_a_mesh_file_that_does_not_come_free_says_so(tmp_path, capsys, monkeypatch):
    import trimesh

    from spt_jax.untangle import mesh as module

    def hasty(*mesh, **options):
        return untangle_mesh(*mesh, **{**options, "attempts": 1, "steps_per_attempt": 1})

    monkeypatch.setattr(module, "untangle_mesh", hasty)
    file = tmp_path / "pair.ply"
    trimesh.Trimesh(*two_spheres(0.5, 2), process=False).export(file)
    assert main(["untangle", str(file), "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert "not free: " in captured.err and "crossings are left" in captured.err
    assert "largest displacement" in captured.out


def test_a_mesh_file_that_cannot_be_untangled(tmp_path, capsys):
    import trimesh

    file, out = tmp_path / "open.ply", tmp_path / "out"
    trimesh.Trimesh(box()[0], box()[1][1:], process=False).export(file)
    assert main(["untangle", str(file), "--out", str(out)]) == 2
    assert "boundary edges" in capsys.readouterr().err and not out.exists()
    assert main(["untangle", str(file), "--out", str(out), "--frames", "1"]) == 2
    assert "frames is for pose files" in capsys.readouterr().err
