"""Laws of spt_jax.body.rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import slow_rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle

_vectors = st.tuples(*[st.floats(-3, 3, width=32)] * 3)
_to_matrix = jax.jit(matrix_from_axis_angle)
_to_axis_angle = jax.jit(axis_angle_from_matrix)
_matrix_slope = jax.jit(jax.jacfwd(matrix_from_axis_angle))
_matrix_curvature = jax.jit(jax.jacfwd(jax.jacrev(matrix_from_axis_angle)))
_axis_angle_slope = jax.jit(jax.jacrev(axis_angle_from_matrix))
_axis_angle_curvature = jax.jit(jax.jacfwd(jax.jacrev(axis_angle_from_matrix)))


def _special_vectors():
    """Zero, tiny, both sides of each branch, and up to a full turn, along several axes."""
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, 0, 0.8], [2 / 3, -2 / 3, 1 / 3]])
    angles = [0, 1e-30, 1e-8, 1e-4, 0.4999, 0.5, 0.5001, 0.5053, 0.5055, 1, 3, np.pi - 1e-7, np.pi]
    return (np.array(angles)[:, None, None] * axes).reshape(-1, 3)


def test_matrix_equals_slow_rodrigues(dtype):
    vectors = np.concatenate([_special_vectors(), 2 * _special_vectors()])
    got = np.asarray(_to_matrix(jnp.asarray(vectors, dtype)))
    assert got.dtype == dtype
    expected = np.stack([slow_rotation(v) for v in vectors])
    np.testing.assert_allclose(got, expected, atol=4 * np.finfo(dtype).eps * 7)


def test_round_trip_up_to_pi(dtype):
    vectors = _special_vectors()
    back = np.asarray(_to_axis_angle(_to_matrix(jnp.asarray(vectors, dtype))))
    # At pi both axes are right: compare up to sign there.
    angle = np.linalg.norm(vectors, axis=-1)
    flip = (angle > np.pi - 1e-6) & (np.sum(back * vectors, axis=-1) < 0)
    back = np.where(flip[:, None], -back, back)
    np.testing.assert_allclose(back, vectors, atol=30 * np.finfo(dtype).eps)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(_vectors)
def test_rotations_are_orthogonal_and_inverted_by_the_sign(vector):
    v = jnp.asarray(vector, jnp.float32)
    matrix = _to_matrix(v)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=2e-6)
    np.testing.assert_allclose(_to_matrix(-v), matrix.T, atol=1e-6)
    again = _to_matrix(_to_axis_angle(matrix))
    np.testing.assert_allclose(again, matrix, atol=3e-6)
    assert np.linalg.norm(_to_axis_angle(matrix)) < np.pi + 1e-5


@settings(max_examples=40, deadline=None, derandomize=True)
@given(_vectors, st.floats(-1, 1, width=32))
def test_turns_about_one_axis_add(vector, share):
    v = jnp.asarray(vector, jnp.float32)
    part = jnp.float32(share)
    product = _to_matrix(part * v) @ _to_matrix((1 - part) * v)
    np.testing.assert_allclose(product, _to_matrix(v), atol=2e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-20, 0.499, 0.501, np.pi])
def test_derivatives_of_the_matrix_are_finite_and_right(dtype, angle):
    vector = jnp.asarray(angle * np.array([0.6, 0.0, 0.8]), dtype)
    first = np.asarray(_matrix_slope(vector))
    second = np.asarray(_matrix_curvature(vector))
    assert np.isfinite(first).all() and np.isfinite(second).all()
    # The slow formula, differenced in float64.
    h = 1e-4
    v, steps = np.asarray(vector, np.float64), h * np.eye(3)
    expected = np.stack(
        [(slow_rotation(v + d) - slow_rotation(v - d)) / (2 * h) for d in steps], axis=-1
    )
    np.testing.assert_allclose(first, expected, atol=1e-6)
    mixed = [
        [
            slow_rotation(v + a + b)
            - slow_rotation(v + a - b)
            - slow_rotation(v - a + b)
            + slow_rotation(v - a - b)
            for b in steps
        ]
        for a in steps
    ]
    expected = np.moveaxis(np.array(mixed) / (4 * h * h), (0, 1), (-2, -1))
    np.testing.assert_allclose(second, expected, atol=3e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.3, 0.51, 3.0, np.pi])
def test_derivative_of_the_axis_angle_is_finite_and_inverts_the_matrix(x64, angle):
    vector = jnp.asarray(angle * np.array([0.0, 0.6, 0.8]))
    there = _matrix_slope(vector)
    back = _axis_angle_slope(_to_matrix(vector))
    assert np.isfinite(back).all()
    np.testing.assert_allclose(jnp.einsum("iab,abj->ij", back, there), np.eye(3), atol=1e-7)
    curvature = _axis_angle_curvature(_to_matrix(vector))
    assert np.isfinite(curvature).all()


def test_any_batch_axes(rng):
    vectors = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    matrices = _to_matrix(vectors)
    assert matrices.shape == (2, 3, 3, 3)
    assert _to_axis_angle(matrices).shape == (2, 3, 3)
    np.testing.assert_allclose(matrices[1, 2], _to_matrix(vectors[1, 2]), atol=1e-6)
