"""The size of an image of which only the keypoints of the people in it are known."""

from collections.abc import Sequence

import numpy as np

from spt_jax.keypoints.entries import Person

_LEAST_SIDE = 64  # pixels


def guessed_image_size(people: Sequence[Person]) -> tuple[int, int]:
    """Width and height in pixels that leave equal room around the keypoints that were seen."""
    points = np.concatenate([person.points[person.confidence > 0] for person in people])
    # As much room on the right and below as on the left and above.
    room = np.maximum(points.min(axis=0), 0)
    width, height = np.ceil(np.maximum(points.max(axis=0) + room, _LEAST_SIDE))
    return int(width), int(height)
