"""How a solver ended: one set of statuses for fitting and untangling."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """optimistix's results, and those of untangling and fitting.

    Compare them with `==`, elementwise over a batch; `RESULTS[status]` is the message of one.

    Attributes:
        successful: nothing collides any more, or the fit converged.
        nonlinear_max_steps_reached: the last descent stopped at the largest number of steps.
        nonlinear_divergence: intersections are left, and a descent ran away to where nothing can
            be measured; that result was not taken.
        intersections_left: intersections are left, and every descent ended where it found nothing
            better.
        enclosed: no faces intersect, but a part is enclosed in another, lies on a copy of its own,
            or is inside out.
        not_finite: a fit came to no finite body.
        unseen: no keypoint of a person was seen, so that the fit ended where it started.
        outside_distance, outside_size, outside_focal_length: a fit ended where no photograph could
            show the body, so that camera or keypoints are in other units than pixels.

    Example:
        >>> from spt_jax import RESULTS
        >>> RESULTS[RESULTS.intersections_left]
        'Intersections are left that the search found no way out of.'
    """

    intersections_left = "Intersections are left that the search found no way out of."
    enclosed = (
        "No faces intersect, but a part is enclosed in another, lies on a copy of its own, or is "
        "inside out, and is not pushed out."
    )
    not_finite = "not finite: keypoints or camera are unusable"
    unseen = "no keypoint was seen: this is where the fit started"
    outside_distance = "distance outside any photograph: not 0.1 to 200 m from the camera"
    outside_size = "size outside any photograph: not 0.2 to 4 m, or less than 8 pixels"
    outside_focal_length = (
        "focal length outside any photograph: what is seen is more than 70 degrees off the optical "
        "axis"
    )


_NAMES = (
    "successful",
    "nonlinear_max_steps_reached",
    "nonlinear_divergence",
    "intersections_left",
    "enclosed",
    "not_finite",
    "unseen",
    "outside_distance",
    "outside_size",
    "outside_focal_length",
)

#: Statuses of fits in which no photograph could show the body.
OUTSIDE = ("outside_distance", "outside_size", "outside_focal_length")


def names_of(status: Any) -> Any:
    """The name of a status, a string; nested lists of them over the batch axes.

    Example:
        >>> from spt_jax._status import RESULTS, names_of
        >>> names_of(RESULTS.enclosed)
        'enclosed'
    """
    return _each(status, lambda one, name: name)


def in_words(status: Any, words: dict[str, str]) -> Any:
    """A status as a message; nested lists of them over the batch axes.

    Args:
        status: one of `RESULTS`, or a batch.
        words: by name, what is said in place of a status's own message.

    Example:
        >>> from spt_jax._status import RESULTS, in_words
        >>> in_words(RESULTS.successful, {"successful": "collision-free"})
        'collision-free'
    """
    return _each(status, lambda one, name: words.get(name) or RESULTS[one])


def _each(status: Any, say: Any) -> Any:
    known = {name: np.asarray(status == getattr(RESULTS, name)) for name in _NAMES}
    shape = known["successful"].shape
    found = np.empty(shape, object)
    for at in np.ndindex(shape):
        one = jax.tree.map(lambda leaf, at=at: jnp.asarray(leaf)[at], status)
        found[at] = say(one, next((n for n in _NAMES if known[n][at]), "solver_failed"))
    return found.tolist()
