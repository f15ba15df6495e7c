"""The penalty inside optimistix: every solver the documentation names, and implicit derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from helpers import join, sphere

from spt_jax import self_intersection_penalty

VERTICES, FACES = join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2))
HALF = len(VERTICES) // 2


def overlap(shift):
    vertices = jnp.asarray(VERTICES, shift.dtype).at[HALF:].add(shift)
    return self_intersection_penalty(vertices, FACES, rays=48)


def objective(shift, weight):
    return overlap(shift) + weight * jnp.sum(shift**2)


def residuals(shift, weight):
    # Squares of these are the objective's terms; the root is smooth where the overlap is gone.
    root = jnp.sqrt(overlap(shift) + 1e-8)
    return jnp.concatenate([root[None], jnp.sqrt(weight) * shift])


MINIMISERS = {
    "BFGS": optx.BFGS(rtol=1e-4, atol=1e-4),
    "LBFGS": optx.LBFGS(rtol=1e-4, atol=1e-4),
    "NonlinearCG": optx.NonlinearCG(rtol=1e-4, atol=1e-4),
    "GradientDescent": optx.GradientDescent(0.05, rtol=1e-4, atol=1e-4),
    "OptaxMinimiser": optx.OptaxMinimiser(optax.adam(2e-2), rtol=1e-5, atol=1e-5),
}
LEAST_SQUARES = {
    "LevenbergMarquardt": optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4),
    "GaussNewton": optx.GaussNewton(rtol=1e-4, atol=1e-4),
    "Dogleg": optx.Dogleg(rtol=1e-4, atol=1e-4),
}


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, {}) for name in MINIMISERS), ("BFGS", {"jac": "bwd"})],
    ids=[*MINIMISERS, "BFGS with jac=bwd"],
)
def test_minimisers(name, options, dtype):
    start, weight = jnp.zeros(3, dtype), jnp.asarray(0.01, dtype)
    with jax.numpy_dtype_promotion("standard"):  # optax relies on it
        solution = optx.minimise(
            objective, MINIMISERS[name], start, weight, options=options, max_steps=60, throw=False
        )
    assert np.isfinite(solution.value).all()
    before, after = overlap(start), overlap(solution.value)
    assert before > 0.5 and after < 0.05 * before
    assert objective(solution.value, weight) < 0.1 * before


@pytest.mark.parametrize("name", LEAST_SQUARES)
def test_least_squares_with_backward_jacobians(name, dtype):
    start, weight = jnp.zeros(3, dtype), jnp.asarray(0.01, dtype)
    solution = optx.least_squares(
        residuals,
        LEAST_SQUARES[name],
        start,
        weight,
        options={"jac": "bwd"},
        max_steps=40,
        throw=False,
    )
    assert np.isfinite(solution.value).all()
    assert overlap(solution.value) < 0.05 * overlap(start)


@pytest.mark.parametrize("name", LEAST_SQUARES)
def test_least_squares_without_them_say_why(name):
    with pytest.raises(TypeError, match="custom_vjp"):
        optx.least_squares(residuals, LEAST_SQUARES[name], jnp.zeros(3), jnp.asarray(0.01))


def test_implicit_differentiation(x64):
    """The equilibrium of a spring and a constant push moves as the spring's constant says."""

    def equilibrium(target):
        def energy(shift, target):
            return 0.05 * overlap(shift) + jnp.sum((shift - target) ** 2)

        solver = optx.BFGS(rtol=1e-8, atol=1e-8)
        return optx.minimise(energy, solver, target, target, max_steps=50, throw=False).value

    target = jnp.array([0.02, 0.0, 0.0])
    jacobian = jax.jacrev(equilibrium)(target)
    # The penalty counts as linear in second derivatives: only the spring is left.
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-6)
    assert equilibrium(target)[0] > target[0] + 0.03


def test_a_solve_can_be_jitted_and_batched(dtype):
    def solve(start):
        return optx.minimise(
            objective, MINIMISERS["BFGS"], start, jnp.asarray(0.01, dtype), max_steps=20,
            throw=False,
        ).value  # fmt: skip

    starts = jnp.asarray([[0.0, 0, 0], [0.3, 0, 0], [0.1, 0.2, 0]], dtype)
    together = jax.jit(jax.vmap(solve))(starts)
    for start, end in zip(starts, together, strict=True):
        assert overlap(end) < 0.1 * overlap(start)
        np.testing.assert_allclose(end, jax.jit(solve)(start), atol=2e-2)


def test_bfgs_ends_at_a_minimum_where_the_loss_is_not_small():
    """BFGS drops what a step tells where step times change of gradient is below epsilon.

    That is an absolute bound (optimistix, `_solver/quasi_newton.py`), so where it bites depends on
    the loss's unit alone: the same loss in thousandths goes on as plain gradient descent, in units
    it ends where starting again reaches no lower.
    """
    stretch = jnp.array([1.0, 0.1, 3.0], jnp.float32)  # as joints differ in what they move

    def loss(x, factor):
        vertices = jnp.asarray(VERTICES, x.dtype).at[HALF:].add(stretch * x)
        value = self_intersection_penalty(vertices, FACES) + 0.01 * jnp.sum(x**2)
        return factor * value

    solver = optx.BFGS(rtol=1e-4, atol=1e-4)

    @jax.jit
    def searched(x, factor):
        found = optx.minimise(loss, solver, x, factor, max_steps=100, throw=False)
        return found.value, loss(found.value, 1.0)

    start = jnp.zeros(3, jnp.float32)
    thousandths, (x, units) = searched(start, jnp.float32(1e-3))[1], searched(start, jnp.float32(1))
    assert searched(x, jnp.float32(1))[1] > 0.99 * units
    assert thousandths > 20 * units
