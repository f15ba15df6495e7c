"""People in OpenPose's JSON, and in what AlphaPose and ControlNet write in its manner."""

from collections.abc import Mapping
from typing import Any

from spt_jax.keypoints.entries import Order, Person, as_label
from spt_jax.keypoints.pixels import canvas_size
from spt_jax.keypoints.source import (
    NO_KEYPOINTS,
    Source,
    are_seen,
    count_other_points,
    objects,
    person_of,
)

_HANDS = (("hand_left_keypoints_2d", 21), ("hand_right_keypoints_2d", 21))
_BODIES = {25: "body25", 18: "openpose18"}


def is_openpose(content: Mapping[str, Any]) -> bool:
    """Whether it is a frame of OpenPose's."""
    people = content.get("people")
    if not isinstance(people, list):
        return False
    named = any(isinstance(person, dict) and "pose_keypoints_2d" in person for person in people)
    # An image without people has an empty list and OpenPose's version.
    return named or (not people and "layout" not in content)


def is_alphapose(content: Mapping[str, Any]) -> bool:
    """Whether it is a frame of AlphaPose's in the form of CMU-Pose (`--format cmu`)."""
    return isinstance(content.get("bodies"), list)


def are_frames(content: Mapping[str, Any]) -> bool:
    """Whether it is an object of frames by the names of their images, as AlphaPose writes."""
    return bool(content) and all(
        isinstance(frame, dict) and (is_openpose(frame) or is_alphapose(frame))
        for frame in content.values()
    )


def from_frames(source: Source, frames: Mapping[str | int, Mapping[str, Any]]) -> list[Person]:
    """People of frames, by the names or numbers of their images."""
    hands = any(_has_hands(source, frame) for frame in frames.values())
    return [
        person
        for name, frame in frames.items()
        for person in from_openpose(source, frame, name, hands=hands)
    ]


def from_openpose(
    source: Source,
    content: Mapping[str, Any],
    frame: str | int | None = None,
    *,
    hands: bool | None = None,
) -> list[Person]:
    """People of OpenPose's JSON, of AlphaPose's, and of ControlNet's, which states the canvas.

    Args:
        source: the file.
        content: of one frame.
        frame: its name or number, where the file has several.
        hands: whether somebody's hands were seen in any frame of the file.
    """
    at = f"{source.file}" if frame is None else f"frame {frame} of {source.file}"
    width, height = canvas_size(at, content)
    hands = _has_hands(source, content) if hands is None else hands
    key = "joints" if is_alphapose(content) else "pose_keypoints_2d"
    listed = "bodies" if is_alphapose(content) else "people"
    people = []
    for index, entry in enumerate(objects(f"{listed} in {at}", content[listed])):
        where = f"person {index} in {at}"
        if not entry.get(key):  # a face or a hand alone
            count_other_points(source, entry)
            source.skipped[NO_KEYPOINTS] += 1
            continue
        order, parts = source.order, ()
        body = _BODIES.get(_count(entry[key])) if order is None else None
        if order is not None and order.layout.endswith("_hands"):
            parts = _HANDS
        elif body is not None and hands:
            order, parts = Order(f"{body}_hands"), _HANDS
        usual = tuple(_BODIES.values())
        person = person_of(source, where, entry, key, order, usual, parts=parts)
        label = entry.get("person_id")  # [-1] where OpenPose did not track
        label = label[0] if isinstance(label, list) and label and label != [-1] else None
        place = {"image": frame, "width": width, "height": height, "id": as_label(label)}
        people.append(person._replace(**place))
    return people


def _has_hands(source: Source, content: Mapping[str, Any]) -> bool:
    people = content.get("people")
    return (
        source.layout is None
        and isinstance(people, list)
        and any(
            are_seen(person.get(name))
            for person in people
            if isinstance(person, dict) and person.get("pose_keypoints_2d")
            for name, _ in _HANDS
        )
    )


def _count(values: Any) -> int:
    if not isinstance(values, list) or not values:
        return 0
    return len(values) if isinstance(values[0], list) else len(values) // 3
