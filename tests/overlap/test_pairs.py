"""Edges through triangles, against exact arithmetic, IPC Toolkit and the laws of two surfaces."""

import threading

import ipctk
import numpy as np
import pytest
from helpers import body_faces, box, join, moved, posed_bodies, random_rotation, sphere

from spt_jax.overlap.arrays import pieces
from spt_jax.overlap.triangles import pair_boxes, pair_layout
from spt_jax.overlap.triangles.contours import find_contours
from spt_jax.overlap.triangles.manifold import manifold_of
from spt_jax.overlap.triangles.pair_layout import prepared
from spt_jax.overlap.triangles.pairs import edge_intersections, face_pairs


@pytest.fixture(autouse=True)
def clear_caches():
    """No test sees the layouts that another one left."""
    pair_layout._meshes.clear()


def edges_of(faces):
    half = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(half, axis=0)


def found_in(mesh, **options):
    found = edge_intersections(*mesh, **options)
    return {
        (*edge, face) for edge, face in zip(found.edge.tolist(), found.face.tolist(), strict=True)
    }


def volume_sign(a, b, c, d):
    """The sign of a tetrahedron with whole-numbered corners, exactly."""
    (x, y, z), (u, v, w), (p, q, r) = (
        [int(i - j) for i, j in zip(k, a, strict=True)] for k in (b, c, d)
    )
    value = x * (v * r - w * q) - y * (u * r - w * p) + z * (u * q - v * p)
    return (value > 0) - (value < 0)


def exact(vertices, faces):
    """Every edge against every triangle in whole numbers; and whether any only touch."""
    found, touching = set(), False
    for p, q in edges_of(faces).tolist():
        for f, corners in enumerate(faces.tolist()):
            if p in corners or q in corners:
                continue
            a, b, c = vertices[corners]
            ends = [volume_sign(a, b, c, vertices[k]) for k in (p, q)]
            around = {
                volume_sign(vertices[p], vertices[q], *side) for side in ((a, b), (b, c), (c, a))
            }
            if ends[0] != ends[1] and len(around - {0}) < 2:
                touching |= 0 in ends or 0 in around
                found.add((p, q, f))
    return found, touching


def whole(vertices, steps=1 << 20):
    """Vertices rounded to whole numbers, still as float64: exact for both sides."""
    return np.round(vertices * steps)


def noisy(mesh, noise, rng):
    return mesh[0] + noise * rng.normal(size=mesh[0].shape), mesh[1]


def soup(rng):
    faces = np.array([rng.permutation(16)[:3] for _ in range(24)])
    return rng.normal(size=(16, 3)), faces


def crossing_boxes(rng):
    return join(*(moved(box(), random_rotation(rng), 0.5 * rng.normal(size=3)) for _ in range(4)))


def crumpled(rng):
    return noisy(sphere(subdivisions=1), 0.35, rng)


def fan(rng):
    """A star of triangles round one vertex, which cross each other though all of them share it."""
    rim = rng.normal(size=(11, 3))
    k = np.arange(11)
    return np.concatenate([rim, np.zeros((1, 3))]), np.stack([k, (k + 1) % 11, 0 * k + 11], axis=1)


@pytest.mark.parametrize("make", [soup, crossing_boxes, crumpled, fan])
def test_crossings_are_those_of_exact_arithmetic(make):
    total = 0
    for seed in range(2 if make is crumpled else 6):
        vertices, faces = make(np.random.default_rng(seed))
        vertices = whole(vertices)
        expected, touching = exact(vertices, faces)
        assert not touching
        assert found_in((vertices, faces)) == expected
        total += len(expected)
    assert total > 30


def test_an_edge_opposite_the_shared_vertex_is_found():
    vertices = np.array([[0, 0, 0], [4, -1, 0], [4, 1, 0], [3, 0, -1], [3, 0, 1]], float)
    assert found_in((vertices, np.array([[0, 1, 2], [0, 3, 4]]))) == {(3, 4, 0)}


def test_a_fan_that_turns_twice_is_not_taken_for_flat():
    """All its triangles face up, and no vertex of the rim lies near another."""
    turn = np.arange(5) * 4 * np.pi / 5
    rim = np.stack([np.cos(turn), np.sin(turn), 0.3 * np.sin(turn / 2 + 0.4)], axis=1)
    vertices = whole(np.concatenate([rim, np.zeros((1, 3))]))
    k = np.arange(5)
    faces = np.stack([k, (k + 1) % 5, 0 * k + 5], axis=1)
    expected, _ = exact(vertices, faces)
    assert expected
    assert found_in((vertices, faces)) == expected


def by_candidates(vertices, faces):
    """IPC Toolkit's broad phase, and barycentric coordinates by a linear solver."""
    mesh = ipctk.CollisionMesh(vertices, edges_of(faces), faces)
    broad = ipctk.LBVH()
    broad.build(vertices, mesh.edges, mesh.faces, 0.0)
    near = np.array([(c.edge_id, c.face_id) for c in broad.detect_edge_face_candidates()])
    ends, corners = mesh.edges[near[:, 0]], mesh.faces[near[:, 1]]
    apart = (ends[:, :, None] != corners[:, None, :]).all(axis=(1, 2))
    ends, corners, face = ends[apart], corners[apart], near[apart, 1]
    p, q = vertices[ends].transpose(1, 0, 2)
    a, b, c = vertices[corners].transpose(1, 0, 2)
    sides = np.stack([q - p, a - b, a - c], axis=2)
    regular = np.abs(np.linalg.det(sides)) > 1e-30
    part = np.linalg.solve(sides[regular], (a - p)[regular][..., None])[..., 0]
    s, u, v = part.T
    through = (s >= 0) & (s <= 1) & (u >= 0) & (v >= 0) & (u + v <= 1)
    ends, face = ends[regular][through], face[regular][through]
    return {(*map(int, edge), int(f)) for edge, f in zip(ends, face, strict=True)}


BODIES = ("crawl/0012", "dance_a/0010", "backflip/0002")


def test_bodies_cross_where_ipc_toolkit_says():
    faces = body_faces()
    for vertices in posed_bodies(BODIES):
        expected = by_candidates(vertices, faces)
        assert len(expected) > 0
        assert found_in((vertices, faces)) == expected


def test_crossing_or_not_agrees_with_ipc_toolkit(rng):
    answers = []
    for noise in np.linspace(0.02, 0.12, 30):
        vertices, faces = noisy(sphere(subdivisions=2), noise, rng)
        mesh = ipctk.CollisionMesh(vertices, edges_of(faces), faces)
        answers.append(ipctk.has_intersections(mesh, vertices))
        assert bool(found_in((vertices, faces))) == answers[-1]
    assert 5 < sum(answers) < 25


@pytest.mark.parametrize("make", [crumpled, crossing_boxes])
def test_two_triangles_cross_along_a_segment_with_two_ends(make, rng):
    """One of the ends is the shared vertex where there is one, and not a crossing."""
    vertices, faces = make(rng)
    found = edge_intersections(vertices, faces)
    ends: dict = {}
    for of_edge, face in zip(found.edge_faces.tolist(), found.face.tolist(), strict=True):
        for other in of_edge:
            pair = (min(other, face), max(other, face))
            ends[pair] = ends.get(pair, 0) + 1
    assert sorted(map(list, ends)) == face_pairs(found).tolist() != []
    for (f, g), count in ends.items():
        assert count == 2 - len(set(faces[f]) & set(faces[g]))


def test_points_lie_on_edge_and_triangle(rng):
    vertices, faces = crumpled(rng)
    found = edge_intersections(vertices, faces)
    p, q = vertices[found.edge].transpose(1, 0, 2)
    a, b, c = vertices[faces[found.face]].transpose(1, 0, 2)
    off_edge = np.linalg.norm(np.cross(found.point - p, q - p), axis=1)
    normal = np.cross(b - a, c - a)
    off_plane = np.abs(np.einsum("kd,kd->k", normal, found.point - a))
    assert off_edge.max() < 1e-14
    assert (off_plane / np.linalg.norm(normal, axis=1)).max() < 1e-13
    for edge, of_edge in zip(found.edge, found.edge_faces, strict=True):
        assert all(set(edge) <= set(faces[f]) for f in of_edge)


@pytest.mark.parametrize("scale", [1e-6, 1e6, 1e-120, 1e100])
def test_scale_changes_nothing(scale, rng):
    vertices, faces = crumpled(rng)
    assert found_in((scale * vertices, faces)) == found_in((vertices, faces))


def test_rigid_motion_changes_nothing(rng):
    mesh = crumpled(rng)
    assert found_in(moved(mesh, random_rotation(rng), 3 * rng.normal(size=3))) == found_in(mesh)


def test_order_of_faces_and_corners_changes_only_names(rng):
    vertices, faces = noisy(sphere(subdivisions=3), 0.04, rng)
    order = rng.permutation(len(faces))
    shuffled = faces[order].copy()
    shuffled[::3] = np.roll(shuffled[::3], 1, axis=1)
    shuffled[1::3] = shuffled[1::3, ::-1]
    renamed = {(p, q, int(order[f])) for p, q, f in found_in((vertices, shuffled))}
    assert renamed == found_in((vertices, faces)) != set()


def test_earlier_shapes_and_threads_change_nothing(rng):
    _, faces = mesh = noisy(sphere(subdivisions=3), 0.04, rng)
    expected = found_in(mesh)
    # First seen with its vertices strewn about, then as it is: a new layout must be made.
    pair_layout._meshes.clear()
    strewn = (rng.normal(size=mesh[0].shape), faces)
    few = (mesh[0] * [1, 1, 1e-3], faces)
    assert len(found_in(strewn)) > 1000
    assert found_in(mesh) == expected
    answers = []
    threads = [
        threading.Thread(
            target=lambda m: answers.append((m, found_in((m[0], m[1].copy())))), args=(m,)
        )
        for m in 3 * [mesh, few]
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 6
    assert all(found == expected for m, found in answers if m is mesh)


def test_small_parts_give_what_large_ones_do(rng, monkeypatch):
    mesh = noisy(sphere(subdivisions=3), 0.04, rng)
    expected = found_in(mesh)
    monkeypatch.setattr(pieces, "_CHUNK", 100)
    assert found_in(mesh) == expected != set()


@pytest.mark.parametrize("spokes", [20, 400])
def test_triangles_that_share_a_vertex_are_known_from_the_faces(spokes, rng):
    # A pole of 400 triangles belongs to more clusters than are kept; its pairs are left open.
    angle = np.linspace(0, 2 * np.pi, spokes, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), rng.normal(size=spokes)], axis=1)
    here, there = np.arange(spokes), np.roll(np.arange(spokes), -1)
    poles = np.repeat([spokes, spokes + 1], spokes)
    faces = np.stack([np.tile(here, 2), np.tile(there, 2), poles], axis=1)
    vertices = np.concatenate([rim, [[0, 0, 5], [0, 0, -5]]])
    layout = prepared(faces, len(vertices)).arrange(pair_boxes._face_boxes(vertices.T, faces))
    sharing, size = layout.sharing, pair_layout.CLUSTER
    first, second = (x.ravel() for x in np.triu_indices(len(layout.face), 1))
    filled = np.ones(len(layout.face), bool)
    filled[layout.empty] = False
    kept = filled[first] & filled[second] & (first // size != second // size)
    first, second = first[kept], second[kept]
    groups = sharing.rows_of(first // size**2, second // size**2)
    row = sharing.row[groups, first // size % size * size + second // size % size]
    apart = sharing.apart[row, first % size, second % size]
    p, q = layout.corners[:, first], layout.corners[:, second]
    share = (p[:, None] == q[None]).any(axis=(0, 1))
    assert (share & apart).any() == (spokes == 400)
    assert (apart | share).all()
    assert share[~apart].sum() > spokes


def test_large_triangles_beside_small_ones():
    small = moved(sphere(0.1, subdivisions=4), np.eye(3), (0.48, 0.03, 0.02))
    mesh = join(box((100.0, 1.0, 1.0), (-49.5, 0.0, 0.0)), small)
    found = edge_intersections(*mesh)
    assert len(found.face) > 100
    assert found_in(mesh) == by_candidates(*mesh)
    assert np.allclose(found.point[:, 0], 0.5)


def test_an_edge_meets_one_of_the_two_triangles_that_it_passes_between(rng):
    """Needles aimed exactly at edges of a sheet, from both sides, at dyadic points."""
    n = 9
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    height = rng.integers(-2, 3, size=(n, n))
    sheet = np.stack([x, y, height], axis=-1).reshape(-1, 3).astype(float)
    a = (n * x + y)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    edges = edges_of(faces)
    inner = ~(np.isin(sheet[edges], (0.0, n - 1.0))[..., :2].any(axis=1)).any(axis=1)
    for weight in (0.25, 0.5, 0.75):
        aim = sheet[edges[inner, 0]] * weight + sheet[edges[inner, 1]] * (1 - weight)
        up = np.array([0.0, 0.0, 8.0])
        low, high = aim - up, aim + up
        far = aim + np.array([0.125, 0.0625, 16.0])
        count, first = len(aim), len(sheet)
        k = np.arange(count)
        needles = np.stack([first + k, first + count + k, first + 2 * count + k], axis=1)
        mesh = np.concatenate([sheet, low, high, far]), np.concatenate([faces, needles])
        hits = [edge for *edge, face in found_in(mesh) if face < len(faces)]
        vertical = [p for p, q in hits if q - p == count and p < first + count]
        assert sorted(vertical) == list(range(first, first + count))


def test_triangles_in_one_plane_only_touch(rng):
    """They are told from others of the same crossings by the contours."""
    flat = np.concatenate([rng.normal(size=(30, 2)), np.zeros((30, 1))], axis=1)
    faces = np.arange(30).reshape(10, 3)
    upright = np.array([[0.0, 0, -1], [0, 0, 1], [0.3, 0.1, 1]])
    mesh = np.concatenate([flat, upright]), np.concatenate([faces, [[30, 31, 32]]])
    found = find_contours(mesh[0], prepared(mesh[1], 33).topology, edge_intersections(*mesh))
    proper = found.pair[found.proper(*mesh, 1e-15)]
    assert 0 < len(proper) < len(found.pair) and (proper[:, 1] == 10).all()


def test_among_keeps_what_touches_the_marked_faces(rng):
    vertices, faces = join(noisy(sphere(subdivisions=2), 0.1, rng), crossing_boxes(rng))
    every = edge_intersections(vertices, faces)
    for share in (0.0, 0.05, 0.5, 1.0):
        marked = rng.random(len(faces)) < share
        kept = marked[every.face] | marked[every.edge_faces].any(axis=1)
        found = edge_intersections(vertices, faces, among=marked)
        assert np.array_equal(found.edge, every.edge[kept])
        assert np.array_equal(found.face, every.face[kept])
        assert np.array_equal(found.point, every.point[kept])


def test_edges_of_one_and_of_three_triangles():
    sheet = [[0, 0, 0], [2, 0, 0], [0, 2, 0]]
    blades = [[0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 2], [-3, 3, 2], [-3, -3, 2]]
    vertices = np.array(sheet + blades, float)
    blade = np.array([[0, 1, 2], [3, 4, 5], [3, 4, 6], [3, 4, 7]])
    for count in (1, 2, 3):
        found = edge_intersections(vertices, blade[: count + 1])
        through = (found.edge == [3, 4]).all(axis=1)
        expected = {1: [[1, -1]], 2: [[1, 2]], 3: [[1, 2], [3, -1]]}[count]
        assert found.edge_faces[through].tolist() == expected
        assert {(0, f) for f in range(1, count + 1)} <= set(map(tuple, face_pairs(found).tolist()))


def test_copies_and_strangers_among_the_vertices_change_nothing(rng):
    vertices, faces = crossing_boxes(rng)
    extra = np.concatenate([vertices, 50 * rng.normal(size=(5, 3))])
    assert found_in((extra, faces)) == found_in((vertices, faces))
    # Every corner its own vertex: the boxes' own walls now touch, and still only they cross.
    loose = (vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    between = face_pairs(edge_intersections(*loose))
    between = between[between[:, 0] // 12 != between[:, 1] // 12]
    expected = face_pairs(edge_intersections(vertices, faces))
    assert between.tolist() == expected.tolist()


def test_nothing_to_find():
    none = np.zeros((0, 3), np.int64)
    vertices, faces = box()
    broken = vertices.copy()
    broken[3, 1] = np.nan
    for mesh in (
        (np.zeros((0, 3)), none),
        (vertices, none),
        (vertices, faces),
        (vertices, faces[:1]),
        (0 * vertices, faces),
        (broken, faces),
    ):
        found = edge_intersections(*mesh)
        assert found.edge.shape == found.edge_faces.shape == (0, 2)
        assert found.face.shape == (0,) and found.point.shape == (0, 3)
        assert face_pairs(found).shape == (0, 2)


def test_faces_out_of_range_are_refused():
    with pytest.raises(IndexError, match="got indices 0 to 8 for 8 vertices"):
        edge_intersections(np.zeros((8, 3)), np.array([[0, 1, 8]]))


def test_memory_of_meshes_is_bounded(rng):
    for k in range(4, 14):
        edge_intersections(rng.normal(size=(k, 3)), np.array([[0, 1, 2], [1, 2, 3]]))
    assert len(pair_layout._meshes) <= 4


def test_vertices_that_no_face_uses_make_another_mesh():
    """Faces that had to be rewritten are known again for as many vertices alone."""
    vertices, faces = join(box(), box((0.5,) * 3))
    faces = np.concatenate([faces, faces[:12]])  # the outer one twice
    for extra in (0, 3, 0):
        found = manifold_of(faces, len(vertices) + extra)
        assert found.origin.max() == len(vertices) + extra - 1
        assert manifold_of(faces, len(vertices) + extra) is found


def test_a_triangle_as_large_as_the_mesh_meets_no_empty_slot():
    """It spans the box around everything along all axes; each crossing is listed once."""
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [1, 3, 0], [1, 2, 3]])
    mesh = join((corner, faces), box((0.2, 0.3, 0.4), (0.3, 0.35, 0.3)))
    found = edge_intersections(*mesh)
    assert len(found.face) == len(found_in(mesh)) > 0
