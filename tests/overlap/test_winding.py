"""The vertex rule: the winding number just outside every vertex, against libigl's exact one."""

import functools
from contextlib import nullcontext

import igl
import numpy as np
import pytest
from helpers import (
    body_faces,
    box,
    inverted,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
    winding_number,
)
from scipy.spatial import ConvexHull

from spt_jax.overlap.exact import ExactOverlap
from spt_jax.overlap.measure import Unmeasurable, measure
from spt_jax.overlap.surface import ExactSurface
from spt_jax.overlap.triangles import part_roots

FRAMES = ["roll/0053", "crawl/0092", "dance_a/0068"]


def w_out(mesh):
    vertices, faces = mesh
    rounding = float(np.finfo(vertices.dtype).eps)
    return ExactOverlap(ExactSurface(vertices.astype(float), faces, rounding)).winding


def outward(mesh):
    """A unit vector at each vertex with all of its triangles' normals in front of it, by the
    perceptron rule from the mean normal, and where there is none."""
    vertices, faces = mesh
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    of, normal = faces.T.ravel(), np.tile(normal, (3, 1))
    out = np.zeros(vertices.shape)
    np.add.at(out, of, normal)
    bad = np.ones(len(vertices), bool)
    for _ in range(300):
        out[bad] /= np.linalg.norm(out[bad], axis=1, keepdims=True)
        corner = np.flatnonzero(bad[of])
        cosine = np.einsum("ki,ki->k", out[of[corner]], normal[corner])
        order = np.argsort(-cosine)
        worst = np.full(len(vertices), -1)
        worst[of[corner[order]]] = order  # the last one written is the least
        bad[bad] = cosine[worst[bad]] < 0.05
        if not bad.any():
            break
        out[bad] += 0.3 * normal[corner[worst[bad]]]
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    behind = np.einsum("ki,ki->k", out[of], normal) <= 0
    return out, np.flatnonzero(np.bincount(of, behind, len(vertices)))


def disagreeing(mesh, step=1e-6, some=slice(None)):
    """Those of some vertices where w_out is not libigl's number just outside.

    Just inside it is one more, but at a vertex whose own triangles pass through one another. Where
    no side is outside all of them, both sides of each of them, next to the vertex, stand in: w_out
    must be among the numbers of the outer sides, and one more among those of the inner ones.
    """
    vertices, faces = mesh
    ours = w_out(mesh)
    out, unclear = outward(mesh)
    clear = np.setdiff1d(np.arange(len(vertices))[some], unclear)
    unclear = np.intersect1d(np.arange(len(vertices))[some], unclear)
    outside, within = (
        np.rint(winding_number(mesh, vertices[clear] + side * step * out[clear]))
        for side in (1, -1)
    )
    # Exactly one more within, but for the crossed ones: there ours is outside too.
    assert np.mean(within == outside + 1) > 0.95
    wrong = clear[outside != ours[clear]].tolist()
    for vertex in unclear:
        face, turn = np.nonzero(faces == vertex)
        e, f = (vertices[faces[face, (turn + k) % 3]] - vertices[vertex] for k in (1, 2))
        e, f = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (e, f))
        normal = 1e-3 * np.cross(e, f)
        near = [vertices[vertex] + step * (e + f + side * normal) for side in (1, -1)]
        outside, within = (np.rint(winding_number(mesh, points)) for points in near)
        if ours[vertex] not in outside or ours[vertex] + 1 not in within:
            wrong.append(int(vertex))
    return wrong


@pytest.mark.parametrize("frame", FRAMES)
def test_bodies_in_motion_capture(frame):
    """At every vertex of another class and around it, and at every thirtieth of the others."""
    mesh = posed_bodies([frame])[0], body_faces()
    found = w_out(mesh) != 0
    assert found.sum() > 50
    some = np.zeros(len(found), bool)
    some[mesh[1][found[mesh[1]].any(axis=1)]] = True
    some[::30] = True
    assert len(disagreeing(mesh, some=some)) <= 0.0005 * some.sum()


@functools.cache
def small_body():
    """The body with 400 vertices: its triangles are as long as a hand."""
    (vertices,) = posed_bodies(["roll/0053"])
    vertices, faces, *_ = igl.decimate(vertices, body_faces(), 796)
    return np.asarray(vertices), np.asarray(faces, np.int64)


def test_body_of_400_vertices():
    mesh = small_body()
    assert abs(len(mesh[0]) - 400) < 20
    assert len(disagreeing(mesh)) == 0
    assert np.count_nonzero(w_out(mesh)) > 10


def valence_30():
    """A star of 30 points, bent, below a tip and above a dent: both have 30 triangles."""
    angle = np.arange(30) * 2 * np.pi / 30
    radius = np.where(np.arange(30) % 2, 1.0, 0.3)
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.2 * np.cos(3 * angle)], -1)
    vertices = np.concatenate([rim, [[0, 0, 1], [0, 0, 0.5]]])  # the lower tip is a dent
    k, after = np.arange(30), np.roll(np.arange(30), -1)
    upper, lower = np.stack([k, after, 0 * k + 30], -1), np.stack([after, k, 0 * k + 31], -1)
    return vertices, np.concatenate([upper, lower])


def hulls(rng, count):
    """Convex polyhedra of random points, some inside out, all over one another."""
    parts = []
    for number in range(count):
        points = rng.normal(size=(20, 3))
        hull = ConvexHull(points)
        vertices, faces = points, hull.simplices.astype(np.int64)
        normal = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
        turned = np.einsum("fi,fi->f", normal, hull.equations[:, :3]) < 0
        faces[turned] = faces[turned][:, ::-1]
        used, faces = np.unique(faces, return_inverse=True)
        part = vertices[used] + rng.normal(size=3) * 0.5, faces.reshape(-1, 3)
        parts.append(inverted(part) if number % 3 == 2 else part)
    return join(*parts)


def test_valence_30_and_triple_overlaps(rng):
    star = valence_30()
    assert np.bincount(star[1].ravel()).max() == 30
    for mesh in (
        star,
        inverted(star),
        join(star, moved(star, random_rotation(rng), (0.2, 0.1, 0.3))),
        join(star, sphere(0.6, (0.3, 0.2, 0.1), 2), box((1, 1, 1), (0.4, 0.1, 0.3))),
    ):
        assert disagreeing(mesh) == []


@pytest.mark.parametrize("seed", range(6))
def test_random_solids_at_any_depth(seed):
    rng = np.random.default_rng(seed)
    mesh = hulls(rng, 6)
    assert disagreeing(mesh) == []
    found = w_out(mesh)
    assert found.min() < 0 and found.max() > 1
    for _ in range(10):  # every direction has its own silhouettes and outermost vertices
        np.testing.assert_array_equal(w_out(moved(mesh, random_rotation(rng))), found)


def test_nested_shells_of_both_senses():
    shells = [sphere(r, subdivisions=1) for r in (1.0, 0.8, 0.6, 0.4)]
    count = len(shells[0][0])
    np.testing.assert_array_equal(w_out(join(*shells)), np.repeat([0, 1, 2, 3], count))
    inside_out = join(*map(inverted, shells))
    np.testing.assert_array_equal(w_out(inside_out), np.repeat([-1, -2, -3, -4], count))
    cavity = join(shells[0], inverted(shells[1]), shells[2])
    np.testing.assert_array_equal(w_out(cavity), 0)


# Boxes on a lattice: (extents, centers), and the boxes that have vertices inside others.
LATTICE = {
    "face to face": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (1, 0, 0)], {}),
    "a small one on a wall": ([(1, 1, 1), (0.5,) * 3], [(0, 0, 0), (0, 0.75, 0)], {}),
    "shifted on a wall": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (1, 0.5, 0.25)], {}),
    "edge to edge": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (1, 1, 0)], {}),
    "corner to corner": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (1, 1, 1)], {}),
    "twice the same": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (0, 0, 0)], {}),
    "walls in one plane": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (0.5, 0, 0)], {}),
    "on a wall from within": ([(1, 1, 1), (0.5,) * 3], [(0, 0, 0), (0.25, 0, 0)], {8: 4}),
    "wholly within": ([(1, 1, 1), (0.5,) * 3], [(0, 0, 0), (0, 0, 0)], {8: 8}),
    "corner within": ([(1, 1, 1), (1, 1, 1)], [(0, 0, 0), (0.5,) * 3], {0: 1, 8: 1}),
    "a bar through": ([(1, 1, 1), (3, 0.5, 0.5)], [(0, 0, 0), (0, 0, 0)], {}),
}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", LATTICE)
def test_boxes_on_a_lattice(name, turned, rng):
    """Contact is no overlap, with and without the rounding of a rotation and of float32."""
    extents, centers, expected = LATTICE[name]
    mesh = join(*(box(e, c) for e, c in zip(extents, centers, strict=True)))
    if turned:
        mesh = moved(mesh, random_rotation(rng), (0.3, -0.7, 0.4))
    for dtype in (np.float32, np.float64):
        found = w_out((mesh[0].astype(dtype), mesh[1]))
        inner = {
            first: count for first in (0, 8) if (count := (found[first : first + 8] == 1).sum())
        }
        assert inner == expected and found.min() == 0 and found.max() <= 1


def test_towers_of_cubes_are_clear():
    cells = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    np.testing.assert_array_equal(w_out(join(*(box(center=c) for c in cells))), 0)


def test_laws(rng):
    """Rigid motion, scale, the order of faces, of their corners and of vertices, other parts."""
    mesh = hulls(rng, 4)
    vertices, faces = mesh
    found = w_out(mesh)
    np.testing.assert_array_equal(w_out(moved(mesh, random_rotation(rng), (5, -3, 9), 0.01)), found)
    np.testing.assert_array_equal(w_out((vertices, np.roll(rng.permutation(faces), 1, 1))), found)
    order = rng.permutation(len(vertices))
    renamed = vertices[order], np.argsort(order)[faces]
    np.testing.assert_array_equal(w_out(renamed), found[order])
    both = join(mesh, moved(sphere(subdivisions=1), translation=(20, 0, 0)))
    np.testing.assert_array_equal(w_out(both)[: len(found)], found)
    np.testing.assert_array_equal(w_out(inverted(mesh)), -1 - found)


def test_holes_are_closed():
    """A box without its lid around a smaller one, and without all but one of its sides."""
    walls = box((2, 2, 2))
    top = np.flatnonzero((walls[0][walls[1]][:, :, 2] == 1).all(axis=1))
    mesh = join((walls[0], np.delete(walls[1], top, axis=0)), box((0.5,) * 3, (0, 0, -0.7)))
    np.testing.assert_array_equal(w_out(mesh), [0] * 8 + [1] * 8)
    sheet = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    np.testing.assert_array_equal(w_out(sheet), 0)


def test_unused_vertices_and_nothing_at_all():
    nested = join(box(), box((0.5,) * 3))
    unused = np.concatenate([nested[0], [[0.0, 0, 0], [0.1, 0, 0]]]), nested[1]
    np.testing.assert_array_equal(w_out(unused), [0] * 8 + [1] * 8 + [0] * 2)
    assert w_out((np.zeros((0, 3)), np.zeros((0, 3), np.int64))).shape == (0,)
    np.testing.assert_array_equal(w_out((np.zeros((4, 3)), np.zeros((0, 3), np.int64))), 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e90, 1e-90])
def test_numbers_of_any_size_or_none(value):
    vertices, faces = join(box(), box((0.5,) * 3))
    with pytest.raises(Unmeasurable, match="finite") if not np.isfinite(value) else nullcontext():
        found = measure(vertices * value, faces, sampling(None)).labels("vertex")
        np.testing.assert_array_equal(found, [0] * 8 + [1] * 8)


def test_triangles_without_area_change_nothing(rng):
    vertices, faces = hulls(rng, 3)
    found = w_out((vertices, faces))
    a, b, _ = faces.T
    # Each edge opened into a triangle with no width, and triangles that are points.
    slits = np.concatenate([np.stack([a, b, a], 1), np.stack([b, b, b], 1)])
    np.testing.assert_array_equal(w_out((vertices, np.concatenate([faces, slits]))), found)


def test_a_few_triangles_around_all_vertices():
    mesh = join(box((3, 3, 3)), sphere(subdivisions=5), sphere(0.5, (0.9, 0, 0), 4))
    found = w_out(mesh)
    np.testing.assert_array_equal(np.unique(found), [0, 1, 2])
    radius = np.linalg.norm(mesh[0] - [0.9, 0, 0], axis=1)[8:10250]
    np.testing.assert_array_equal(found[8:10250][radius < 0.49], 2)
    np.testing.assert_array_equal(found[8:10250][radius > 0.5], 1)


def test_flat_walls_of_many_triangles_touch_nothing():
    """Their vertices lie in the planes of many other triangles, but not on them."""
    vertices, faces = box()
    for _ in range(4):
        middle = vertices[faces].mean(axis=1)
        new = len(vertices) + np.arange(len(faces))
        vertices = np.concatenate([vertices, middle])
        faces = np.concatenate(
            [np.stack([faces[:, k], faces[:, (k + 1) % 3], new], axis=1) for k in range(3)]
        )
    mesh = join((vertices, faces), moved((vertices, faces), translation=(0.31, 0.42, 0.53)))
    assert not len(ExactSurface(*mesh, 2e-16).contacts.vertex)
    assert np.count_nonzero(w_out(mesh)) > 50


def test_solids_that_share_a_corner_or_an_edge_hang_together_no_more_than_they_do():
    """One within the other: around what they share there are two winding numbers."""
    outer, inner = box((1, 1, 1), (0.5, 0.5, 0.5)), box((0.5,) * 3, (0.25, 0.25, 0.25))
    vertices, faces = join(outer, inner)
    apart = w_out((vertices, faces))
    first = np.flatnonzero((vertices == 0).all(axis=1))
    shared = np.where(faces == first[1], first[0], faces)
    np.testing.assert_array_equal(
        np.delete(w_out((vertices, shared)), first), np.delete(apart, first)
    )
    sides = join(box(), box(center=(1, 0, 0)))  # and two that share a whole side
    places, number = np.unique(sides[0], axis=0, return_inverse=True)
    assert len(places) == 12
    np.testing.assert_array_equal(w_out((places, number[sides[1]])), 0)


def test_parts_of_every_number_and_sense(rng):
    star = valence_30()
    for mesh in (join(star, moved(star, random_rotation(rng), (0.2, 0.1, 0.3))), hulls(rng, 3)):
        many = [moved(mesh, translation=(20.0 * k, 0, 0)) for k in range(20)]
        np.testing.assert_array_equal(w_out(join(*many)), np.tile(w_out(mesh), 20))


@pytest.mark.parametrize("ranks", [False, True])
def test_columns_of_rays_miss_no_triangle(rng, ranks):
    points = rng.integers(0, 12, (3, 300)) if ranks else rng.random((3, 300))
    faces, rays = rng.integers(0, 300, (200, 3)), points[:, rng.integers(0, 300, 40)]

    def meeting(found):
        ray, face = found
        z = points[2][faces[face]]
        kept = (z.min(axis=1) <= rays[2, ray]) & (z.max(axis=1) >= rays[2, ray])
        return sorted(zip(ray[kept].tolist(), face[kept].tolist(), strict=True))

    assert meeting(part_roots._columns(rays, points, faces)) == meeting(
        part_roots._rows(rays, points, faces)
    )
