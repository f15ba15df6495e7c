"""Groups and folds of simple solids on the device."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import bent_tube, box, embedded_body, join, moved, random_rotation, sphere
from helpers_device import SOLIDS, padded
from helpers_penalty import compiled_names

from spt_jax import RestSurface, self_intersection_penalty
from spt_jax.overlap.triangles.contours import find_contours
from spt_jax.overlap.triangles.pair_layout import prepared
from spt_jax.overlap.triangles.pairs import edge_intersections, face_pairs
from spt_jax.xla.exclusions import _folds, _near_at_rest
from spt_jax.xla.pair_search import over_intersecting_pairs
from spt_jax.xla.patches import spread
from spt_jax.xla.tables import rest_table
from spt_jax.xla.triangle_pairs import triangles_intersect


@pytest.mark.slow
def test_groups_as_on_the_host():
    """What two of three boxes share does not count, nor does anything where they are only two.

    Groups, pairs of them and directions are operands: one program serves all.
    """
    faces = padded("three boxes", "float32")[1]

    def both(name, backend, names=(0, 1, 2), directions=3):
        groups = np.concatenate([np.repeat(names, 12), np.full(len(faces) - 36, names[2])])
        options = {"face_groups": groups, "ignore_groups": [names[:2]], "directions": directions}
        vertices, corners = padded(name, "float32")
        return jax.value_and_grad(
            lambda v: self_intersection_penalty(v, corners, rays=48, backend=backend, **options)
        )(jax.device_put(vertices))

    found, expected = (both("three boxes", backend) for backend in ("xla", "numpy"))
    assert float(found[0]) == pytest.approx(float(expected[0]), rel=1e-5) and found[0] > 0.1
    scale = np.abs(expected[1]).max()
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-5 * scale)
    with compiled_names() as compiled:
        value, gradient = both("two boxes", "xla")
        turned = np.eye(3) + 0.1 * np.arange(9).reshape(3, 3)
        other, _ = both("three boxes", "xla", (0, 7, 5), turned)
    assert compiled == []
    assert value == 0 and not np.asarray(gradient).any()
    assert float(other) == pytest.approx(float(found[0]), rel=0.1) and other != found[0]


def test_what_is_near_depends_on_where(rng):
    """By the smaller of two distances, or as parts that lie in each other at rest."""
    tube = bent_tube(0.5, 0.2, 0.1, sides=10, steps=30)
    inner = box((0.05, 0.05, 0.05), tube[0][10:20].mean(axis=0))
    mesh = join(tube, inner, moved(inner, translation=(5.0, 0.0, 0.0)))
    allowed = rng.choice([0.1, 0.4, 1.0], len(mesh[1]))
    rest = RestSurface(*mesh, allowed)
    assert len(rest.parts_at_rest[1]) == 1
    for folds in (rest, rest.copies(2), RestSurface(*tube, 0.4)):
        f, g = rng.integers(0, folds.num_faces, (2, 20000))
        expected = folds.near(f, g, exact=True)
        pair = jnp.asarray(f, "int32"), jnp.asarray(g, "int32")
        found = np.asarray(_near_at_rest(rest_table(folds), *pair))
        assert 0.01 < expected.mean() < 0.9 and np.mean(found != expected) < 0.005
        along = folds.between_faces(f, g)
        same = np.asarray(_folds(rest_table(folds).places, *pair, jnp.asarray(along, "float32")))
        np.testing.assert_array_equal(same, folds.near(f, g))


@pytest.mark.slow
def test_fingers_are_near_exactly(rng):
    """Where seeds are farther away than folds reach; between two bodies nothing is near."""
    body = embedded_body()
    fingers = np.flatnonzero(body.rest_surface.distances < 0.1)
    f, g = rng.choice(fingers, (2, 20000))
    f[::4] = rng.integers(0, len(body.faces), len(f[::4]))
    expected = body.rest_surface.near(f, g, exact=True)
    assert 0.02 < expected.mean() < 0.5
    for rest, shift in ((body.rest_surface, 0), (body.rest_surface.copies(2), len(body.faces))):
        pair = jnp.asarray(f + shift, "int32"), jnp.asarray(g + shift, "int32")
        np.testing.assert_array_equal(_near_at_rest(rest_table(rest), *pair), expected)
    apart = jnp.asarray(f, "int32"), jnp.asarray(g + len(body.faces), "int32")
    assert not _near_at_rest(rest_table(body.rest_surface.copies(2)), *apart).any()


@pytest.mark.slow
def test_what_is_enclosed_at_rest_does_not_count():
    """Neither by rays nor exactly; what two bodies share does."""
    eyed = join(box(), box((0.2, 0.2, 0.2), (0.05, 0.02, 0.01)))
    rest = RestSurface(*eyed, distance=10.0)
    scene = join(eyed, moved(eyed, translation=(0.7, 0.12, 0.08)))
    turned = moved(scene, random_rotation(np.random.default_rng(1)))

    def penalty(copies, backend, rays=64):
        vertices, faces = jnp.asarray(turned[0][: 16 * copies], "float32"), turned[1][: 24 * copies]
        return float(
            self_intersection_penalty(
                vertices, faces, rays=rays, rest_surface=rest.copies(copies), backend=backend
            )
        )

    exact = penalty(2, "numpy", None)
    assert exact == pytest.approx(0.3 * 0.88 * 0.92, rel=1e-6)
    assert penalty(1, "numpy", None) == 0
    for backend in ("numpy", "xla"):
        assert penalty(1, backend) == 0
        assert penalty(2, backend) == pytest.approx(exact, rel=5e-3)


def test_triangles_that_cross(rng):
    """The pairs that the host finds on its own, and no others of as many."""
    vertices, faces = moved(
        join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2)),
        random_rotation(rng),
    )
    half = len(faces) // 2
    first, second = np.divmod(np.arange(half * half), half)
    second += half
    found = triangles_intersect(
        *(
            jnp.asarray(x, x.dtype.name.replace("64", "32"))
            for x in (vertices, faces[first], faces[second])
        )
    )
    pairs = {(f, g) for f, g in zip(first[found], second[found], strict=True)}
    assert len(pairs) > 30
    expected = face_pairs(edge_intersections(vertices, faces))
    assert pairs == {tuple(sorted(pair)) for pair in expected.tolist()}


@pytest.mark.parametrize("name", SOLIDS)
def test_the_search_finds_every_pair(name, dtype):
    """All that intersect, pairs that share a vertex among them, and else only pairs that touch.

    Of the three boxes some edges meet exactly; there rounding on the device decides.
    """
    vertices, faces = padded(name, dtype)
    # Closer together, a cluster's own triangles cross as well.
    vertices[: len(vertices) // 3] += dtype.type(0.05)

    def add(found, first, second, intersects):
        return found.at[first, second].add(intersects.astype(jnp.int32))

    count = len(faces)
    search = jax.jit(
        lambda v: over_intersecting_pairs(
            v, jnp.asarray(faces), add, jnp.zeros((count, count), "int32")
        )
    )
    found = np.asarray(search(jnp.asarray(vertices)))
    assert found.max(initial=0) <= 1 and not (found & found.T).any()
    ours = set(map(tuple, np.sort(np.argwhere(found), axis=1).tolist()))
    points, corners = vertices.astype(np.float64), faces.astype(np.int64)
    crossings = edge_intersections(points, corners)
    contours = find_contours(points, prepared(corners, len(points)).topology, crossings)
    reach = 8 * float(np.finfo(dtype).eps)
    proper = set(map(tuple, contours.pair[contours.proper(points, corners, reach)].tolist()))
    assert proper <= ours
    for pair in ours - proper:
        apart = points[corners[list(pair)]]
        apart = apart + 1e-5 * (apart.mean(axis=1, keepdims=True) - apart)  # each a little smaller
        alone = edge_intersections(apart.reshape(-1, 3), np.arange(6).reshape(2, 3))
        assert not len(alone.face), pair


def test_spread_stays_within_a_patch():
    """From one vertex over its own box of the three, though not over all of it."""
    _, faces = SOLIDS["three boxes"]
    members = np.ones(24, bool)
    members[[8, 9]] = False
    seeds = np.zeros(24, bool)
    seeds[12] = True
    reached = np.flatnonzero(spread(*map(jnp.asarray, (seeds, members, faces.astype(np.int32)))))
    assert reached.tolist() == [10, 11, 12, 13, 14, 15]
