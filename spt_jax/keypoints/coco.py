"""People in COCO's annotations and results, and in the lists that detectors write."""

from collections.abc import Mapping
from typing import Any

from spt_jax.keypoints.entries import Order, Person, as_label, as_number, as_size
from spt_jax.keypoints.pixels import canvas_size
from spt_jax.keypoints.source import (
    ACCEPTED,
    CROWD,
    NO_KEYPOINTS,
    NO_VISIBLE_POINT,
    Source,
    are_seen,
    objects,
    person_of,
)

_FRAMES = ("frame_id", "frame_index", "frame_idx", "image_id")
_IDS = ("id", "track_id", "instance_id", "person_id", "idx")
# COCO-WholeBody's, in the order of its 133 points.
_WHOLE = (("foot_kpts", 6), ("face_kpts", 68), ("lefthand_kpts", 21), ("righthand_kpts", 21))


def from_annotations(source: Source, content: Mapping[str, Any]) -> list[Person]:
    """People of COCO's annotations, and of COCO-WholeBody's."""
    file, skipped = source.file, source.skipped
    images = {}
    for index, image in enumerate(objects(f"images in {file}", content.get("images", []))):
        where = f"image {index} in {file}"
        size = tuple(as_size(f"{key} of {where}", image.get(key)) for key in ("width", "height"))
        label = as_label(image.get("file_name"))
        images[as_label(image.get("id"))] = (label, *size)
    orders = _category_orders(source, content)
    people = []
    annotations = objects(f"annotations in {file}", content["annotations"])
    whole = source.layout in (None, "wholebody133") and any(
        are_seen(entry.get(name)) for entry in annotations for name, _ in _WHOLE
    )
    for index, entry in enumerate(annotations):
        if entry.get("iscrowd"):
            skipped[CROWD] += 1
        elif entry.get("num_keypoints") == 0:
            skipped[NO_VISIBLE_POINT] += 1
        elif "keypoints" not in entry:
            skipped[NO_KEYPOINTS] += 1
        else:
            label = as_label(entry.get("id"))
            where = f"person {index}{'' if label is None else f' (id {label})'} in {file}"
            order = orders.get(as_label(entry.get("category_id")), source.order)
            parts = _WHOLE if whole and (order is None or order.layout == "coco17") else ()
            order = Order("wholebody133") if parts else order
            person = person_of(
                source, where, entry, "keypoints", order, ("coco17",), flags=True, parts=parts
            )
            image_id = as_label(entry.get("image_id"))
            image, width, height = images.get(image_id, (None, None, None))
            image = image_id if image is None else image
            people.append(person._replace(image=image, width=width, height=height, id=label))
    if annotations and skipped[NO_KEYPOINTS] == len(annotations):
        raise ValueError(
            f"{file} must have keypoints: got {len(annotations)} annotations without any; COCO's "
            "are in person_keypoints_*.json, not in instances_*.json."
        )
    return people


def from_results(source: Source, content: list[Any]) -> list[Person]:
    """People of COCO's results, of detectors that write lists, and of lists of their frames."""
    entries = objects(str(source.file), content)
    people = _instances(source, entries, None)
    if entries and not people and sum(source.skipped.values()) >= len(entries):
        raise ValueError(
            f"{source.file} must hold {ACCEPTED}: got a list of {len(entries)} objects without "
            "keypoints."
        )
    return people


def from_mmpose(source: Source, content: Mapping[str, Any]) -> list[Person]:
    """People of the file of MMPose's demos, whose `meta_info` names the keypoints."""
    meta = content.get("meta_info")
    names = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    order = source.order
    if isinstance(names, dict) and order is None:
        listed = [names.get(str(k), names.get(k)) for k in range(len(names))]
        order = source.named(listed, "MMPose's meta_info")
    entries = objects(f"instance_info in {source.file}", content["instance_info"])
    return _instances(source, entries, None, order)


def _instances(
    source: Source,
    entries: list[dict[str, Any]],
    image: str | int | None,
    order: Order | None = None,
) -> list[Person]:
    """People of MMPose's, AlphaPose's, Detectron2's and Ultralytics' lists, or of their frames."""
    people, order = [], order or source.order
    at = source.file if image is None else f"frame {image} of {source.file}"
    for index, entry in enumerate(entries):
        if "keypoints" not in entry and isinstance(entry.get("instances"), list):
            frame = next((as_label(entry[key]) for key in _FRAMES if key in entry), index)
            inside = objects(f"instances in {at}", entry["instances"])
            people += _instances(source, inside, frame, order)
            continue
        if "keypoints" not in entry:
            source.skipped[NO_KEYPOINTS] += 1
            continue
        where = f"person {index} in {at}"
        person = person_of(source, where, entry, "keypoints", order, ("coco17",))
        score = entry.get("score", entry.get("bbox_score"))
        if isinstance(score, list):  # of the points, or of MMPose's one box
            score = None
        # Not "width" and "height": those of an object in a list are its box's.
        width, height = canvas_size(where, entry, of_box=True)
        people.append(
            person._replace(
                image=as_label(entry.get("image_id")) if image is None else image,
                width=width,
                height=height,
                id=next((_id_of(entry[name]) for name in _IDS if name in entry), None),
                score=None if score is None else as_number(f"score of {where}", score),
            )
        )
    return people


def _id_of(value: Any) -> str | int | None:
    """AlphaPose writes a number, 3.0 or [3.0]."""
    value = value[0] if isinstance(value, list) and len(value) == 1 else value
    return int(value) if isinstance(value, float) and value.is_integer() else as_label(value)


def _category_orders(source: Source, content: Mapping[str, Any]) -> dict[Any, Order]:
    """By category, the order of the keypoints that the category names."""
    found: dict[Any, Order] = {}
    if source.layout is not None:
        return found
    categories = objects(f"categories in {source.file}", content.get("categories", []))
    for category in categories:
        names = category.get("keypoints")
        if names:
            whose = f"category {category.get('name')!r}"
            found[as_label(category.get("id"))] = source.named(names, whose)
    return found
