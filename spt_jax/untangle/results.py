"""How an untangling ended, as optimistix says how a solve did."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """optimistix's results, and those of untangling.

    Compare them with `==`, elementwise over a batch; `RESULTS[result]` is the message of one.

    Attributes:
        successful: nothing collides.
        nonlinear_max_steps_reached: something is left, and the last descent had steps to go.
        nonlinear_divergence: something is left, and a descent ran away to where there was nothing
            to measure; that place was not taken.
        intersections_left: something is left, and every descent ended where it found nothing
            better.
        enclosed: nothing intersects, but a part lies wholly within another, or on a copy of its
            own, or is inside out.

    Example:
        >>> from spt_jax.untangle.results import RESULTS
        >>> RESULTS[RESULTS.intersections_left]
        'Intersections are left that the search found no way out of.'
    """

    intersections_left = "Intersections are left that the search found no way out of."
    enclosed = (
        "Nothing intersects, but a part lies wholly within another, or on a copy of its own, or is "
        "inside out, and is not pushed out."
    )


def in_words(result: Any, success: str) -> Any:
    """A result's message, `success` for a successful one; nested lists over the batch axes.

    Example:
        >>> from spt_jax.untangle.results import RESULTS, in_words
        >>> in_words(RESULTS.successful, "collision-free")
        'collision-free'
    """
    free = np.asarray(result == RESULTS.successful)
    words = np.empty(free.shape, object)
    for at in np.ndindex(free.shape):
        one = jax.tree.map(lambda leaf, at=at: jnp.asarray(leaf)[at], result)
        words[at] = RESULTS[one] or success
    return words.tolist()
