"""The least cost where what is tied moves along an arc, beside a minimiser of SciPy's."""

import numpy as np
import pytest
from scipy.optimize import minimize

from spt_jax.untangle.anchors import Anchored
from spt_jax.untangle.curved_ties import anchored_minimum
from spt_jax.untangle.frame_cuts import FrameCuts, Ties, prior

FRAMES, LONG = 5, 8.0


class Arc(Anchored):
    """In each frame an arm of length 8 turns by y_0 / 8, and y_1 and y_2 move its foot.

    The tip is to stay where it was: y_1 undoes how far it went, y_2 how far it sank.
    """

    def __init__(self, weight):
        self.weight = weight
        self.looks = 0
        self.look(np.zeros((FRAMES, 3)))

    @staticmethod
    def places(vectors):
        turn = vectors[:, 0] / LONG
        return np.stack(
            [LONG * np.sin(turn) + vectors[:, 1], LONG * (np.cos(turn) - 1) + vectors[:, 2]], axis=1
        )

    def look(self, vectors):
        self.looks += 1
        turn = vectors[:, 0] / LONG
        slope = np.zeros((FRAMES, 2, 3))
        slope[:, 0, 0], slope[:, 1, 0] = np.cos(turn), -np.sin(turn)
        slope[:, 0, 1] = slope[:, 1, 2] = 1.0
        self.slope = slope.reshape(-1, 3)
        said = np.einsum("fan,fn->fa", slope, vectors)
        self.height = (self.places(vectors) - said).ravel()

    def ties(self):
        frame = np.repeat(np.arange(FRAMES), 2)
        return Ties(frame, self.slope, self.height, np.full(2 * FRAMES, self.weight))


def problem(weight, aside):
    """A cut in the middle frame asks for a turn, or for more of it than the tip would allow."""
    known = prior(np.zeros((2, 3)), FRAMES, 2, 1.5)
    cuts = FrameCuts(3)
    slope = np.array([[-1.0, -aside, 0.0]])
    cuts.learn(np.array([2]), np.zeros((1, 3)), np.array([36.0]), 12.0 * slope)
    arc = Arc(weight)
    stiffness = np.full(FRAMES, 50.0)

    def cost(flat):
        vectors = flat.reshape(FRAMES, 3)
        crossed = cuts.reach(vectors) ** 2 @ stiffness
        return known.cost(vectors) + crossed + weight * np.sum(arc.places(vectors) ** 2)

    return known, cuts, stiffness, arc, cost


@pytest.mark.parametrize("weight", [1.0, 20.0, 1000.0, 30000.0])
@pytest.mark.parametrize("aside", [0.0, 0.9])
def test_it_is_as_little_as_a_general_minimiser_finds(weight, aside):
    known, cuts, stiffness, arc, cost = problem(weight, aside)
    vectors = np.zeros((FRAMES, 3))
    hold = 1 / np.diag(known.kernel)
    for _ in range(10):  # as many rounds with the same cuts
        found = anchored_minimum(cuts, known, stiffness, arc, vectors, hold)
        assert cost(found.ravel()) <= cost(vectors.ravel()) * (1 + 1e-9)
        vectors = found
    best = min(
        minimize(cost, start, method="BFGS", options={"maxiter": 3000}).fun
        for start in (vectors.ravel(), np.zeros(3 * FRAMES))
    )
    assert cost(vectors.ravel()) <= 1.03 * best
    # Afterwards the ties stand where the correction is.
    assert arc.ties().cost(vectors) == pytest.approx(
        weight * np.sum(arc.places(vectors) ** 2), rel=1e-6, abs=1e-9
    )


def test_a_step_along_the_tangent_would_cost_more_than_nothing_at_all():
    known, cuts, stiffness, arc, cost = problem(30000.0, 0.0)
    tangent = cuts.minimum(known, stiffness, arc.ties())
    assert cost(tangent.ravel()) > 2 * cost(np.zeros(3 * FRAMES))


def test_without_anchors_it_is_the_minimum_over_the_cuts():
    known, cuts, stiffness, arc, _ = problem(1.0, 0.0)
    arc.ties = lambda: Ties.none(3)
    hold, vectors = np.ones(FRAMES), np.zeros((FRAMES, 3))
    found = anchored_minimum(cuts, known, stiffness, arc, vectors, hold)
    np.testing.assert_array_equal(found, cuts.minimum(known, stiffness, Ties.none(3)))
    assert arc.looks == 2
