"""One person's numbers in a file of keypoints, checked one by one."""

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.keypoints.confidences import shown
from spt_jax.keypoints.layout import Layout
from spt_jax.keypoints.layouts import LAYOUTS, as_layout, layouts_of_count

#: Confidence of a point that COCO's annotators marked as hidden (v = 1): they guessed its place.
OCCLUDED = 0.5

# No camera has a million pixels in a row: such a number is another column, or damage.
_FARTHEST = 1e6
# AlphaPose gives up to 6, and the logits of MMPose's SimCC heads reach 10
# (https://github.com/open-mmlab/mmpose/issues/2939). Percent would all become 1.
_SUREST = 20.0
# What lists of so many points are where nothing says so: COCO's 17 points and feet; Halpe's head,
# neck, hip and feet; both again with face and hands. All begin with COCO's 17.
_LONGER_THAN_COCO = {23: "coco23", 26: "halpe26", 133: "wholebody133", 136: "halpe136"}
_CLIPPED = "confidences above 1, taken as 1"
_COLUMNS = ("x", "y", "confidence")


class Person(NamedTuple):
    """One person's keypoints in one image.

    Attributes:
        points: in pixels from the top left; (0, 0) where missing.
        confidence: of each point, from 0, missing, to 1.
        layout: the name of the keypoints' order, a key of `spt_jax.keypoints.LAYOUTS`, or the
            keypoints' names with commas between them.
        image: the image's file name, or its id where the file knows no more; or None.
        width, height: of that image in pixels, or None.
        id: the person's own id in the file, or None.
        score: the detector's confidence in the whole person, or None.
    """

    points: Float[np.ndarray, "K 2"]
    confidence: Float[np.ndarray, "K"]
    layout: str
    image: str | int | None = None
    width: int | None = None
    height: int | None = None
    id: str | int | None = None
    score: float | None = None


class Order(NamedTuple):
    """What the keypoints of a list are.

    Attributes:
        layout: a key of LAYOUTS, "smpl", or names with commas between them.
        rows: which points of the list are the layout's; None for all.
        count: how many points the list has, where `rows` is given.
    """

    layout: str
    rows: tuple[int, ...] | None = None
    count: int = 0


def choose_layout(
    where: str,
    flat: list[Any],
    order: Order | None,
    usual: tuple[str, ...],
    remarks: Counter[str],
) -> tuple[Layout, list[Any]]:
    """The layout asked for, or the one of the format's own that has so many keypoints.

    Returns:
        The layout, and the numbers of its points. What is left out is counted in `remarks`: of a
        longer list that begins with COCO's 17, where those were asked for, all but these.

    Raises:
        ValueError: it has another count, or the format has none of that count.
    """
    count = len(flat) // 3
    if order is not None and order.layout == "coco17" and count in _LONGER_THAN_COCO:
        kept = len(LAYOUTS["coco17"].names)
        remarks["points of feet, face, hands and such after COCO's 17, which are not used"] += (
            count - kept
        )
        return LAYOUTS["coco17"], flat[: 3 * kept]
    if order is None and "coco17" in usual and count in _LONGER_THAN_COCO:
        order = Order(_LONGER_THAN_COCO[count])
    if order is not None:
        if order.rows is not None:
            if count != order.count:
                raise ValueError(
                    f"{where} must have a point for each of the {order.count} names in the file: "
                    f"got {count}."
                )
            flat = [number for k in order.rows for number in flat[3 * k : 3 * k + 3]]
            count = len(order.rows)
        try:
            return as_layout(order.layout, count), flat
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
    for name in usual:
        if len(LAYOUTS[name].names) == count:
            return LAYOUTS[name], flat
    counts = " or ".join(f"{len(LAYOUTS[name].names)} ({name})" for name in usual)
    rule = f"must have {counts} keypoints" if usual else "needs a layout, which the file lacks"
    fitting = layouts_of_count(count)
    raise ValueError(
        f"{where} {rule}: got {count}; name the layout that it has, one of "
        f"{', '.join(fitting or LAYOUTS)}."
    )


def as_points(
    where: str,
    flat: list[Any],
    layout: Layout,
    remarks: Counter[str],
    *,
    flags: bool = False,
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K"]]:
    """Points and confidences of checked numbers.

    Args:
        where: names the file and the person, for errors.
        flat: x, y and confidence of each keypoint in turn.
        layout: names the keypoints, for errors.
        remarks: of what is changed, which are counted up.
        flags: the third number is COCO's v: 0 not labelled, 1 labelled but hidden, 2 visible.

    Returns:
        Points, (0, 0) where missing, and confidences from 0 to 1; larger ones, which some detectors
        give, become 1. A point at (0, 0) is missing whatever its confidence: so detectors mark
        those that they did not find.

    Raises:
        ValueError: an entry is no number, is not finite, is out of range; a v that is none.
    """
    numbers = np.empty(len(flat))
    for index, value in enumerate(flat):
        keypoint, column = divmod(index, 3)
        entry = f"{_COLUMNS[column]} of keypoint {keypoint} ({layout.names[keypoint]})"
        numbers[index] = as_number(f"{where}: {entry}", value)
        limit = _SUREST if column == 2 else _FARTHEST
        if abs(numbers[index]) > limit:
            hint = "; divide percent by 100" if column == 2 else ""
            raise ValueError(
                f"{where}: {entry} must be at most {limit:g} in size: got {value!r}{hint}."
            )
        if column < 2:
            continue
        if flags and value not in (0, 1, 2):
            raise ValueError(f"{where}: {entry} must be 0, 1 or 2, COCO's v: got {value!r}.")
        if numbers[index] < 0:
            raise ValueError(
                f"{where}: {entry} must not be negative: got {value!r}; 0 means missing."
            )
    rows = numbers.reshape(-1, 3)
    confidence = np.array([0, OCCLUDED, 1])[rows[:, 2].astype(int)] if flags else rows[:, 2]
    lost = (confidence > 0) & ~rows[:, :2].any(axis=1)
    over = (confidence > 1) & ~lost
    for what, found in (("points at (0, 0), taken as missing", lost), (_CLIPPED, over)):
        if found.any():
            remarks[what] += int(found.sum())
    confidence = np.where(lost, 0.0, np.minimum(confidence, 1.0))
    nowhere = (confidence > 0) & np.array([point == "" for point in layout.points])
    if nowhere.any():
        remarks["points of the face, which are not used"] += int(nowhere.sum())
        confidence = np.where(nowhere, 0.0, confidence)
    return np.where(confidence[:, None] > 0, rows[:, :2], 0.0), confidence


def as_number(where: str, value: Any) -> float:
    """A finite number.

    Raises:
        ValueError: it is none; `where` names the entry.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{where} must be a number: got {shown(value)}.")
    try:
        number = float(value)
    except OverflowError:
        number = np.inf
    if not np.isfinite(number):
        raise ValueError(
            f"{where} must be finite: got {number}; a missing point is (0, 0) with confidence 0."
        )
    return number


def as_size(where: str, value: Any) -> int | None:
    """A width or height in whole pixels; None stays None.

    Raises:
        ValueError: it is no positive number.
    """
    if value is None:
        return None
    number = as_number(where, value)
    if not 1 <= number <= _FARTHEST:
        raise ValueError(f"{where} must be a number of pixels, 1 or more: got {value!r}.")
    return round(number)


def as_label(value: Any) -> str | int | None:
    """A name or an id; anything else is no label."""
    return value if isinstance(value, (str, int)) and not isinstance(value, bool) else None
