"""The size of the image that keypoints lie in, and keypoints given as shares of it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spt_jax.keypoints.entries import Person, as_size

#: What the width and height of an image are called.
SIZES = (
    ("width", "height"),
    ("canvas_width", "canvas_height"),
    ("image_width", "image_height"),
    ("img_width", "img_height"),
)

# Nobody has ever been seen in two pixels: so near to the corner are only shares of the canvas, some
# of them beyond its edge.
_LARGEST_SHARE = 2.0


def canvas_size(
    where: str, content: Mapping[str, Any], *, of_box: bool = False
) -> tuple[int | None, int | None]:
    """The width and height of the image in pixels, where the file states them.

    Args:
        where: names the file, for errors.
        content: of the file or of an entry.
        of_box: whether plain "width" and "height" are those of a person's box.

    Raises:
        ValueError: one of them is no positive number.
    """
    for names in SIZES[of_box:]:
        if any(name in content for name in names):
            width, height = (as_size(f"{name} in {where}", content.get(name)) for name in names)
            return width, height
    return None, None


def in_pixels(file: Path, people: Sequence[Person], remarks: Counter[str]) -> list[Person]:
    """The people with their points in pixels.

    Points in 0..1, which OpenPose (`keypoint_scale`), ControlNet and MediaPipe give, are multiplied
    by the width and height of the image, where the file states them.

    Raises:
        ValueError: everybody's points are such shares, and the file does not state the image's
            size, or they are negative, as shares from -1 to 1 are.
    """
    seen = [person.points[person.confidence > 0] for person in people]
    seen = np.concatenate(seen) if seen else np.empty((0, 2))
    if not len(seen) or np.abs(seen).max() > _LARGEST_SHARE:
        return list(people)
    if seen.min() < 0:
        raise ValueError(
            f"{file} must hold keypoints in pixels: got all of them between {seen.min():.3g} and "
            f"{seen.max():.3g}; shares of the image's size may count from its corner or from its "
            "middle, so multiply them by it first."
        )
    scaled = []
    for person in people:
        if person.width is None or person.height is None:
            raise ValueError(
                f"{file} must hold keypoints in pixels: got all of them between {seen.min():.3g} "
                f"and {seen.max():.3g}; where they are shares of the image's size, put its "
                "width and height into the file (in pixels), or multiply by them."
            )
        size = (person.width, person.height)
        scaled.append(person._replace(points=person.points * np.array(size, np.float64)))
        remarks[f"people in 0..1, scaled by the file's {size[0]} by {size[1]} pixels"] += 1
    return scaled
