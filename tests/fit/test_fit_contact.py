"""The search by cuts: its model against a general solver, its descent, and fits that end free."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from helpers_fit import camera, frames, seen
from scipy.optimize import minimize

from spt_jax.fit import Search, Stages, Start, Terms
from spt_jax.fit.contact.cuts import Cuts, Squares
from spt_jax.fit.contact.descent import descend
from spt_jax.fit.contact.places import Place, _pulled_back, _seen
from spt_jax.fit.setup import prepare_fit


def squares_of(rng, people=2, size=3):
    jacobian, residuals = rng.normal(size=(people, 5, size)), rng.normal(size=(people, 5))
    curvature = np.einsum("nri,nrj->nij", jacobian, jacobian)
    return jacobian, residuals, Squares(curvature, np.einsum("nri,nr->ni", jacobian, residuals))


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_where_the_model_is_least(seed):
    rng = np.random.default_rng(seed)
    jacobian, residuals, squares = squares_of(rng)
    cuts, at, weight = Cuts(2, 3), rng.normal(size=(2, 3)), 10.0 ** (seed - 1)
    slopes, root = rng.normal(size=(3, 2, 3)), rng.uniform(0.5, 2)
    for slope in slopes:
        cuts.learn(at, root**2, 2 * root * slope, at, root**2)
    proximal = np.broadcast_to(0.3 * np.eye(3), (2, 3, 3))

    def model(flat):
        step = flat.reshape(2, 3)
        reach = max(0.0, *(root + float(np.sum(slope * step)) for slope in slopes))
        off = residuals + np.einsum("nri,ni->nr", jacobian, step)
        return float(np.sum(off**2) + 0.3 * np.sum(step**2) + weight * reach**2)

    step, gain = cuts.step(at, squares, proximal, weight)
    best = minimize(model, step.ravel(), method="Nelder-Mead", options={"maxiter": 4000})
    assert model(step.ravel()) <= best.fun + 1e-6 * (1 + abs(best.fun))
    far = min(
        minimize(model, rng.normal(size=6), method="Powell", options={"xtol": 1e-9}).fun
        for _ in range(3)
    )
    assert model(step.ravel()) <= far + 1e-5 * (1 + abs(far))
    # What it promises is what the model loses but for the proximal term.
    lost = model(np.zeros(6)) - (model(step.ravel()) - 0.3 * np.sum(step**2))
    np.testing.assert_allclose(gain, lost, rtol=1e-8, atol=1e-10)


def test_no_cut_says_more_than_was_measured():
    rng = np.random.default_rng(1)
    cuts, known = Cuts(1, 2), []
    for _ in range(40):
        place, held = rng.normal(size=(2, 1, 2))
        energies = [float(np.sin(3 * one).sum() ** 2) for one in (place, held)]
        gradient = 6 * np.sin(3 * place).sum() * np.cos(3 * place)
        cuts.learn(place, energies[0], gradient, held, energies[1])
        known = [(place, energies[0]), (held, energies[1])]
        for at, energy in known:
            assert cuts.reach(at) <= np.sqrt(energy) + 1e-9


class Ground:
    """Squares of the distance from (2, 0), and an overlap beyond x = 1."""

    def __init__(self):
        self.looks = 0

    def look(self, vector, margin):
        self.looks += 1
        off = vector - np.array([[2.0, 0.0]])
        deep = max(vector[0, 0] - 1 + margin, 0.0)
        squares = Squares(np.eye(2)[None], off)
        slope = np.array([[2 * deep, 0.0]])
        return Place(vector, float(np.sum(off**2)), squares, np.zeros((1, 3)), deep**2, slope)


@pytest.mark.parametrize("weight", [0.1, 1.0, 1000.0])
def test_a_descent_ends_where_squares_and_overlap_balance(weight):
    ground = Ground()
    start = ground.look(np.array([[2.5, 3.0]]), 0.1)
    place, converged = descend(ground.look, start, Cuts(1, 2), weight, 0.1, 50)
    # (x - 2)^2 + w (x - 0.9)^2 is least at (2 + 0.9 w) / (1 + w).
    best = np.array([[(2 + 0.9 * weight) / (1 + weight), 0.0]])
    least = ground.look(best, 0.1).total(weight)
    assert converged and ground.looks < 15
    assert place.total(weight) <= least + 0.03 * (1 + least)


def test_programs_of_the_search_call_nothing_on_the_host():
    """Such programs are not kept by JAX from process to process."""
    points = np.asarray(seen(frames("walk/0010")))
    setup, people, _ = prepare_fit(
        embedded_body(), points, camera(), layout="smpl", confidence=None, start=Start(),
        terms=Terms(), regularizer="spt", search=Search(), stages=Stages(),
    )  # fmt: skip
    person = jax.tree.map(lambda leaf: leaf[0], people)
    size = 3 * len(setup.search.figure.moving) + 3
    forces = jnp.zeros((embedded_body().num_vertices, 3))
    for function, more in ((_seen, ()), (_pulled_back, (forces,))):
        fixed = partial(function, setup.body, setup.search.objective(person))
        traced = jax.make_jaxpr(fixed)(jnp.zeros(size), *more)
        assert "host_call" not in str(traced) and "callback" not in str(traced)
