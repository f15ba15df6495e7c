"""The margin: sheets end up that far apart, by libigl's distances, and then nothing pushes."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import box, join, moved, random_rotation, sphere

from spt_jax import paper_penalty, self_intersection_penalty

MARGIN = 0.05


def capsule():
    mesh = trimesh.creation.capsule(height=1.0, radius=0.3, count=(16, 16))
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def turned(mesh, seed, shift):
    return moved(mesh, random_rotation(np.random.default_rng(seed)), shift)


# Some overlap, some are only nearer than the margin.
PAIRS = {
    "spheres that overlap": (
        sphere(0.5, subdivisions=3), sphere(0.5, (0.83, 0.2, 0.1), subdivisions=3)
    ),
    "spheres that are near": (
        sphere(0.5, subdivisions=3), turned(sphere(0.5, subdivisions=3), 4, (0.85, 0.52, 0.2))
    ),
    "boxes, corner into side": (box(), turned(box(), 2, (1.1, 0.1, 0.2))),
    "capsules that cross": (capsule(), turned(capsule(), 6, (0.57, 0.15, 0.1))),
}  # fmt: skip


def samples(mesh):
    """Corners, midpoints of edges and points inside of all triangles."""
    vertices, faces = mesh
    corners, edges, inside = np.eye(3), 1 - np.eye(3), 1 + 3 * np.eye(3)
    weights = np.concatenate([corners, edges, inside, np.ones((1, 3))])
    weights = weights / weights.sum(axis=1, keepdims=True)
    return np.einsum("kc,fcx->fkx", weights, vertices[faces]).reshape(-1, 3)


def gap(first, second):
    """The least distance between two surfaces, from the points of each to the other's triangles."""
    ways = ((first, second), (second, first))
    squares = [np.min(igl.point_mesh_squared_distance(samples(a), *b)[0]) for a, b in ways]
    return np.sqrt(min(squares))


def crossing(first, second):
    return np.abs(igl.winding_number(*second, first[0])).max() > 0.5


@pytest.mark.parametrize(
    ("name", "free"),
    [(name, False) for name in PAIRS]
    + [("boxes, corner into side", True), ("capsules that cross", True)],
)
def test_descent_ends_the_margin_apart(name, free, x64):
    first, second = PAIRS[name]
    vertices, faces = join(first, second)
    split, vertices = len(first[0]), jnp.asarray(vertices)

    def place(unknown):
        return unknown if free else vertices.at[split:].add(unknown)

    @jax.jit
    @jax.value_and_grad
    def loss(unknown):
        return self_intersection_penalty(place(unknown), faces, margin=MARGIN)

    unknown = vertices if free else jnp.zeros(3)
    start, gradient = loss(unknown)
    assert start > 0
    for _ in range(400):
        value, gradient = loss(unknown)
        if value == 0:
            break
        longest = np.linalg.norm(gradient, axis=-1).max()
        assert longest > 0  # it never gets stuck with the sheets too near
        unknown = unknown - 0.1 * MARGIN / longest * gradient
    assert value == 0
    np.testing.assert_array_equal(gradient, 0.0)
    after = np.asarray(place(unknown))
    parts = (after[:split], first[1]), (after[split:], second[1])
    assert gap(*parts) >= 0.99 * MARGIN
    assert not crossing(*parts) and not crossing(*parts[::-1])
    assert gap(*parts) <= 1.6 * MARGIN  # corners and steps take some more, not much


@pytest.mark.parametrize("distance", [-0.02, 0.0, 0.02, 0.0499, 0.0501, 1.0])
def test_parallel_sides_count_as_far_as_they_are_too_near(distance, dtype):
    pair = join(box(), box((1.0, 2.0, 2.0), center=(1.0 + distance, 0.0, 0.0)))
    vertices, faces = jnp.asarray(pair[0], dtype), pair[1]

    def loss(v):
        return self_intersection_penalty(v, faces, rays=400, margin=MARGIN)

    value, gradient = jax.value_and_grad(loss)(vertices)
    near = max(MARGIN - distance, 0.0)
    # Both boxes are larger by half the margin on every side.
    assert value == pytest.approx(near * (1 + MARGIN) ** 2, rel=0.02)
    if distance > MARGIN:
        assert value == 0
        np.testing.assert_array_equal(gradient, 0.0)
    else:
        push = np.asarray(gradient)[8:].sum(axis=0)
        np.testing.assert_allclose(push, [-((1 + MARGIN) ** 2), 0, 0], atol=0.03)


@pytest.mark.parametrize("gradient", ["boundary", "unit"])
def test_a_body_far_from_itself_is_free(gradient):
    vertices, faces = sphere(subdivisions=3)
    value, slope = jax.value_and_grad(
        lambda v: self_intersection_penalty(v, faces, rays=64, margin=0.3, gradient=gradient)
    )(jnp.asarray(vertices, "float32"))
    assert value == 0
    np.testing.assert_array_equal(slope, 0.0)


def test_gradient_equals_finite_differences(x64, rng):
    ball = sphere(0.5, subdivisions=2)
    pair = join(ball, turned(ball, 5, (0.95, 0.35, 0.25)))
    vertices = jnp.asarray(pair[0] + rng.normal(scale=0.005, size=pair[0].shape))

    @jax.jit
    def loss(v):
        return self_intersection_penalty(v, pair[1], margin=0.2)

    value, gradient = jax.value_and_grad(loss)(vertices)
    assert value > 0 and self_intersection_penalty(vertices, pair[1]) == 0
    for _ in range(4):
        direction = rng.normal(size=vertices.shape)
        step = 1e-6
        difference = loss(vertices + step * direction) - loss(vertices - step * direction)
        expected = np.sum(gradient * direction)
        limit = 1e-6 * np.linalg.norm(gradient)
        np.testing.assert_allclose(difference / (2 * step), expected, atol=limit)


FLAT_SIDED = {
    "box": trimesh.creation.box(),
    "box in small triangles": trimesh.creation.box().subdivide().subdivide(),
    "can": trimesh.creation.cylinder(0.5, 1.0, sections=12),
}


@pytest.mark.parametrize("name", FLAT_SIDED)
def test_gradient_equals_finite_differences_on_flat_sides(name, x64, rng):
    """All triangles around a vertex of a flat side ask for the same move."""
    solid = np.array(FLAT_SIDED[name].vertices), np.array(FLAT_SIDED[name].faces, np.int64)
    vertices, faces = join(solid, turned(solid, 5, (1.02, 0.35, 0.25)))

    @jax.jit
    def loss(v):
        return self_intersection_penalty(v, faces, margin=0.2)

    value, gradient = jax.value_and_grad(loss)(jnp.asarray(vertices))
    assert value > 0
    for _ in range(4):
        direction = rng.normal(size=vertices.shape)
        step = 1e-7
        difference = loss(vertices + step * direction) - loss(vertices - step * direction)
        limit = 1e-5 * np.linalg.norm(gradient)
        np.testing.assert_allclose(
            difference / (2 * step), np.sum(gradient * direction), atol=limit
        )


def test_no_margin_changes_nothing():
    pair = join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2))
    vertices = jnp.asarray(pair[0], "float32")

    def run(**options):
        loss = jax.value_and_grad(lambda v: self_intersection_penalty(v, pair[1], **options))
        return loss(vertices)

    plain = run(rays=96)
    for margin in (0.0, np.float32(0), -0.0):
        for got, expected in zip(run(rays=96, margin=float(margin)), plain, strict=True):
            np.testing.assert_array_equal(got, expected)
    # And a tiny one next to nothing.
    for got, expected in zip(run(rays=96, margin=1e-7), plain, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-4)


def test_the_ratio_counts_vertices_that_are_too_near():
    pair = join(box(), box((1.0, 2.0, 2.0), center=(1.02, 0.0, 0.0)))
    vertices = jnp.asarray(pair[0], "float32")
    options = {"rays": 200, "value": "ratio", "gradient": "unit"}
    assert self_intersection_penalty(vertices, pair[1], **options) == 0
    assert paper_penalty(vertices, pair[1]) == 0
    assert self_intersection_penalty(vertices, pair[1], margin=0.05, **options) >= 0.25


def test_batches_jit_and_vmap_agree():
    gaps = (0.01, 0.03, 0.2)
    pairs = [join(box(), box((1.0, 2.0, 2.0), center=(1.0 + d, 0.0, 0.0))) for d in gaps]
    batch = jnp.asarray(np.stack([vertices for vertices, _ in pairs]), "float32")
    faces = jnp.asarray(pairs[0][1])

    def loss(v, f):
        return self_intersection_penalty(v, f, rays=64, margin=MARGIN)

    one_by_one = np.array([loss(v, faces) for v in batch])
    assert one_by_one[0] > one_by_one[1] > one_by_one[2] == 0
    np.testing.assert_array_equal(loss(batch, faces), one_by_one)
    np.testing.assert_array_equal(jax.vmap(loss, (0, None))(batch, faces), one_by_one)
    np.testing.assert_array_equal(jax.jit(loss)(batch, faces), one_by_one)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_vertices_that_are_not_finite_give_nan_and_no_gradient(dtype, bad):
    pair = join(box(), box(center=(0.9, 0.0, 0.0)))
    vertices = jnp.asarray(pair[0], dtype).at[3, 0].set(bad)
    value, gradient = jax.value_and_grad(
        lambda v: self_intersection_penalty(v, pair[1], rays=32, margin=MARGIN)
    )(vertices)
    assert np.isnan(value)
    np.testing.assert_array_equal(gradient, 0.0)
