"""A quadratic function over numbers that must not be negative: the dual of a search by cuts."""

import numpy as np
from jaxtyping import Bool, Float

# Rounds of pivoting in blocks; and how many without progress before it goes one by one, which ends.
_ROUNDS, _PATIENCE = 300, 5


def nonnegative_minimum(
    matrix: Float[np.ndarray, "C C"],
    wanted: Float[np.ndarray, "C"],
    positive: Bool[np.ndarray, "C"],
) -> Float[np.ndarray, "C"]:
    """a >= 0 at which a' M a / 2 - a . wanted is least, M positive definite.

    By pivoting in blocks (Júdice and Pires 1994): those that are held at zero and those that are
    not change sides all at once while that leaves fewer and fewer on the wrong one, and otherwise
    only the last of them, which comes to an end.

    Args:
        matrix: M.
        wanted: what M a would be, were all positive.
        positive: a first guess of where a is.
    """
    positive = positive.copy()
    fewest, patience = len(wanted) + 1, _PATIENCE
    size = np.abs(wanted).max(initial=0.0)
    found = np.zeros_like(wanted)
    for _ in range(_ROUNDS):
        at = np.flatnonzero(positive)
        found = np.zeros_like(wanted)
        if len(at):
            found[at] = np.linalg.solve(matrix[np.ix_(at, at)], wanted[at])
        left = wanted - matrix @ found
        wrong = np.flatnonzero(np.where(positive, found < 0, left > 1e-9 * size))
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), _PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        positive[wrong] = ~positive[wrong]
    return np.maximum(found, 0.0)
