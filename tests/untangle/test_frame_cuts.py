"""The least smooth correction over cuts, against general minimisers and closed forms."""

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from spt_jax._nonnegative import nonnegative_minimum
from spt_jax.untangle.frame_cuts import FrameCuts, Ties, prior


def cost(prior_matrix, cuts, stiffness, mean, ties):
    def of(flat):
        y = flat.reshape(mean.shape)
        reach = np.zeros(len(y))
        said = cuts.height + np.einsum("cn,cn->c", cuts.slope, y[cuts.frame])
        np.maximum.at(reach, cuts.frame, said)
        smooth = np.einsum("tn,ts,sn->", y - mean, prior_matrix, y - mean)
        tied = ties.height + np.einsum("rn,rn->r", ties.slope, y[ties.frame])
        return smooth + stiffness @ reach**2 + ties.weight @ tied**2

    return of


def test_the_correction_is_the_least_one(rng):
    frames, size = 9, 3
    known = prior(rng.normal(size=(2, size)), frames, 2, 1.5)
    cuts, stiffness = FrameCuts(size), rng.uniform(0.5, 5.0, frames)
    for _ in range(3):
        chosen = np.sort(rng.permutation(frames)[:6])
        cuts.learn(
            chosen,
            rng.normal(size=(6, size)),
            rng.uniform(0.1, 4.0, 6),
            rng.normal(size=(6, size)),
        )
    for rows in (0, 5):
        frame = rng.integers(frames, size=rows)
        slope, height = rng.normal(size=(rows, size)), rng.normal(size=rows)
        ties = Ties(frame, slope, height, rng.uniform(0.5, 5.0, rows))
        check_least(cuts, known, stiffness, ties)
        held = rng.uniform(0.0, 3.0, frames) * (rng.random(frames) < 0.5)
        check_least(cuts, known.held(held, rng.normal(size=(frames, size))), stiffness, ties)


def check_least(cuts, known, stiffness, ties):
    of = cost(known.matrix, cuts, stiffness, known.mean, ties)
    np.testing.assert_allclose(known.matrix @ known.kernel, np.eye(len(known.mean)), atol=1e-9)
    found = of(cuts.minimum(known, stiffness, ties).ravel())
    general = minimize(of, known.mean.ravel(), method="BFGS", options={"gtol": 1e-9})
    assert found <= general.fun * (1 + 1e-6)
    assert found == pytest.approx(general.fun, rel=1e-3)


def test_a_push_in_one_frame_fades_and_never_swings_back():
    """Far from the ends, as (1 + t / s) exp(-t / s)."""
    smoothness, frames = 8.0, 161
    column = prior(np.zeros((2, 1)), frames, 2, smoothness).kernel[:, 80]
    time = np.abs(np.arange(frames) - 80) / smoothness
    np.testing.assert_allclose(column / column[80], (1 + time) * np.exp(-time), atol=3e-3)
    assert (column > 0).all()


def test_what_is_fixed_before_is_gone_on_with():
    """A correction that rests on nothing else goes on from it, and fades."""
    earlier = np.array([[1.0, -2.0], [1.0, -2.0]])
    mean = prior(earlier, 60, 2, 4.0).mean
    assert 0.8 < mean[0, 0] < 1.0 and abs(mean[-1, 0]) < 1e-3
    np.testing.assert_allclose(mean[:, 1], -2 * mean[:, 0], atol=1e-12)
    assert (np.diff(mean[:, 0]) < 0).all()
    assert not prior(np.zeros((0, 2)), 5, 0, 4.0).mean.any()


def test_a_cut_that_said_too_much_is_lowered_and_the_oldest_ones_go():
    cuts = FrameCuts(2)
    frame, place = np.array([3]), np.zeros((1, 2))
    cuts.learn(frame, place, np.array([4.0]), np.array([[4.0, 0.0]]))  # c = 2, dc = 1
    assert cuts.height[0] == 2.0 and cuts.slope[0].tolist() == [1.0, 0.0]
    cuts.learn(frame, np.array([[-1.0, 0.0]]), np.array([0.0]), np.zeros((1, 2)))
    assert cuts.height.tolist() == [1.0]  # it is nothing there, so no more than that
    for k in range(8):
        place = np.full((1, 2), 10.0 + k)
        cuts.learn(frame, place, np.array([1e6 + k]), np.ones((1, 2)))
    assert len(cuts.frame) == 5 and (cuts.frame == 3).all()
    assert len(cuts.height) == len(cuts.slope) == len(cuts.weight) == 5


@pytest.mark.parametrize("count", [1, 7, 60, 200])
def test_weights_are_never_negative(rng, count):
    root = rng.normal(size=(count + 3, count))
    matrix, wanted = root.T @ root + 0.01 * np.eye(count), rng.normal(size=count)
    factor = np.linalg.cholesky(matrix)
    general = nnls(factor.T, np.linalg.solve(factor, wanted))[0]
    for start in (np.zeros(count, bool), np.ones(count, bool), rng.random(count) < 0.5):
        found = nonnegative_minimum(matrix, wanted, start)
        np.testing.assert_allclose(found, general, atol=1e-7 * np.abs(general).max(initial=1.0))
        assert (found >= 0).all()


def test_a_held_frame_stays_near_its_place(rng):
    known = prior(np.zeros((0, 2)), 12, 0, 2.0)
    place, held = rng.normal(size=(12, 2)), np.zeros(12)
    assert known.held(held, place) is known
    held[4] = 1e6
    mean = known.held(held, np.where(held[:, None] > 0, place, np.nan)).mean
    np.testing.assert_allclose(mean[4], place[4], rtol=1e-4)
    assert np.abs(mean[-1]).max() < np.abs(mean[4]).max()
