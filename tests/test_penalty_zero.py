"""Exactly zero where nothing overlaps: solids seen edge-on, bodies; and extreme sizes."""

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import (
    body_faces,
    box,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
)
from helpers_penalty import FACES, PAIR, as_jax, loss
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax import self_intersection_penalty
from spt_jax.bridge import callback
from spt_jax.overlap import host_functions
from spt_jax.overlap.measure import Measurement, measure


@pytest.mark.parametrize("value", ["volume", "ratio"])
@pytest.mark.parametrize("gradient", ["boundary", "vertex", "unit"])
@pytest.mark.parametrize("mesh", [sphere(), join(box(), box(center=(1.5, 0, 0)))])
def test_no_overlap_is_exactly_zero(dtype, mesh, gradient, value):
    options = {"value": value, "gradient": gradient, "rays": 100}
    found, slope = jax.value_and_grad(lambda v: self_intersection_penalty(v, mesh[1], **options))(
        as_jax(mesh, dtype)
    )
    assert found == 0.0
    np.testing.assert_array_equal(slope, 0.0)


def test_faces_seen_edge_on_make_no_overlap(dtype):
    """Solids with walls along the rays, where rounding decides which rays hit them."""
    cylinder = trimesh.creation.cylinder(0.5, 1.0)
    cone = trimesh.creation.cone(0.5, 1.0)
    for k in range(8):
        turn = trimesh.transformations.rotation_matrix(k * np.pi / 4, [1, k % 3, 0])[:3, :3]
        for solid in (cylinder, cone, trimesh.creation.box()):
            for shift in ((0, 0, 0), (0, 0, 0.5)):
                mesh = moved((np.array(solid.vertices), np.array(solid.faces)), turn, shift)
                for rays in (16, 100, (64, 64)):
                    value = self_intersection_penalty(as_jax(mesh, dtype), mesh[1], rays=rays)
                    assert value == 0.0


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([box(), sphere(subdivisions=2), box((1, 2, 0.5))]),
    st.sampled_from([(8, 8), (64, 64), (32, 64), 16, 64, 7]),
    st.sampled_from([0.0, 1e-16, 1e-15, 1e-13, 1e-11, 1e-8]),
    st.sampled_from([0.001, 0.5, 1.0, 10.0]),
    st.sampled_from([1, 3]),
    st.integers(0, 2**32 - 1),
)
def test_convex_solids_never_overlap(mesh, rays, noise, scale, directions, seed):
    rng = np.random.default_rng(seed)
    corner = rng.choice(mesh[0])
    vertices = (mesh[0] - corner * rng.integers(0, 2)) * scale
    vertices = vertices + noise * rng.normal(size=vertices.shape)
    found = measure(vertices, mesh[1], sampling(rays, directions))
    assert found.volume == 0
    assert not found.labels("triangle").any()


def test_bodies_that_ipctk_calls_free_are_exactly_free():
    """No self-intersection of the mesh by ipctk, an exact test: value and gradient are zero."""
    faces = body_faces().astype(np.int32)
    edges = ipctk.edges(faces)
    for vertices in posed_bodies(
        ["cartwheel/0034", "dance_a/0017", "dance_a/0035", "dance_a/0044"]
    ):
        mesh = ipctk.CollisionMesh(vertices, edges, faces)
        assert not ipctk.has_intersections(mesh, vertices)
        for rays in (512, (300, 300)):
            value, gradient = jax.value_and_grad(
                lambda v: self_intersection_penalty(v, faces, rays=rays)  # noqa: B023
            )(jnp.asarray(vertices, "float32"))
            assert value == 0.0 and np.abs(gradient).max() == 0.0


def test_extreme_scales(x64):
    vertices = jnp.asarray(moved(PAIR, random_rotation(np.random.default_rng(2)))[0])
    value, gradient = jax.value_and_grad(loss)(vertices)
    for exponent in (-300, -200, 200, 300):  # powers of two keep the lattice's pixels
        scale = 2.0**exponent
        scaled_value, scaled_gradient = jax.value_and_grad(loss)(vertices * scale)
        assert float(scaled_value / scale / scale / scale) == pytest.approx(float(value))
        np.testing.assert_allclose(scaled_gradient / scale / scale, gradient, atol=1e-12)


@pytest.mark.parametrize("rays", [None, 32])
def test_what_the_dtype_cannot_hold_is_nan_or_zero_with_no_gradient(dtype, rays):
    """Overflow is NaN; an underflowing value has no gradient, though that would not underflow."""
    limits = np.finfo(dtype)
    largest, least = float(limits.max) ** 0.34, float(limits.tiny) ** 0.34
    run = jax.value_and_grad(lambda v: self_intersection_penalty(v, FACES, rays=rays))
    for step in (run, jax.jit(run)):
        for scale in (largest, 10 * largest):
            value, gradient = step(as_jax(PAIR, dtype) * np.asarray(scale, dtype))
            assert np.isnan(value) and not np.abs(gradient).any()
        for scale in (0.5 * least, 1e-3 * least):
            value, gradient = step(as_jax(PAIR, dtype) * np.asarray(scale, dtype))
            assert (value > 0) == bool(np.abs(gradient).any())
        # In float64 the cubes are no numbers: what cannot be measured is NaN.
        assert value == 0 or (dtype == np.float64 and np.isnan(value))
        value, gradient = step(as_jax(PAIR, dtype) * np.asarray(min(0.05 * largest, 1e98), dtype))
        assert np.isfinite(value) and value > 0 and np.abs(gradient).any()


@pytest.mark.parametrize("volume_by_rounding", [-1.2e-18, -0.0, 1e-320])
def test_a_volume_below_rounding_is_zero_and_has_no_gradient(monkeypatch, volume_by_rounding):
    class Rounded(Measurement):
        volume = volume_by_rounding

        def gradient(self, *_):
            return np.ones(PAIR[0].shape)

    monkeypatch.setattr(host_functions, "measure", lambda *mesh: Rounded(*mesh))
    value, gradient = jax.value_and_grad(loss)(as_jax(PAIR, "float32") + 0.3)
    assert value == 0 and not np.signbit(value) and not np.abs(gradient).any()
    callback.clear_results()


@pytest.mark.parametrize("rays", [None, (64, 64)])
def test_faces_listed_twice_count_by_their_winding_number(dtype, rays):
    """w is 2 inside, so w (w - 1) / 2 is 1: the solid, and its derivative, once."""
    vertices, faces = moved(box((1.0, 2.0, 0.5)), random_rotation(np.random.default_rng(1)))
    twice = np.concatenate([faces, faces])
    run = jax.value_and_grad(lambda v: self_intersection_penalty(v, twice, rays=rays))
    value, gradient = run(jnp.asarray(vertices, dtype))
    assert float(value) == pytest.approx(1.0, rel=1e-5 if rays is None else 0.05)
    # Of a volume V: stretched by s about the center it grows with 3 V.
    stretched = float((gradient * vertices.astype(dtype)).sum())
    assert stretched == pytest.approx(3.0, rel=1e-5 if rays is None else 0.05)


def test_meshes_without_triangles_or_extent_are_free():
    none = np.zeros((0, 3), np.int32)
    assert loss(jnp.zeros((0, 3)), none) == 0
    assert jax.vmap(lambda v: loss(v, none))(jnp.zeros((2, 0, 3))).shape == (2,)
    empty = np.zeros((0, 3), np.int32)
    assert loss(jnp.zeros((4, 3)), empty) == 0
    value, gradient = jax.value_and_grad(loss)(jnp.full((4, 3), 0.7), np.array([[0, 1, 2]]))
    assert value == 0 and np.abs(gradient).max() == 0
