"""A keypoint file that is being read: what its people are called and made of."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from spt_jax.keypoints.confidences import as_rows, shape_of, shown
from spt_jax.keypoints.entries import Order, Person, as_points, choose_layout
from spt_jax.keypoints.vocabulary import layout_of, places_of

ACCEPTED = (
    'COCO annotations ({"images", "annotations", "categories"}), COCO results ([{"image_id", '
    '"keypoints", "score"}, ...]), what MMPose, AlphaPose, Detectron2 and Ultralytics write, '
    'OpenPose ({"people": [{"pose_keypoints_2d"}, ...]}), or '
    '{"layout", "people": [[[x, y, confidence], ...], ...]}'
)

NO_KEYPOINTS = "no keypoints"
NO_VISIBLE_POINT = "no visible point"
CROWD = "crowd"

# Beside the body's, as COCO-WholeBody, OpenPose, AlphaPose and MediaPipe call them.
_OTHER_POINTS = (
    *("foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts"),
    *("face_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d"),
    *("foot_keypoints_2d", "pose_keypoints_3d", "face_keypoints_3d"),
    *("hand_left_keypoints_3d", "hand_right_keypoints_3d"),
)


class Source(NamedTuple):
    """A file that is being read.

    Attributes:
        file: its path, for errors.
        layout: what the caller says that the keypoints are, or None.
        map: by this package's names of keypoints, the file's, as the caller says.
        skipped: how many people were left out, by reason.
        remarks: how many points, people or numbers are not used or not used as they stand, by what
            became of them.
    """

    file: Path
    layout: str | None
    map: Mapping[str, str]
    skipped: Counter[str]
    remarks: Counter[str]

    @property
    def order(self) -> Order | None:
        """What the caller says."""
        return None if self.layout is None else Order(self.layout)

    def named(self, names: Any, whose: str) -> Order:
        """The order of keypoints that a file names.

        Raises:
            ValueError: they are no names, none of them is known, or two are the same.
        """
        if not isinstance(names, (list, tuple)) or not all(isinstance(one, str) for one in names):
            raise ValueError(
                f"{self.file} must name its keypoints by strings: got {shown(names)} for {whose}."
            )
        listed = tuple(names)
        known = None if self.map else layout_of(listed)
        if known is not None:
            return Order(known)
        try:
            places = places_of(listed, self.map)
        except ValueError as error:
            raise ValueError(f"{self.file}: {error}") from error
        rows = tuple(k for k, place in enumerate(places) if place is not None)
        if not rows:
            raise ValueError(
                f"{self.file} must name keypoints that are known: got {shown(list(listed))} for "
                f"{whose}; say which they are with a map, such as left_wrist={listed[0]}, or give "
                "their layout."
            )
        unknown = [name for name, place in zip(listed, places, strict=True) if place is None]
        if unknown:
            what = f"keypoints of unknown names, which are not used ({', '.join(unknown[:8])}"
            self.remarks[f"{what}{', ...' if len(unknown) > 8 else ''})"] = len(unknown)
        order = ",".join(str(places[k]) for k in rows)
        # A comma distinguishes a list from the name of a layout.
        return Order(order if len(rows) > 1 else f"{order},", rows, len(listed))


def objects(where: str, value: Any) -> list[dict[str, Any]]:
    """A list of objects.

    Raises:
        ValueError: it is none; `where` names it.
    """
    if not isinstance(value, list):
        raise ValueError(f"{where} must be a list: got {type(value).__name__}.")
    for index, entry in enumerate(value):
        if not isinstance(entry, dict):
            raise ValueError(
                f"{where} must be a list of objects: got {type(entry).__name__} at entry {index}."
            )
    return value


def person_of(
    source: Source,
    where: str,
    entry: Mapping[str, Any],
    key: str,
    order: Order | None,
    usual: tuple[str, ...],
    *,
    flags: bool = False,
    parts: Sequence[tuple[str, int]] = (),
) -> Person:
    """One person of an entry.

    Args:
        source: the file.
        where: names the person and the file, for errors.
        entry: what the file has of the person.
        key: where its points are in there.
        order: what they are; None for the file's own names, or one of `usual`.
        usual: the format's own layouts.
        flags: confidences are COCO's v.
        parts: names of further points in the entry that follow, and how many they are.
    """
    count_other_points(source, entry, but=tuple(name for name, _ in parts))
    values = entry.get(key)
    if flags and isinstance(values, list) and (shape_of(values) or (0,))[-1] == 2:
        raise ValueError(
            f"{where} must have x, y and COCO's v a keypoint: got rows of two numbers."
        )
    if isinstance(values, list) and order is None and values and isinstance(values[0], dict):
        names = [point.get("name") for point in values if isinstance(point, dict)]
        order = source.named(names, where) if any(names) else None
    flat = as_rows(where, values, entry, source.remarks, key=key)
    for name, count in parts:
        beside = entry.get(name)
        more = as_rows(f"{name} of {where}", beside, {}, source.remarks) if beside else []
        if more and len(more) != 3 * count:
            raise ValueError(f"{name} of {where} must have {count} points: got {len(more) // 3}.")
        flat = flat + (more or [0.0] * (3 * count))
    layout, flat = choose_layout(where, flat, order, usual, source.remarks)
    points, confidence = as_points(where, flat, layout, source.remarks, flags=flags)
    return Person(points, confidence, layout.name)


def count_other_points(source: Source, entry: Mapping[str, Any], but: tuple[str, ...] = ()) -> None:
    """Note the points of an entry that are not used, those named in `but` left out."""
    for name in _OTHER_POINTS:
        if name in but:
            continue
        width = 4 if name.endswith("_3d") else 3
        count = sum(
            1 for row in _rows(entry.get(name), width) if isinstance(row, list) and any(row)
        )
        if count:
            source.remarks[f"points in {name}, which are not used"] += count


def are_seen(values: Any) -> bool:
    """Whether points given beside the body's are there: one with a confidence."""
    return any(isinstance(row, list) and len(row) == 3 and row[2] for row in _rows(values, 3))


def _rows(values: Any, width: int) -> list[Any]:
    if not isinstance(values, list) or not values:
        return []
    if isinstance(values[0], list):
        return values
    return [values[k : k + width] for k in range(0, len(values), width)]
