"""Small convex solids are told at once, and are what the search says of them: no overlap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import trimesh
from helpers import box, join, random_rotation, sphere

from spt_jax import self_intersection_penalty
from spt_jax.overlap.convex import is_small_convex_solid
from spt_jax.overlap.measure import Sampling, measure

EPS = float(np.finfo(np.float64).eps)
AUTO = Sampling(None, ((1.0, 0.0, 0.0),))


def hull(seed, count=20):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    mesh = trimesh.convex.convex_hull(points)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def prism():
    mesh = trimesh.creation.cylinder(1.0, 2.0, sections=12)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


SOLIDS = {
    "box": box,
    "prism": prism,
    "sphere": lambda: sphere(subdivisions=1),
    **{f"hull {seed}": lambda seed=seed: hull(seed) for seed in range(4)},
}


@pytest.mark.parametrize("name", SOLIDS)
def test_a_convex_solid_is_told_however_it_is_turned(name):
    vertices, faces = SOLIDS[name]()
    faces = np.asarray(faces, np.int64)
    rng = np.random.default_rng(1)
    for k in range(20):
        turned = (vertices @ random_rotation(rng).T + rng.normal(size=3)) * 10.0 ** (k % 5 - 2)
        assert is_small_convex_solid(turned, faces, 8 * EPS)
        found = measure(turned, faces, AUTO)  # the search has the last word
        assert found.volume == 0 and found.intersecting_pairs == 0
        assert not found.gradient("boundary", "vertex").any()


def dented():
    vertices, faces = sphere(subdivisions=1)
    vertices = np.array(vertices)
    vertices[0] *= 0.5
    return vertices, faces


def open_box():
    vertices, faces = box()
    return vertices, faces[:-1]


def twice_around():
    """An octahedron wound twice about an axis: locally convex everywhere but at its tips."""
    angle = np.arange(8) * np.pi / 2
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    vertices = np.concatenate([ring, [[0, 0, 1.0], [0, 0, -1.0]]])
    k = np.arange(8)
    upper = np.stack([k, (k + 1) % 8, np.full(8, 8)], axis=1)
    lower = np.stack([(k + 1) % 8, k, np.full(8, 9)], axis=1)
    return vertices, np.concatenate([upper, lower])


OTHERS = {
    "inside out": lambda: (box()[0], box()[1][:, ::-1]),
    "dented": dented,
    "open": open_box,
    "twice around": twice_around,
    "two boxes": lambda: join(box(), box(center=(0.5, 0.5, 0.5))),
    "one box in another": lambda: join(box(), box((0.5, 0.5, 0.5))),
    "two in one place": lambda: join(box(), box()),
    "flat": lambda: (box()[0] * [1.0, 1.0, 0.0], box()[1]),
    "a point": lambda: (0 * box()[0], box()[1]),
    "large": lambda: sphere(subdivisions=3),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_small_convex_or_one_is_left_to_the_search(name):
    vertices, faces = OTHERS[name]()
    assert not is_small_convex_solid(np.array(vertices), np.asarray(faces, np.int64), EPS)


def test_twice_around_overlaps_itself():
    vertices, faces = twice_around()
    value = self_intersection_penalty(jnp.asarray(vertices, "float32"), faces)
    assert value == pytest.approx(scipy.spatial.ConvexHull(vertices).volume, rel=1e-5)


@pytest.mark.parametrize("options", [{}, {"value": "ratio"}, {"margin": 0.1}, {"rays": 16}])
def test_the_penalty_of_a_convex_solid_is_zero(options, dtype):
    vertices, faces = box()
    vertices = jnp.asarray(vertices @ random_rotation(np.random.default_rng(5)).T, dtype)
    value, gradient = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, **options))(
        vertices
    )
    assert value == 0
    np.testing.assert_array_equal(gradient, 0.0)
