import json

import numpy as np
import pytest
import trimesh
from helpers import box, inverted, join, lens_volume, moved, random_rotation, sphere
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax import classify_vertices, self_intersection_penalty
from spt_jax._mesh_check import check_mesh
from spt_jax._report import intersection_report

CLEAN = {
    "nonfinite_vertices": 0,
    "out_of_range_faces": 0,
    "degenerate_faces": 0,
    "duplicate_faces": 0,
    "boundary_edges": 0,
    "holes": 0,
    "misoriented_edges": 0,
    "nonmanifold_edges": 0,
    "unbalanced_edges": 0,
    "nonmanifold_vertices": 0,
    "inverted_components": 0,
    "inward_components": 0,
    "unreferenced_vertices": 0,
}


def counts(check):
    """The counts that are not what they are on a clean mesh."""
    return {name: getattr(check, name) for name in CLEAN if getattr(check, name) != CLEAN[name]}


def as_trimesh(mesh):
    return trimesh.Trimesh(*mesh, process=False)


@pytest.mark.parametrize("mesh", [box(), sphere(), join(box(), box(center=(0.5, 0, 0)))])
def test_a_clean_mesh_has_nothing_to_report(mesh):
    check = check_mesh(*mesh)
    assert counts(check) == {} and check.ok and check.problems == check.warnings == ()
    assert check.euler_number == as_trimesh(mesh).euler_number
    assert check.components == as_trimesh(mesh).body_count
    check.raise_if_unfit()


def test_holes_and_their_edges():
    vertices, faces = sphere(subdivisions=2)
    one_face = faces[1:]
    apart = faces[np.abs(vertices[faces].mean(axis=1)[:, 2]) < 0.9]  # both poles cut off
    check = check_mesh(vertices, one_face)
    assert check.holes == 1 and check.boundary_edges == check.largest_hole.edges == 3 and check.ok
    check = check_mesh(vertices, apart)
    assert check.holes == 2 and check.boundary_edges > 6 and check.ok
    assert check.unreferenced_vertices == len(vertices) - len(np.unique(apart))
    assert "2 holes, the largest of 12 edges" in str(check)
    assert check_mesh(vertices, apart[:, ::-1]).inverted_components == 1
    ring = faces[np.abs(vertices[faces].mean(axis=1)[:, 2]) < 0.2]
    check = check_mesh(vertices, ring)
    assert not check.ok and check.open_sheets == 1 and "fill_holes" in check.problems[0]


def test_faces_turned_round():
    vertices, faces = sphere(subdivisions=2)
    faces[[5, 100]] = faces[[5, 100], ::-1]
    assert counts(check_mesh(vertices, faces)) == {"misoriented_edges": 6}


def test_inverted_parts_and_cavities():
    apart = join(inverted(box()), box(center=(3, 0, 0)))
    assert counts(check_mesh(*apart)) == {"inverted_components": 1}
    hollow = join(box(), inverted(box(extents=(0.5, 0.5, 0.5))))
    check = check_mesh(*hollow)
    assert counts(check) == {"inward_components": 1} and check.ok and check.warnings
    inside_out = join(inverted(box()), box(extents=(0.5, 0.5, 0.5)))
    assert counts(check_mesh(*inside_out)) == {"inverted_components": 1}
    assert "1 inverted component of 2" in check_mesh(*inside_out).problems[0]


def test_repeated_and_degenerate_faces():
    vertices, faces = box()
    doubled = np.concatenate([faces, faces[3:5, [1, 2, 0]]])
    check = check_mesh(vertices, doubled)
    assert counts(check) == {"duplicate_faces": 2} and not check.ok
    collapsed = np.concatenate([faces, [[0, 0, 1], [2, 2, 2]]])
    check = check_mesh(vertices, collapsed)
    assert counts(check) == {"degenerate_faces": 2} and check.ok


def test_values_that_are_no_mesh():
    vertices, faces = box()
    vertices[[2, 3], 1] = np.nan, np.inf
    faces = np.concatenate([faces, [[0, 1, 8], [-1, 0, 1]]])
    check = check_mesh(vertices, faces)
    assert counts(check) == {"nonfinite_vertices": 2, "out_of_range_faces": 2}
    with pytest.raises(ValueError, match=r"got 2 vertices with NaN.*; 2 faces with an index"):
        check.raise_if_unfit()


def test_edges_of_three_faces_are_a_problem_and_of_four_a_warning():
    vertices, faces = box()
    fin = np.concatenate([faces, [[faces[0, 0], faces[0, 1], 8]]])
    check = check_mesh(np.concatenate([vertices, [[2.0, 2.0, 2.0]]]), fin)
    assert check.nonmanifold_edges == check.unbalanced_edges == 1 and not check.ok
    # Two boxes share the edge x = y = 0.5: the winding number is as well defined as without it.
    both = as_trimesh(join(box(), box(center=(1, 1, 0))))
    both.merge_vertices()
    check = check_mesh(both.vertices, both.faces)
    assert counts(check) == {"nonmanifold_edges": 1} and check.ok and check.warnings
    assert intersection_report(both.vertices, both.faces, rays=64).volume == 0


def test_parts_that_touch_in_a_vertex():
    both = as_trimesh(join(box(), box(center=(1, 1, 1))))
    both.merge_vertices()
    check = check_mesh(both.vertices, both.faces)
    assert counts(check) == {"nonmanifold_vertices": 1} and check.ok
    assert check.components == 2


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=60)
def test_agrees_with_trimesh_on_random_damage(seed):
    rng = np.random.default_rng(seed)
    parts = [sphere(center=(2.5 * k, 0, 0), subdivisions=1) for k in range(rng.integers(1, 4))]
    parts = [inverted(part) if rng.random() < 0.3 else part for part in parts]
    vertices, faces = join(*parts)
    faces = faces[rng.random(len(faces)) > rng.choice([0, 0, 0.02, 0.3])]
    turned = rng.random(len(faces)) < rng.choice([0, 0, 0.02, 0.3])
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    faces = np.stack([np.roll(face, rng.integers(3)) for face in rng.permutation(faces)])
    mesh, check = as_trimesh((vertices, faces)), check_mesh(vertices, faces)

    assert mesh.is_watertight == (check.boundary_edges + check.nonmanifold_edges == 0)
    assert mesh.is_winding_consistent == (check.misoriented_edges + check.unbalanced_edges == 0)
    # Not body_count, which joins parts that share only a vertex.
    parts = trimesh.graph.connected_components(
        mesh.face_adjacency, nodes=np.arange(len(faces)), min_len=1
    )
    assert check.components == len(parts)
    assert mesh.euler_number == check.euler_number
    assert check.unreferenced_vertices == len(vertices) - len(np.unique(faces))
    once = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    assert check.boundary_edges == len(once)
    assert check.holes == len(
        trimesh.graph.connected_components(mesh.edges_sorted[once], min_len=2) if len(once) else []
    )
    if check.boundary_edges + check.misoriented_edges == 0:
        assert check.inverted_components == sum(part.volume < 0 for part in mesh.split())


def test_a_random_soup_agrees_with_a_slow_count(rng):
    faces = rng.integers(0, 12, (60, 3))
    check = check_mesh(rng.normal(size=(12, 3)), faces)
    proper = {
        min(f[k:] + f[:k] for k in range(3)) for f in map(tuple, faces.tolist()) if len(set(f)) == 3
    }
    ways = {}
    for f in proper:
        for k in range(3):
            a, b = f[k], f[(k + 1) % 3]
            ways.setdefault((min(a, b), max(a, b)), []).append(1 if a < b else -1)
    assert check.degenerate_faces == sum(len(set(f)) < 3 for f in faces.tolist())
    assert check.duplicate_faces == 60 - check.degenerate_faces - len(proper)
    assert check.boundary_edges == sum(len(w) == 1 for w in ways.values())
    assert check.misoriented_edges == sum(len(w) == 2 and sum(w) != 0 for w in ways.values())
    assert check.nonmanifold_edges == sum(len(w) > 2 for w in ways.values())
    assert check.unbalanced_edges == sum(len(w) > 2 and sum(w) != 0 for w in ways.values())
    pinched = 0
    for v in range(12):
        fans = [{f} for f in proper if v in f]
        merged = True
        while merged:
            merged = False
            for i in range(len(fans)):
                for j in range(i):
                    if any(len({*f} & {*g}) > 1 for f in fans[i] for g in fans[j]):
                        fans[j] |= fans.pop(i)
                        merged = True
                        break
                if merged:
                    break
        pinched += len(fans) > 1
    assert check.nonmanifold_vertices == pinched


def test_check_mesh_refuses_what_is_no_mesh():
    vertices, faces = box()
    with pytest.raises(TypeError, match="vertices must be float32 or float64: got int64"):
        check_mesh(vertices.astype(int), faces)
    with pytest.raises(TypeError, match="faces must be whole numbers: got float64"):
        check_mesh(vertices, faces.astype(float))
    with pytest.raises(ValueError, match=r"faces must have shape \(F, 3\): got \(9, 4\)"):
        check_mesh(vertices, np.zeros((9, 4), int))
    with pytest.raises(ValueError, match=r"one mesh of shape \(V, 3\): got \(2, 8, 3\)"):
        check_mesh(np.stack([vertices, vertices]), faces)


def test_an_empty_mesh_is_fit_and_says_so():
    check = check_mesh(np.zeros((4, 3)), np.zeros((0, 3), int))
    assert check.ok and "no faces" in check.warnings[0]
    report = intersection_report(np.zeros((4, 3)), np.zeros((0, 3), int))
    assert report.volume == report.ratio == report.solid_volume == 0 and str(report)


def test_the_check_prints_in_color():
    from rich.console import Console

    vertices, faces = box()
    console = Console(width=400, color_system="standard", force_terminal=True)
    with console.capture() as capture:
        console.print(check_mesh(vertices, np.concatenate([faces, faces[:1], [[0, 0, 1]]])))
    text = capture.get()
    assert "\x1b[31m  problem:" in text and "\x1b[33m  warning:" in text


def test_report_of_two_spheres_in_closed_form():
    pair = join(sphere(), sphere(center=(1.0, 0.2, 0.1)))
    report = intersection_report(*pair)
    distance = np.sqrt(1 + 0.04 + 0.01)
    assert report.rays is None and report.crossings == ()  # none needed
    assert report.intersecting_pairs == report.total_intersecting_pairs > 100
    assert report.volume == report.total_volume
    assert report.volume == pytest.approx(lens_volume(distance), rel=0.02)
    assert report.solid_volume == pytest.approx(as_trimesh(pair).volume)
    assert set(report.volumes) == {report.volume}
    seen = intersection_report(*pair, rays=512)
    assert min(seen.crossings) > 4e5
    assert seen.volume == pytest.approx(report.volume, rel=2e-3)
    assert report.num_penetrating + report.num_clear == len(pair[0]) and report.num_inverted == 0
    assert not report.is_free


def test_report_sees_inverted_parts():
    report = intersection_report(*inverted(box()), rays=128)
    assert report.num_inverted == 8 and report.ratio == 1
    assert report.volume == pytest.approx(1, rel=0.01)
    assert report.solid_volume == pytest.approx(-1)


def test_report_is_that_of_the_penalty(x64, rng):
    vertices, faces = moved(join(sphere(), box(center=(0.9, 0, 0))), random_rotation(rng))
    directions = rng.normal(size=(2, 3))
    report = intersection_report(vertices, faces, rays=(90, 70), directions=directions)
    options = {"rays": (90, 70), "directions": directions}
    assert report.volume == float(self_intersection_penalty(vertices, faces, **options))
    found = classify_vertices(vertices, faces, **options)
    np.testing.assert_array_equal(report.labels, found.labels)
    assert report.ratio == pytest.approx(float(found.ratio))


def test_report_far_from_the_origin():
    vertices, faces = join(box(), box(center=(0.5, 0, 0)))
    report = intersection_report(vertices + 1e6, faces, rays=200)
    assert report.volume == pytest.approx(0.5, rel=0.02)
    assert report.solid_volume == pytest.approx(2, rel=1e-6)


def test_report_lists_the_holes_that_it_closes():
    vertices, faces = box()
    report = intersection_report(vertices, faces[1:])
    assert report.solid_volume == pytest.approx(1) and report.is_free
    (hole,) = report.as_dict()["holes"]
    assert hole["edges"] == 3 and hole["length"] == pytest.approx(2 + np.sqrt(2))
    assert "1 hole of 3 edges, 3.41 unit long, 16.9% of its part" in str(report)
    with pytest.raises(ValueError, match="open sheet, which encloses nothing"):
        intersection_report(vertices, faces[:4])


def test_report_as_table_and_as_json():
    report = intersection_report(*join(box(), box(center=(0.5, 0, 0))), rays=64, directions=1)
    text = str(report)
    assert "overlap volume" in text and "unit³" in text and "penetrating" in text
    assert "\x1b" not in text and text == "\n".join(x.rstrip() for x in text.splitlines())
    found = json.loads(json.dumps(report.as_dict()))
    assert found["volume"] == report.volume and found["num_penetrating"] == report.num_penetrating
    assert len(found["beams"]) == 1 and found["beams"][0]["crossings"] == report.crossings[0]


def test_report_refuses_what_the_penalty_refuses():
    vertices, faces = box()
    with pytest.raises(ValueError, match="faces must index into vertices: got index 8 for 8"):
        intersection_report(vertices, faces + 1)
    with pytest.raises(ValueError, match="rays must be from 1"):
        intersection_report(vertices, faces, rays=0)
    with pytest.raises(ValueError, match="one mesh"):
        intersection_report(np.stack([vertices, vertices]), faces)
    vertices[0] = np.nan
    with pytest.raises(ValueError, match="vertices must be finite: got NaN or infinity in 1 of 8"):
        intersection_report(vertices, faces)
