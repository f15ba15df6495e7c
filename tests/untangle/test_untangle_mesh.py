"""untangle_mesh: no edge through a triangle any more, by a judge that is not ours, never worse."""

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
    sampling,
    signed_volume,
    sphere,
)
from trimesh.exchange.stl import export_stl_ascii

from spt_jax import RESULTS
from spt_jax.cli.main import main
from spt_jax.io.mesh_files import read_mesh, write_mesh
from spt_jax.overlap.measure import Unmeasurable, measure
from spt_jax.overlap.triangles import near_triangles
from spt_jax.overlap.triangles.pairs import edge_intersections
from spt_jax.untangle.contours import contour_forces
from spt_jax.untangle.freeing import _Search
from spt_jax.untangle.mesh import untangle_mesh
from spt_jax.untangle.places import Places
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
    assert result.is_free and not intersects(result.vertices, faces)
    assert result.vertices.dtype == np.float32
    assert result.before.intersecting_pairs > 0 == result.after.intersecting_pairs
    assert result.after.volume < 1e-3 * result.before.volume
    assert result.largest_displacement < 0.08  # in metres, for up to a litre of overlap


SHAPES = {
    "spheres": two_spheres(1.5),
    "spheres deep in each other": two_spheres(0.5),
    "boxes": join(box(), box(center=(0.5, 0.1, 0.2))),
    "plates": join(box((1.0, 1.0, 0.1)), box((1.0, 1.0, 0.1), (0.1, 0.2, 0.07))),
    "a screw in a block": join(box((4.0, 4.0, 1.0)), box((0.2, 0.2, 0.6), (0.3, 0.1, 0.4))),
    "thin beams": join(box((4, 0.01, 0.01)), box((0.01, 4, 0.01)), box((0.01, 0.01, 4))),
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
    assert result.is_free == (not intersects(result.vertices, faces))
    assert result.is_free and result.vertices.dtype == dtype
    assert result.inverted_parts == 0 and result.relative_displacement <= 1.0


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
    copies = join(*[sphere(subdivisions=1)] * 5)
    seen = []
    for mesh, volume in ((apart, 0.0), (nested, np.pi / 6), (copies, 2 * signed_volume(*copies))):
        result = untangle_mesh(*mesh, on_step=seen.append)
        assert result.vertices.tobytes() == mesh[0].tobytes()
        assert result.moved == result.steps == 0 and result.inverted_parts == 0
        assert result.largest_displacement == result.median_displacement == 0.0
        # A part within another, or on its copy, has overlap, but nothing that crosses; the result
        # does not hide it.
        assert result.after.volume == pytest.approx(volume, rel=0.1) and seen == []
        assert result.is_free == (volume == 0)
        assert result.status == (RESULTS.enclosed if volume else RESULTS.successful)
        assert ("enclosed in another" in result.reason) == (volume > 0)


def test_a_part_that_crosses_nothing_stays_where_it_is():
    far = sphere(center=(0.0, 9.0, 0.0), subdivisions=2)
    vertices, faces = join(two_spheres(1.9), far)
    result = untangle_mesh(vertices, faces)
    still = len(far[0])
    assert result.is_free and 0 < result.moved <= len(vertices) - still
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
    assert other.is_free
    assert other.largest_displacement == pytest.approx(plain.largest_displacement, rel=0.1)


def test_never_worse_and_bounded_when_it_cannot():
    vertices, faces = SHAPES["a tube that enters itself"]
    seen = []
    result = untangle_mesh(vertices, faces, attempts=2, steps_per_attempt=1, on_step=seen.append)
    assert not result.is_free and result.steps == 2
    assert result.status == RESULTS.nonlinear_max_steps_reached
    assert_no_worse(vertices, faces, result)
    # One part alone is not pushed away from others as it is.
    assert [(step.stage, step.steps) for step in seen] == [(0, 0), (1, 1), (2, 2)]
    assert seen[0].intersecting_pairs == result.before.intersecting_pairs


def assert_no_worse(vertices, faces, result):
    """The figures, measured anew, and nothing worse than it was."""
    rounding = float(np.finfo(vertices.dtype).eps)
    before, after = (
        measure(np.float64(points), faces, sampling(None), rounding=rounding)
        for points in (vertices, result.vertices)
    )
    for found, told in ((before, result.before), (after, result.after)):
        assert told.intersecting_pairs == found.total_intersecting_pairs
        assert told.volume == pytest.approx(found.volume, rel=1e-9, abs=1e-15)
    assert result.vertices.dtype == vertices.dtype
    assert after.total_intersecting_pairs <= before.total_intersecting_pairs
    assert after.volume <= before.volume * (1 + 1e-9)
    assert result.is_free == (after.total_intersecting_pairs == 0 and after.volume == 0)
    surface = Surface(faces, len(vertices))
    senses = [surface.part_senses(np.float64(x)) for x in (vertices, result.vertices)]
    assert result.inverted_parts == np.count_nonzero(senses[0] * senses[1] < 0) == 0
    normals = []
    for points in (vertices, result.vertices):
        a, b, c = np.asarray(points, np.float64)[faces].transpose(1, 0, 2)
        normals.append(np.cross(b - a, c - a))
    flipped = np.einsum("fi,fi->f", *normals) < 0
    assert result.flipped_triangles == np.count_nonzero(flipped)
    shift = np.linalg.norm(np.float64(result.vertices) - vertices, axis=1)
    assert result.moved == np.count_nonzero(shift)
    size = surface.part_sizes(np.float64(vertices))[surface.part]
    assert result.relative_displacement == pytest.approx((shift / size).max(), rel=1e-6)
    assert result.relative_displacement <= 1 + 1e-6
    touched = np.unique(surface.part[np.unique(faces[before.surface.pairs[before.surface.listed]])])
    assert not shift[~np.isin(surface.part, touched)].any()  # what intersects nothing stays
    if not before.total_intersecting_pairs:
        assert result.vertices.tobytes() == vertices.tobytes()


def scene(rng):
    """Boxes, plates, beams and spheres thrown together, some of them flush with each other."""
    parts = []
    for _ in range(rng.integers(2, 6)):
        kind = rng.integers(4)
        center = 0.5 * np.round(rng.uniform(-1, 1, 3) * 2) if kind < 2 else rng.uniform(-1, 1, 3)
        extents = [(1, 1, 1), (1, 1, 0.05), (2, 0.03, 0.02), (0.5, 0.4, 0.6)][kind]
        if kind == 3:
            parts.append(sphere(rng.uniform(0.3, 0.8), center, subdivisions=2))
        else:
            parts.append(box(extents, center))
    return join(*parts)


@pytest.mark.parametrize("number", range(12))
def test_never_worse_whatever_is_given(number):
    rng = np.random.default_rng(number)
    rotation = random_rotation(rng) if number % 3 else None
    vertices, faces = moved(scene(rng), rotation, rng.uniform(-1, 1, 3))
    vertices = vertices.astype(np.float32 if number % 2 else np.float64)
    for options in ({"attempts": 1, "steps_per_attempt": 2}, {"steps_per_attempt": 12}):
        assert_no_worse(vertices, faces, untangle_mesh(vertices, faces, **options))


TOUCHING = {
    "a face": join(box(), box(center=(1.0, 0.0, 0.0))),
    "an edge": join(box(), box(center=(1.0, 1.0, 0.0))),
    "a corner": join(box(), box(center=(1.0, 1.0, 1.0))),
    "a lid": join(box(), box((0.5, 0.5, 0.5), (0.1, 0.05, 0.75))),
    "thin plates": join(box((8.0, 8.0, 0.1)), box((8.0, 8.0, 0.1), (0.0, 0.0, 0.1))),
    "plates that do not match": join(box((8.0, 8.0, 0.1)), box((3.0, 3.0, 0.1), (0.3, 0.2, 0.1))),
    "a stack": join(*(box((2.0, 2.0, 0.2), (0.1 * k, 0.0, 0.2 * k)) for k in range(4))),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("contact", TOUCHING)
def test_contact_is_left_as_it_is(contact, dtype, rng):
    for rotation in (None, *(random_rotation(rng) for _ in range(3))):
        vertices, faces = moved(TOUCHING[contact], rotation, rng.uniform(-1, 1, 3))
        vertices = vertices.astype(dtype)
        result = untangle_mesh(vertices, faces)
        assert result.vertices.tobytes() == vertices.tobytes()
        assert result.is_free and result.before.intersecting_pairs == 0 == result.before.volume


def test_flat_faces_of_many_triangles_are_left_as_they_are(rng):
    import trimesh

    for level in (1, 2):
        mesh = trimesh.creation.box()
        for _ in range(level):
            mesh = mesh.subdivide()
        faces = np.array(mesh.faces, np.int64)
        for _ in range(8):
            vertices = mesh.vertices @ random_rotation(rng).T
            for dtype in (np.float32, np.float64):
                given = vertices.astype(dtype)
                result = untangle_mesh(given, faces)
                assert result.is_free and result.vertices.tobytes() == given.tobytes()


def test_contact_stays_where_something_else_is_freed():
    """Two boxes that overlap, and far from them one on another, in single precision and turned."""
    rotation = random_rotation(np.random.default_rng(4))
    apart = join(box(center=(5.0, 0.0, 0.0)), box((0.4, 0.4, 0.4), (5.1, 0.1, 0.7)))
    vertices, faces = moved(join(box(), box(center=(0.6, 0.2, 0.1)), apart), rotation)
    vertices = vertices.astype(np.float32)
    result = untangle_mesh(vertices, faces)
    assert result.is_free and result.moved
    np.testing.assert_array_equal(result.vertices[16:], vertices[16:])


def test_thin_plates_keep_their_sides():
    """Plates in each other by most of their thickness: neither comes out turned over."""
    thin = (1.0, 1.0, 0.02)
    vertices, faces = join(box(thin), box(thin, (0.2, 0.1, 0.004)))
    result = untangle_mesh(vertices, faces)
    assert result.is_free and result.flipped_triangles == 0
    for plate in (faces[:12], faces[12:]):
        assert signed_volume(result.vertices, plate) == pytest.approx(0.02, rel=0.1)
    assert result.largest_displacement < 0.1


def test_parts_turned_over_or_pushed_inside_are_seen(rng):
    vertices, faces = two_spheres(1.5, 1)
    places = Places(Surface(faces, len(vertices)), vertices)
    second = np.arange(len(vertices)) >= len(vertices) // 2
    shift = np.where(second[:, None], [[3.0, 0.0, 0.0]], 0.0)
    apart = places.look(vertices + shift)
    assert apart.left == apart.inverted == 0 and places.is_no_worse(apart)
    mirrored = vertices * np.where(second[:, None], [[-1.0, 1.0, 1.0]], 1.0) + 2 * shift
    turned_over = places.look(mirrored)
    assert turned_over.inverted == 1 and not places.is_no_worse(turned_over)
    small = np.where(second[:, None], 0.1 * (vertices - [1.5, 0.0, 0.0]), vertices)
    inside = places.look(small)
    assert inside.left == 0 and not places.is_no_worse(inside)
    flat = np.where(second[:, None], vertices * [1.0, 1.0, 12.0] + shift, vertices)
    assert places.is_crumpled(places.look(flat)) and not places.is_crumpled(apart)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_cannot_be_measured_is_refused(dtype, monkeypatch):
    vertices, faces = two_spheres(1.5, 2)
    far = (vertices + 1e6 * (1 if dtype == np.float32 else 1e9)).astype(dtype)
    with pytest.raises(Unmeasurable, match="farther from the origin"):
        untangle_mesh(far, faces)
    scales = (1e300, 1e-310) if dtype == np.float64 else (1e38,)
    for scale in scales:
        given = (vertices * scale).astype(dtype)
        if dtype == np.float64:
            with pytest.raises(Unmeasurable, match="a size whose cube is a number"):
                untangle_mesh(given, faces)
        else:
            assert_no_worse(given, faces, untangle_mesh(given, faces))
    for wrong in (
        vertices * np.nan,
        np.where(np.arange(len(vertices))[:, None] == 3, np.inf, vertices),
    ):
        with pytest.raises(ValueError, match="NaN or infinity"):
            untangle_mesh(wrong.astype(dtype), faces)
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS", 0)
    monkeypatch.setattr(near_triangles, "_MOST_PAIRS_EACH", 0)
    with pytest.raises(Unmeasurable, match="coordinates that exploded or collapsed"):
        untangle_mesh(vertices.astype(dtype), faces)


def test_a_step_into_nothing_ends_the_attempt(monkeypatch):
    """A search that runs away comes back with the start, and says so."""
    vertices, faces = SHAPES["a tube that enters itself"]
    monkeypatch.setattr(
        _Search, "move", lambda self, place, *_: np.full(place.vertices.shape, np.nan)
    )
    result = untangle_mesh(vertices, faces)
    assert result.vertices.tobytes() == vertices.tobytes() and not result.is_free
    assert result.status == RESULTS.nonlinear_divergence and "diverged" in result.reason


def test_double_precision_far_from_the_origin():
    vertices, faces = two_spheres(1.5)
    offset = np.array([4e6, -3e5, 1234.5])
    far = vertices + offset
    near, result = untangle_mesh(vertices, faces), untangle_mesh(far, faces)
    assert result.is_free and result.vertices.dtype == np.float64
    assert result.largest_displacement == pytest.approx(near.largest_displacement, rel=1e-3)
    assert not intersects(result.vertices - offset, faces)


def test_contour_forces_shorten_the_contour(rng):
    """Against finite differences: a box's corner edge cut by a large triangle's plane."""
    vertices, faces = join(box((4.0, 4.0, 4.0)), box((1.0, 1.0, 1.0), (2.0, 0.1, 0.2)))
    vertices = vertices + 0.01 * rng.normal(size=vertices.shape)
    surface = Surface(faces, len(vertices))

    def length(points):
        found = edge_intersections(points, surface.faces)
        pairs = {}
        for faces_of, face, point in zip(found.edge_faces, found.face, found.point, strict=True):
            for other in faces_of:
                pairs.setdefault(frozenset((int(other), int(face))), []).append(point)
        return sum(np.linalg.norm(np.subtract(*ends)) for ends in pairs.values() if len(ends) == 2)

    force = contour_forces(surface.faces, vertices, edge_intersections(vertices, surface.faces))
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
        ((box()[0], box()[1][:4]), {}, "open sheet"),
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
    assert (
        report["is_free"]
        and report["before"]["intersecting_pairs"] > 0 == report["after"]["intersecting_pairs"]
    )
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
    trimesh.Trimesh(*SHAPES["a tube that enters itself"], process=False).export(file)
    assert main(["untangle", str(file), "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert "not intersection-free: " in captured.err and "pairs are left" in captured.err
    assert "largest displacement" in captured.out and "triangles turned over" in captured.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert not report["is_free"] and "number of steps" in report["reason"]
    nested = join(sphere(subdivisions=2), sphere(0.5, subdivisions=1))
    trimesh.Trimesh(*nested, process=False).export(file)
    assert main(["untangle", str(file), "--out", str(tmp_path / "out")]) == 1
    assert "enclosed in another" in capsys.readouterr().err
    written, _ = read_mesh(tmp_path / "out" / "pair_untangled.ply")
    np.testing.assert_array_equal(written, nested[0].astype(np.float32))  # as trimesh wrote them


def test_a_mesh_file_that_cannot_be_untangled(tmp_path, capsys):
    import trimesh

    file, out = tmp_path / "open.ply", tmp_path / "out"
    trimesh.Trimesh(box()[0], box()[1][:4], process=False).export(file)
    assert main(["untangle", str(file), "--out", str(out)]) == 2
    assert "open sheet" in capsys.readouterr().err and not out.exists()
    assert main(["untangle", str(file), "--out", str(out), "--frames", "1"]) == 2
    assert "frames is for pose files" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl", ".glb"])
def test_a_mesh_file_far_from_the_origin_is_not_rounded(suffix, tmp_path, capsys):
    """Where single precision would show, and the format knows no other, the result is a .ply."""
    import trimesh

    offset = np.array([4e6, -3e5, 1234.5])
    vertices, faces = two_spheres(1.7, 2)
    file, out = tmp_path / f"pair{suffix}", tmp_path / "out"
    if suffix == ".ply":
        write_mesh(file, vertices + offset, faces)
    elif suffix == ".stl":
        file.write_text(export_stl_ascii(trimesh.Trimesh(vertices, faces)))
        text = file.read_text().splitlines()
        for k, line in enumerate(text):
            if "vertex" in line:
                x, y, z = (np.array(line.split()[1:], float) + offset).tolist()
                text[k] = f"vertex {x!r} {y!r} {z!r}"
        file.write_text("\n".join(text))
    elif suffix == ".glb":
        write_mesh(file, vertices + offset, faces)  # about its middle, which a node moves
    else:
        start = ["OFF", f"{len(vertices)} {len(faces)} 0"] if suffix == ".off" else []
        vertex, face, first = ("", "3 ", 0) if suffix == ".off" else ("v ", "f ", 1)
        lines = [*start, *(vertex + " ".join(map(repr, v)) for v in (vertices + offset).tolist())]
        lines += [face + " ".join(map(str, f)) for f in (faces + first).tolist()]
        file.write_text("\n".join(lines))
    before, corners = read_mesh(file)
    assert np.abs(before[corners].mean(axis=(0, 1)) - offset - [0.85, 0, 0]).max() < 1e-3
    assert main(["untangle", str(file), "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    written = ".ply" if suffix in (".stl", ".glb") else suffix
    assert report["mesh"] == f"pair_untangled{written}" and report["is_free"]
    assert ("single precision" in capsys.readouterr().err) == (suffix != written)
    after, triangles = read_mesh(out / report["mesh"])
    assert np.array_equal(triangles, corners) and not intersects(after - offset, triangles)
    still = (after == before).all(axis=1)
    assert 0 < np.count_nonzero(~still) == report["moved"] < len(before)
    assert np.abs(after - before).max() < 0.3
