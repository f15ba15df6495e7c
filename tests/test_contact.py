"""Contact that is wanted: distances of patches, against formulas and ipctk."""

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, join, moved, random_rotation, sphere

from spt_jax import contact_penalty, self_intersection_penalty
from spt_jax.overlap.nearest import nearest_points


def slow_distance(vertices, faces, first, second):
    """By ipctk, of every corner to every triangle and of every edge to every edge."""
    found = np.inf
    for a in vertices[faces[first]]:
        for b in vertices[faces[second]]:
            for k in range(3):
                found = min(found, ipctk.point_triangle_distance(a[k], *b))
                found = min(found, ipctk.point_triangle_distance(b[k], *a))
                for j in range(3):
                    edges = a[k], a[k - 2], b[j], b[j - 2]
                    found = min(found, ipctk.edge_edge_distance(*edges))
    return np.sqrt(found)


def test_distances_are_those_of_every_pair_of_triangles(rng):
    for _ in range(6):
        shift = rng.standard_normal(3)
        shift *= 2.3 / np.linalg.norm(shift)
        vertices, faces = join(sphere(subdivisions=0), sphere(center=shift, subdivisions=0))
        vertices, _ = moved((vertices, faces), random_rotation(rng))
        first, second = np.arange(20), np.arange(20, 40)
        found = nearest_points(vertices, faces, first, second)
        expected = slow_distance(vertices, faces, first, second)
        np.testing.assert_allclose(found.distance, expected, rtol=1e-9)
        ends = np.einsum("pc,pci->pi", found.weights, vertices[faces[list(found.faces)]])
        np.testing.assert_allclose(np.linalg.norm(ends[1] - ends[0]), expected, rtol=1e-9)
        assert found.weights.min() >= 0


VERTICES, FACES = join(box(), box(center=(1.5, 0.2, 0.1)))
PAIRS = [(np.arange(12), np.arange(12, 24))]


def test_boxes_apart_touching_and_in_each_other(dtype):
    loss = jax.value_and_grad(lambda v: contact_penalty(v, FACES, PAIRS))
    vertices = jnp.asarray(VERTICES, dtype)
    value, gradient = loss(vertices)
    assert value.dtype == dtype and value == pytest.approx(0.25, rel=1e-5)
    np.testing.assert_allclose(gradient[8:].sum(axis=0), [1.0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(gradient[:8].sum(axis=0), [-1.0, 0, 0], atol=1e-5)
    for shift in (0.5, 0.8):
        value, gradient = loss(vertices.at[8:, 0].add(-shift))
        assert value < 1e-12 and np.abs(gradient).max() < 1e-6
    for margin, expected in ((0.1, 0.16), (0.5, 0.0), (0.7, 0.0)):
        found = contact_penalty(vertices, FACES, PAIRS, margin=margin)
        assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("gap", [-0.05, 0.05])
def test_margin_contact_and_volume_agree_about_the_surface(gap, x64):
    margin = 0.2
    vertices = jnp.asarray(VERTICES).at[8:, 0].add(-0.5 + margin + gap)
    volume = self_intersection_penalty(vertices, FACES, margin=margin)
    contact = contact_penalty(vertices, FACES, PAIRS, margin=margin)
    assert (volume > 0) == (gap < 0) and (contact > 0) == (gap > 0)


def test_derivatives_equal_differences(rng, x64):
    vertices, faces = join(
        sphere(subdivisions=1),
        sphere(center=(2.3, 0.3, 0.2), subdivisions=1),
        box(center=(0.1, 3, 0.25)),
    )
    # No two places are equally near, as they are between spheres that are made alike.
    vertices = vertices + 0.02 * rng.standard_normal(vertices.shape)
    vertices = jnp.asarray(vertices @ random_rotation(rng).T)
    pairs = [(np.arange(80), np.arange(80, 160)), (range(160, 172), [0, 1, 2, 3])]
    loss = jax.jit(lambda v: contact_penalty(v, faces, pairs, margin=0.01))
    move, h = jnp.asarray(rng.standard_normal(vertices.shape)), 1e-6
    expected = (loss(vertices + h * move) - loss(vertices - h * move)) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(jax.grad(loss)(vertices), move), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(loss, (vertices,), (move,))[1], expected, rtol=1e-7)


def test_batches_and_lanes():
    both = jnp.stack([jnp.asarray(VERTICES, jnp.float32), 2 * jnp.asarray(VERTICES, jnp.float32)])
    found = contact_penalty(both, FACES, PAIRS)
    np.testing.assert_allclose(found, [0.25, 1.0], rtol=1e-5)
    lanes = jax.vmap(lambda v: contact_penalty(v, FACES, PAIRS))(both)
    np.testing.assert_array_equal(lanes, found)
    assert np.isnan(contact_penalty(both.at[0, 0, 0].set(jnp.nan), FACES, PAIRS)).tolist() == [1, 0]
    assert contact_penalty(both[0], FACES, []) == 0


@pytest.mark.parametrize(
    ("pairs", "error", "match"),
    [
        ([([0], [])], ValueError, "at least one: got shape"),
        ([([0], [24])], ValueError, "got number 24 for 24 faces in pair 0"),
        ([([0], [0.5])], TypeError, "by whole numbers: got float64"),
        ([([0], [1], [2])], ValueError, "got 3 patches in pair 0"),
    ],
)
def test_patches_that_are_none(untyped, pairs, error, match):
    with pytest.raises(error, match=match):
        contact_penalty(jnp.asarray(VERTICES, jnp.float32), FACES, pairs)
