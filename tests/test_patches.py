"""The winding number from patch to patch, against rays through every vertex."""

import numpy as np
import pytest
from helpers import body_faces, box, inverted, join, moved, posed_bodies, random_rotation, sphere
from test_vertex_winding import LATTICE, hulls, small_body, valence_30

from spt_jax.overlap.rays.beam import orthogonal_directions
from spt_jax.overlap.triangles import patches
from spt_jax.overlap.triangles.pair_layout import prepared
from spt_jax.overlap.triangles.pairs import edge_crossings
from spt_jax.overlap.triangles.patches import winding_by_patches
from spt_jax.overlap.triangles.vertex_winding import vertex_winding

DIRECTIONS = np.array(orthogonal_directions(3))


@pytest.fixture
def asked(monkeypatch):
    """How many vertices rays went through, for each time that any did."""
    numbers = []

    def counting(vertices, faces, directions, sample=None):
        numbers.append(len(vertices) if sample is None else len(sample))
        return vertex_winding(vertices, faces, directions, sample)

    monkeypatch.setattr(patches, "vertex_winding", counting)
    return numbers


def by_patches(mesh):
    return winding_by_patches(*mesh, DIRECTIONS, edge_crossings(*mesh))


def check(mesh):
    found = by_patches(mesh)
    np.testing.assert_array_equal(found, vertex_winding(*mesh, DIRECTIONS))
    return found


def test_bodies_in_motion_capture(asked):
    for vertices in posed_bodies(["roll/0053", "crawl/0092", "dance_a/0068", 0]):
        found = check((vertices, body_faces()))
        assert np.count_nonzero(found) < 1000
    assert max(asked) < 100
    check(small_body())


@pytest.mark.parametrize("seed", range(8))
def test_random_solids_at_any_depth(seed, asked):
    found = check(hulls(np.random.default_rng(seed), 6))
    assert found.min() < 0 and found.max() > 1
    assert len(asked) == 1  # what the edges say fits together


def test_stars_shells_cavities_and_parts_far_away(rng, asked):
    star = valence_30()
    shells = [sphere(r, subdivisions=1) for r in (1.0, 0.8, 0.6, 0.4)]
    for mesh in (
        star,
        inverted(star),
        join(star, moved(star, random_rotation(rng), (0.2, 0.1, 0.3))),
        join(*shells),
        join(*map(inverted, shells)),
        join(shells[0], inverted(shells[1]), shells[2]),
        join(*(box(center=(3.0 * k, 0, 0)) for k in range(200))),
    ):
        check(mesh)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", LATTICE)
def test_boxes_in_contact(name, turned, rng):
    """Vertices that touch another part are asked one by one: contact is no overlap."""
    extents, centers, _ = LATTICE[name]
    mesh = join(*(box(e, c) for e, c in zip(extents, centers, strict=True)))
    check(mesh)
    if turned:
        vertices, faces = moved(mesh, random_rotation(rng), (0.3, -0.7, 0.4))
        check((vertices, faces))
        check((vertices.astype(np.float32).astype(float), faces))


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
    other = moved((vertices, faces), translation=(0.31, 0.42, 0.53))
    mesh = join((vertices, faces), other)
    assert len(edge_crossings(*mesh).touching) == 0
    assert np.count_nonzero(check(mesh)) > 50


def test_solids_that_share_a_corner_hang_together_no_more_than_they_do(asked):
    """One within the other: around the corner that they share there are two winding numbers."""
    outer = box((1, 1, 1), (0.5, 0.5, 0.5))
    inner = box((0.5,) * 3, (0.25, 0.25, 0.25))
    vertices, faces = join(outer, inner)
    first = np.flatnonzero((vertices == 0).all(axis=1))
    assert len(first) == 2
    faces = np.where(faces == first[1], first[0], faces)
    topology = prepared(faces, len(vertices)).topology
    np.testing.assert_array_equal(np.flatnonzero(~topology.simple), first[:1])
    np.testing.assert_array_equal(np.flatnonzero(~topology.used), first[1:])
    check((vertices, faces))


def test_holes_go_to_rays_through_every_vertex(asked):
    vertices, faces = join(box((2, 2, 2)), box((0.5,) * 3))
    check((vertices, faces[1:]))
    assert asked == [16]


def test_what_does_not_fit_together_goes_to_rays_through_every_vertex(rng, asked):
    mesh = hulls(rng, 3)
    crossings = edge_crossings(*mesh)
    crossings.edge[:] = crossings.edge[rng.permutation(len(crossings.edge))]
    found = winding_by_patches(*mesh, DIRECTIONS, crossings)
    np.testing.assert_array_equal(found, vertex_winding(*mesh, DIRECTIONS))
    assert asked[-1] == len(mesh[0])


def test_the_few_say_what_all_say(rng):
    """A sample is measured from the triangles around it alone, to the same numbers."""
    mesh = join(hulls(rng, 4), sphere(subdivisions=4))
    found = vertex_winding(*mesh, DIRECTIONS)
    for count in (1, 5, 100, len(found)):
        sample = rng.choice(len(found), count, replace=False)
        some = vertex_winding(*mesh, DIRECTIONS, sample)
        np.testing.assert_array_equal(some[sample], found[sample])
        assert np.count_nonzero(np.delete(some, sample)) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
def test_no_number_raises(value):
    vertices, faces = join(box(), box((0.5,) * 3))
    assert by_patches((vertices * value, faces)).shape == (16,)
    assert by_patches((np.zeros((4, 3)), np.zeros((0, 3), np.int64))).shape == (4,)
