"""`second_order=True`: every mode of differentiation, with the curvature of the volume itself."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from helpers import box, join, sphere

from spt_jax import self_intersection_penalty

VERTICES, FACES = join(sphere(subdivisions=1), sphere(center=(1.2, 0.1, 0.05), subdivisions=1))
HALF = len(VERTICES) // 2


def loss(vertices, faces=FACES, **options):
    return self_intersection_penalty(vertices, faces, second_order=True, **options)


def times(vertices, velocity, faces=FACES, **options):
    return jax.jvp(jax.grad(lambda x: loss(x, faces, **options)), (vertices,), (velocity,))[1]


@pytest.fixture
def velocity(rng):
    return rng.standard_normal(VERTICES.shape)


def test_values_and_gradients_are_the_same(dtype):
    vertices = jnp.asarray(VERTICES, dtype)
    plain = jax.value_and_grad(lambda x: self_intersection_penalty(x, FACES))
    found = jax.value_and_grad(loss)(vertices)
    for ours, theirs in zip(found, plain(vertices), strict=True):
        assert ours.dtype == dtype
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("margin", [0.0, pytest.param(0.01, marks=pytest.mark.slow)])
def test_every_order_of_modes_equals_differences(margin, velocity, x64):
    def of(x):
        return loss(x, margin=margin) ** 2

    vertices, velocity, h = jnp.asarray(VERTICES), jnp.asarray(velocity), 1e-7
    gradient = jax.grad(of)
    reverse_only = self_intersection_penalty(vertices, FACES, margin=margin) ** 2
    np.testing.assert_allclose(of(vertices), reverse_only, rtol=1e-12)
    near, far = (
        gradient(vertices + s * velocity) - gradient(vertices - s * velocity) for s in (h, 2 * h)
    )
    expected = (8 * near - far) / (12 * h)
    found = {
        "forward over reverse": jax.jvp(gradient, (vertices,), (velocity,))[1],
        "compiled": jax.jit(lambda x, v: jax.jvp(gradient, (x,), (v,))[1])(vertices, velocity),
        "reverse over reverse": jax.vjp(gradient, vertices)[1](velocity)[0],
        "reverse over forward": jax.grad(lambda x: jax.jvp(of, (x,), (velocity,))[1])(vertices),
        "linearized": jax.linearize(gradient, vertices)[1](velocity),
    }
    for name, product in found.items():
        size = float(jnp.abs(expected).max())
        np.testing.assert_allclose(product, expected, atol=1e-6 * size, err_msg=name)
    change = jax.jvp(of, (vertices,), (velocity,))[1]
    np.testing.assert_allclose(change, jnp.vdot(gradient(vertices), velocity), rtol=1e-9)


def test_hessians(x64):
    vertices, faces = join(box(), box(center=(0.6, 0.3, 0.2)))
    turned = jax.random.orthogonal(jax.random.key(0), 3, dtype=jnp.float64)
    vertices = jnp.asarray(vertices) @ turned
    hessian = jax.hessian(loss)(vertices, faces).reshape(vertices.size, -1)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-13)
    assert jnp.abs(hessian).max() > 0.1
    # Scaling a mesh scales its volume's gradient by the square.
    grown = hessian @ vertices.ravel()
    np.testing.assert_allclose(grown, 2 * jax.grad(loss)(vertices, faces).ravel(), atol=1e-12)


def test_batches_lanes_and_precisions(dtype, velocity):
    both = jnp.stack([jnp.asarray(VERTICES, dtype), jnp.asarray(1.1 * VERTICES, dtype)])
    moves = jnp.asarray(np.stack([velocity, -velocity]), dtype)
    each = jnp.stack([times(x, v) for x, v in zip(both, moves, strict=True)])
    assert each.dtype == dtype
    np.testing.assert_array_equal(jax.vmap(times)(both, moves), each)
    np.testing.assert_array_equal(
        jax.jvp(jax.grad(lambda x: loss(x).sum()), (both,), (moves,))[1], each
    )
    faces = jnp.stack([jnp.asarray(FACES), jnp.asarray(FACES)[::-1]])
    lanes = jax.jit(jax.vmap(times))(both, moves, faces)
    np.testing.assert_allclose(lanes, each, atol=100 * np.finfo(dtype).eps)
    many = jax.vmap(times, (None, 0))(both[0], moves)
    np.testing.assert_allclose(many, jnp.stack([each[0], -each[0]]), atol=1e-6)


def test_where_there_is_nothing_to_derive(dtype):
    apart = jnp.asarray(join(box(), box(center=(3.0, 0.0, 0.0)))[0], dtype)
    faces = join(box(), box())[1]
    ones = jnp.ones_like(apart)
    assert not times(apart, ones, faces).any()
    assert not jax.grad(lambda x: jnp.sqrt(loss(x, faces)))(apart).any()
    assert not times(apart.at[0, 0].set(jnp.nan), ones, faces).any()
    assert not times(apart * 0, ones, faces).any()


def shifted(shift):
    return loss(jnp.asarray(VERTICES, shift.dtype).at[HALF:].add(shift))


def test_newton_finds_where_the_gradient_vanishes(x64):
    """A root of the gradient, by Newton's method with conjugate gradients, in few steps."""

    def slope(shift, weight):
        return jax.grad(lambda x: shifted(x) + weight * jnp.sum(x**2))(shift)

    solver = optx.Newton(1e-10, 1e-10, linear_solver=lx.GMRES(1e-10, 1e-10))
    weight, start = jnp.array(0.5), jnp.zeros(3)
    found = optx.root_find(slope, solver, start, weight, max_steps=20)
    assert found.stats["num_steps"] <= 8
    np.testing.assert_allclose(slope(found.value, weight), 0, atol=1e-9)


@pytest.mark.slow
def test_solutions_are_derived_with_the_true_curvature(x64):
    def solution(weight):
        def objective(shift, weight):
            return shifted(shift) + weight * jnp.sum(shift**2)

        solver = optx.BFGS(1e-12, 1e-12)
        return optx.minimise(objective, solver, jnp.zeros(3), weight, max_steps=100).value

    weight, h = jnp.array(0.5), 1e-4
    found = jax.jacrev(solution)(weight)
    expected = (solution(weight + h) - solution(weight - h)) / (2 * h)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_least_squares_need_no_backward_jacobian():
    def residuals(shift, _):
        return jnp.concatenate([jnp.sqrt(shifted(shift) + 1e-8)[None], 0.1 * shift])

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    found = optx.least_squares(residuals, solver, jnp.zeros(3), max_steps=60, throw=False)
    assert shifted(found.value) < 0.1 * shifted(jnp.zeros(3))


@pytest.mark.parametrize(
    "options",
    [
        {"value": "ratio"},
        {"gradient": "vertex"},
        {"rays": 32},
        {"backend": "xla"},
    ],
)
def test_only_the_exact_volume_has_second_derivatives(options):
    with pytest.raises(ValueError, match="second_order must come with the exact volume"):
        loss(jnp.asarray(VERTICES, jnp.float32), **options)


def test_without_it_forward_mode_says_what_to_do():
    x = jnp.asarray(VERTICES, jnp.float32)
    with pytest.raises(TypeError, match=r'jac="bwd".*second_order=True'):
        jax.jvp(lambda v: self_intersection_penalty(v, FACES), (x,), (x,))
