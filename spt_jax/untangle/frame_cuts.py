"""The least smooth correction of a run of frames that clears what is known of their collisions.

A correction has one vector y_t a frame. Its cost is that of a smooth prior,

    sum over t of |y_t|^2 + 2 s^2 |y_t+1 - y_t|^2 + s^4 |y_t+1 - 2 y_t + y_t-1|^2 = y' (K x I) y,

the energy |y - s^2 y''|^2 whose answer to a push in one frame is (1 + |t| / s) exp(-|t| / s): it
fades over s frames and never swings to the other side (a Matérn kernel of order 3/2). Where s
varies, it is that of the frames at which the differences are taken (`pace`). Collisions
are known by cuts, planes under the convex functions c_t(y_t) that the roots of the penalties nearly
are (`contact_solver`). What is sought is

    min over y of y' (K x I) y + sum over t of w_t max(0, h_k + s_k . y_t for every cut k of t)^2.

Its dual has one weight a cut, not negative, and the matrix S (K^-1 x I) S' + 1 / w of cuts of one
frame: frames meet only in K^-1, of which there is one small matrix, so that nothing of the size of
the whole correction is ever solved.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax._nonnegative import nonnegative_minimum

# Cuts of one frame that are kept, the latest ones.
_CUTS = 5

# Of the dual's diagonal, added so that equal cuts can be solved for.
_RIDGE = 1e-9


class Prior(NamedTuple):
    """The smooth prior of a window, given what is fixed around it.

    Attributes:
        matrix: K of the frames that are free.
        kernel: K^-1.
        mean: the correction without any cuts, which the frames fixed before pass on.
    """

    matrix: Float[np.ndarray, "T T"]
    kernel: Float[np.ndarray, "T T"]
    mean: Float[np.ndarray, "T N"]

    def held(self, stiffness: Float[np.ndarray, "T"], place: Float[np.ndarray, "T N"]) -> "Prior":
        """The prior with stiffness_t |y_t - place_t|^2 added."""
        if not stiffness.any():
            return self
        matrix = self.matrix + np.diag(stiffness)
        kernel = np.linalg.inv(matrix)
        kernel = (kernel + kernel.T) / 2
        pull = self.matrix @ self.mean + stiffness[:, None] * np.where(stiffness[:, None], place, 0)
        return Prior(matrix, kernel, kernel @ pull)

    def cost(self, vectors: Float[np.ndarray, "T N"]) -> float:
        """What a correction costs beyond that of the mean."""
        return float(np.sum((vectors - self.mean) * (self.matrix @ (vectors - self.mean))))


class Ties(NamedTuple):
    """Linear terms w (h + s . y_t)^2 that are no collisions: of what is to stay in place.

    Attributes:
        frame: t of each.
        slope, height: s and h.
        weight: w.
    """

    frame: Int[np.ndarray, "R"]
    slope: Float[np.ndarray, "R N"]
    height: Float[np.ndarray, "R"]
    weight: Float[np.ndarray, "R"]

    @staticmethod
    def none(size: int) -> "Ties":
        """No ties."""
        return Ties(np.zeros(0, np.int64), np.zeros((0, size)), np.zeros(0), np.zeros(0))

    def cost(self, vectors: Float[np.ndarray, "T N"]) -> float:
        """The sum of the terms."""
        reach = self.height + np.einsum("rn,rn->r", self.slope, vectors[self.frame])
        return float(self.weight @ reach**2)


def prior(
    fixed_before: Float[np.ndarray, "B N"],
    free: int,
    fixed_after: int,
    smoothness: float | Float[np.ndarray, "F"],
) -> Prior:
    """The prior of `free` frames between frames whose correction is known.

    Args:
        fixed_before: corrections of the frames before; none where the motion begins there.
        free: how many frames there are to be found.
        fixed_after: how many frames after have no correction; none where the motion ends there, or
            the rest of it is found later.
        smoothness: s of each frame, in frames, of those before and after too.
    """
    before = len(fixed_before)
    count = before + free + fixed_after
    matrix = np.eye(count)
    smoothness = np.broadcast_to(smoothness, count)
    between = smoothness[1:] * smoothness[:-1]
    for order, factor in ((1, 2 * between), (2, smoothness[1:-1] ** 4)):
        if count > order:
            difference = np.diff(np.eye(count), n=order, axis=0)
            matrix += (difference.T * factor) @ difference
    chosen = slice(before, before + free)
    kernel = np.linalg.inv(matrix[chosen, chosen])
    kernel = (kernel + kernel.T) / 2
    mean = -kernel @ (matrix[chosen, :before] @ fixed_before)
    return Prior(matrix[chosen, chosen], kernel, mean)


class FrameCuts:
    """What is known of the collisions of a window's frames."""

    def __init__(self, size: int):
        self.frame = np.zeros(0, np.int64)
        self.slope = np.zeros((0, size))
        self.height = np.zeros(0)
        self.weight = np.zeros(0)

    def learn(
        self,
        frame: Int[np.ndarray, "F"],
        place: Float[np.ndarray, "F N"],
        squared: Float[np.ndarray, "F"],
        gradient: Float[np.ndarray, "F N"],
    ) -> None:
        """What was found at one place of each of some frames: c^2 and its gradient.

        A cut that said more than was found is lowered; the oldest ones of a frame go.
        """
        root = np.sqrt(np.maximum(squared, 0.0))
        found = np.full(int(max(self.frame.max(initial=-1), frame.max(initial=-1))) + 1, -1)
        found[frame] = np.arange(len(frame))
        known = np.flatnonzero(found[self.frame] >= 0)
        at = found[self.frame[known]]
        said = self.height[known] + np.einsum("cn,cn->c", self.slope[known], place[at])
        self.height[known] -= np.maximum(said - root[at], 0.0)
        fresh = np.flatnonzero(root > 0)
        slope = gradient[fresh] / (2 * root[fresh, None])
        self.frame = np.concatenate([self.frame, frame[fresh]])
        self.slope = np.concatenate([self.slope, slope])
        height = root[fresh] - np.einsum("cn,cn->c", slope, place[fresh])
        self.height = np.concatenate([self.height, height])
        self.weight = np.concatenate([self.weight, np.zeros(len(fresh))])
        self._keep(self._latest())

    def _latest(self) -> Bool[np.ndarray, "C"]:
        count = len(self.frame)
        order = np.lexsort((-np.arange(count), self.frame))
        sorted_frames = self.frame[order]
        kept = np.zeros(count, bool)
        # How many of the same frame are later than it.
        kept[order] = np.arange(count) - np.searchsorted(sorted_frames, sorted_frames) < _CUTS
        return kept

    def _keep(self, kept: Bool[np.ndarray, "C"]) -> None:
        self.frame, self.slope = self.frame[kept], self.slope[kept]
        self.height, self.weight = self.height[kept], self.weight[kept]

    def reach(self, vectors: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T"]:
        """Of each frame the highest cut at a place, or 0: what the root of its overlap may be."""
        found = np.zeros(len(vectors))
        said = self.height + np.einsum("cn,cn->c", self.slope, vectors[self.frame])
        np.maximum.at(found, self.frame, said)
        return found

    def minimum(
        self, known: Prior, stiffness: Float[np.ndarray, "T"], ties: Ties
    ) -> Float[np.ndarray, "T N"]:
        """The correction at which the cost over all cuts and ties is least.

        Args:
            known: the prior.
            stiffness: w_t of each frame.
            ties: what else is asked of frames.
        """
        count = len(self.frame)
        frame = np.concatenate([self.frame, ties.frame])
        if not len(frame):
            return known.mean
        slope = np.concatenate([self.slope, ties.slope])
        height = np.concatenate([self.height, ties.height])
        wanted = 2 * (height + np.einsum("cn,cn->c", slope, known.mean[frame]))
        matrix = (slope @ slope.T) * known.kernel[np.ix_(frame, frame)]
        cut = slice(0, count)
        same = self.frame[:, None] == self.frame
        matrix[cut, cut] += np.where(same, 1 / stiffness[self.frame], 0.0)
        at = np.arange(count, len(frame))
        matrix[at, at] += 1 / ties.weight
        matrix[np.diag_indices_from(matrix)] *= 1 + _RIDGE
        weight = _with_free(matrix, wanted, count, self.weight > 0)
        self.weight = weight[cut]
        pull = np.zeros_like(known.mean)
        np.add.at(pull, frame, weight[:, None] * slope)
        return known.mean - 0.5 * known.kernel @ pull


def _with_free(matrix, wanted, count: int, positive):
    """As `nonnegative_minimum`, where only the first `count` must not be negative."""
    if count == len(matrix):
        return nonnegative_minimum(matrix, wanted, positive)
    cut, free = slice(0, count), slice(count, None)
    both = np.column_stack([matrix[free, cut], wanted[free]])
    solved = np.linalg.solve(matrix[free, free], both)
    rest = matrix[cut, cut] - matrix[cut, free] @ solved[:, :-1]
    left = wanted[cut] - matrix[cut, free] @ solved[:, -1]
    weight = nonnegative_minimum((rest + rest.T) / 2, left, positive)
    return np.concatenate([weight, solved[:, -1] - solved[:, :-1] @ weight])
