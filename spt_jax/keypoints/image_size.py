"""The size of an image that is known by the people in it alone."""

from collections.abc import Sequence

import numpy as np

from spt_jax.keypoints.entries import Person

_LEAST_SIDE = 64  # pixels


def stated_image_size(people: Sequence[Person]) -> tuple[int, int] | None:
    """Width and height in pixels as the keypoint file states them; None if it does not.

    Args:
        people: of one image.

    Raises:
        ValueError: they state different sizes.
    """
    stated = sorted({(p.width, p.height) for p in people if p.width and p.height})
    if len(stated) > 1:
        raise ValueError(
            "people of one image must have one size of it: got "
            f"{' and '.join(f'{w} by {h}' for w, h in stated)} pixels for {people[0].image!r}"
        )
    return (int(stated[0][0]), int(stated[0][1])) if stated else None


def guessed_image_size(people: Sequence[Person]) -> tuple[int, int]:
    """Width and height in pixels that leave equal room around the keypoints that were seen."""
    points = np.concatenate([person.points[person.confidence > 0] for person in people])
    # As much room on the right and below as on the left and above.
    room = np.maximum(points.min(axis=0), 0)
    width, height = np.ceil(np.maximum(points.max(axis=0) + room, _LEAST_SIDE))
    return int(width), int(height)
