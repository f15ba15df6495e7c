"""What is known of an overlap, planes under its root, and the step that follows from it.

Near contact an overlap's volume E grows with the square of its depth, so that its root is nearly a
convex function of the variables. Each place that was measured gives a plane under it, a cut. With
the other terms as squares r + J d, d the step from a place, the next one minimises

    |r + J d|^2 + d' P d + w max(0, h_k + s_k . (x + d) for every cut k)^2,

P a proximal term. Cuts do not depend on the weight w, so those of one stage serve the next. The
same idea, with a displacement in place of the keypoints, is `spt_jax/untangle/contact_solver.py`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax._nonnegative import nonnegative_minimum

# Cuts that are kept, the latest ones.
_CUTS = 24

# Of the dual's diagonal, added so that equal cuts can be solved for.
_RIDGE = 1e-9


class Squares(NamedTuple):
    """Sums of squares about a place, one for each person: |r + J d|^2.

    Attributes:
        curvature: J'J.
        slope: J'r.
    """

    curvature: Float[np.ndarray, "N D D"]
    slope: Float[np.ndarray, "N D"]

    def change(self, step: Float[np.ndarray, "N D"]) -> float:
        """How much the squares grow by a step."""
        bend = np.einsum("nij,nj->ni", self.curvature, step)
        return float(np.sum(step * (bend + 2 * self.slope)))


class Cuts:
    """Planes under the root of an overlap, as far as it is known.

    Args:
        people: N, whose variables are stacked.
        size: of one person's variables.
    """

    def __init__(self, people: int, size: int):
        self._slope = np.zeros((0, people * size))
        self._height = np.zeros(0)
        self._weight = np.zeros(0)

    def learn(
        self,
        vector: Float[np.ndarray, "N D"],
        energy: float,
        gradient: Float[np.ndarray, "N D"],
        held: Float[np.ndarray, "N D"],
        there: float,
    ) -> None:
        """What was measured at a place; cuts that said more are lowered, those of long ago go.

        Args:
            vector: the place.
            energy, gradient: the overlap there.
            held: the best place so far, above whose overlap the new cut must not lie.
            there: its overlap.
        """
        at, root = vector.ravel(), np.sqrt(max(energy, 0.0))
        self._lower(at, root)
        if root > 0:
            slope = gradient.ravel() / (2 * root)
            self._slope = np.concatenate([self._slope, slope[None]])[-_CUTS:]
            self._height = np.append(self._height, root - slope @ at)[-_CUTS:]
            self._weight = np.append(self._weight, 0.0)[-_CUTS:]
        self._lower(held.ravel(), np.sqrt(max(there, 0.0)))

    def _lower(self, at: Float[np.ndarray, "ND"], root: float) -> None:
        self._height -= np.maximum(self._height + self._slope @ at - root, 0.0)

    def reach(self, vector: Float[np.ndarray, "N D"]) -> float:
        """What the root of the overlap is at a place, as far as the cuts know."""
        return float(np.max(self._height + self._slope @ vector.ravel(), initial=0.0))

    def step(
        self,
        vector: Float[np.ndarray, "N D"],
        squares: Squares,
        proximal: Float[np.ndarray, "N D D"],
        weight: float,
    ) -> tuple[Float[np.ndarray, "N D"], float]:
        """The step from a place, and how much it takes away of squares and overlap, by the model.

        By the dual, which has one number for each cut.

        Args:
            vector: the place.
            squares: the other terms there.
            proximal: P.
            weight: of the overlap.
        """
        # J'J of single precision is good to a millionth of its largest entry.
        inverse = np.linalg.inv(squares.curvature + proximal)
        inverse = (inverse + np.swapaxes(inverse, 1, 2)) / 2
        alone = -np.einsum("nij,nj->ni", inverse, squares.slope)
        step = alone
        if len(self._height) and weight > 0:
            rows = self._slope.reshape(len(self._height), *vector.shape)
            back = np.einsum("nij,cnj->cni", inverse, rows)
            matrix = self._slope @ back.reshape(len(rows), -1).T + 1 / weight
            matrix = (matrix + matrix.T) / 2
            matrix[np.diag_indices_from(matrix)] *= 1 + _RIDGE
            wanted = 2 * (self._height + self._slope @ (vector + alone).ravel())
            self._weight = nonnegative_minimum(matrix, wanted, self._weight > 0)
            step = alone - 0.5 * np.einsum("c,cni->ni", self._weight, back)
        before, after = self.reach(vector), self.reach(vector + step)
        return step, weight * (before**2 - after**2) - squares.change(step)
