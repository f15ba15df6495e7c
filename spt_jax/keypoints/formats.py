"""People in the JSON of COCO, of detectors, and of this project's own."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from spt_jax.keypoints.confidences import (
    CONFIDENCES,
    as_list,
    as_rows,
    refuse_unknown_numbers,
    shape_of,
    shown,
)
from spt_jax.keypoints.entries import Person, as_label, as_number, as_points, as_size, choose_layout
from spt_jax.keypoints.layouts import LAYOUTS
from spt_jax.keypoints.pixels import canvas_size

ACCEPTED = (
    'COCO annotations ({"images", "annotations", "categories"}), COCO results ([{"image_id", '
    '"keypoints", "score"}, ...]), what MMPose, AlphaPose, Detectron2 and Ultralytics write, '
    'OpenPose ({"people": [{"pose_keypoints_2d"}, ...]}), or '
    '{"layout", "people": [[[x, y, confidence], ...], ...]}'
)

NO_KEYPOINTS = "no keypoints"
NO_VISIBLE_POINT = "no visible point"
CROWD = "crowd"

# Beside the body's, as COCO-WholeBody, OpenPose and MediaPipe call them.
_OTHER_POINTS = (
    *("foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts"),
    *("face_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d"),
    *("foot_keypoints_2d", "pose_keypoints_3d", "face_keypoints_3d"),
    *("hand_left_keypoints_3d", "hand_right_keypoints_3d"),
)
_FRAMES = ("frame_id", "frame_index", "frame_idx", "image_id")


class Source(NamedTuple):
    """A file that is being read.

    Attributes:
        file: its path, for errors.
        layout: what the caller says that the keypoints are, or None.
        skipped: how many people were left out, by reason.
        remarks: how many points, people or numbers are not used or not used as they stand, by what
            became of them.
    """

    file: Path
    layout: str | None
    skipped: Counter[str]
    remarks: Counter[str]


def from_annotations(source: Source, content: Mapping[str, Any]) -> list[Person]:
    """People of COCO's annotations."""
    file, skipped = source.file, source.skipped
    images = {}
    for index, image in enumerate(objects(f"images in {file}", content.get("images", []))):
        where = f"image {index} in {file}"
        size = tuple(as_size(f"{key} of {where}", image.get(key)) for key in ("width", "height"))
        label = as_label(image.get("file_name"))
        images[as_label(image.get("id"))] = (label, *size)
    layouts = _category_layouts(source, content)
    people = []
    annotations = objects(f"annotations in {file}", content["annotations"])
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
            wanted = layouts.get(as_label(entry.get("category_id")), source.layout)
            image_id = as_label(entry.get("image_id"))
            image, width, height = images.get(image_id, (None, None, None))
            image = image_id if image is None else image
            person = _person(source, where, entry, "keypoints", wanted, ("coco17",), flags=True)
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
    if isinstance(names, dict) and source.layout is None:
        names = [names.get(str(k)) for k in range(len(names))]
        source = source._replace(layout=_layout_of_names(source, names, "MMPose's meta_info"))
    return _instances(
        source, objects(f"instance_info in {source.file}", content["instance_info"]), None
    )


def from_openpose(
    source: Source, content: Mapping[str, Any], frame: int | None = None
) -> list[Person]:
    """People of OpenPose's JSON, and of ControlNet's, which tells the canvas."""
    at = f"{source.file}" if frame is None else f"frame {frame} of {source.file}"
    width, height = canvas_size(at, content)
    people = []
    for index, entry in enumerate(objects(f"people in {at}", content["people"])):
        where = f"person {index} in {at}"
        if not entry.get("pose_keypoints_2d"):  # a face or a hand alone
            _count_other_points(source, entry)
            source.skipped[NO_KEYPOINTS] += 1
            continue
        usual = ("body25", "openpose18")
        person = _person(source, where, entry, "pose_keypoints_2d", source.layout, usual)
        label = entry.get("person_id")  # [-1] where OpenPose did not track
        label = label[0] if isinstance(label, list) and label and label != [-1] else None
        place = {"image": frame, "width": width, "height": height, "id": as_label(label)}
        people.append(person._replace(**place))
    return people


def from_own(source: Source, content: Mapping[str, Any]) -> list[Person]:
    """People of this project's own files, as JSON or as the arrays of an .npz file."""
    file = source.file
    wanted = content.get("layout") if source.layout is None else source.layout
    if wanted is not None and not isinstance(wanted, str):
        raise ValueError(f"layout in {file} must be a name: got {shown(wanted)}.")
    width, height = canvas_size(str(file), content)
    image = as_label(content.get("image"))
    people = []
    for index, entry in enumerate(_own_entries(source, content)):
        where = f"person {index} in {file}"
        key = next((k for k in ("points", "keypoints") if k in entry), "points")
        person = _person(source, where, entry, key, wanted, ())
        label = as_label(entry.get("id"))
        people.append(person._replace(image=image, width=width, height=height, id=label))
    return people


def is_openpose(content: Mapping[str, Any]) -> bool:
    """Whether it is a frame of OpenPose's."""
    people = content.get("people")
    if not isinstance(people, list):
        return False
    named = any(isinstance(person, dict) and "pose_keypoints_2d" in person for person in people)
    # An image without people has an empty list and OpenPose's version.
    return named or (not people and "layout" not in content)


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


def _person(
    source: Source,
    where: str,
    entry: Mapping[str, Any],
    key: str,
    wanted: str | None,
    usual: tuple[str, ...],
    *,
    flags: bool = False,
) -> Person:
    _count_other_points(source, entry)
    values = entry.get(key)
    if flags and isinstance(values, list) and (shape_of(values) or (0,))[-1] == 2:
        raise ValueError(
            f"{where} must have x, y and COCO's v a keypoint: got rows of two numbers."
        )
    if isinstance(values, list) and wanted is None and values and isinstance(values[0], dict):
        names = [point.get("name") for point in values if isinstance(point, dict)]
        wanted = _layout_of_names(source, names, where) if any(names) else None
    flat = as_rows(where, values, entry, source.remarks)
    layout, flat = choose_layout(where, flat, wanted, usual, source.remarks)
    points, confidence = as_points(where, flat, layout, source.remarks, flags=flags)
    return Person(points, confidence, layout.name)


def _instances(
    source: Source, entries: list[dict[str, Any]], image: str | int | None
) -> list[Person]:
    """People of MMPose's, AlphaPose's, Detectron2's and Ultralytics' lists, or of their frames."""
    people = []
    at = source.file if image is None else f"frame {image} of {source.file}"
    for index, entry in enumerate(entries):
        if "keypoints" not in entry and isinstance(entry.get("instances"), list):
            frame = next((as_label(entry[key]) for key in _FRAMES if key in entry), index)
            people += _instances(source, objects(f"instances in {at}", entry["instances"]), frame)
            continue
        if "keypoints" not in entry:
            source.skipped[NO_KEYPOINTS] += 1
            continue
        where = f"person {index} in {at}"
        person = _person(source, where, entry, "keypoints", source.layout, ("coco17",))
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
                id=as_label(entry.get("id")),
                score=None if score is None else as_number(f"score of {where}", score),
            )
        )
    return people


def _own_entries(source: Source, content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """One entry a person: its points, and what of the file's confidences is its own."""
    key = next(key for key in ("people", "points", "keypoints") if key in content)
    entries = as_list(content[key])
    shape = shape_of(entries)
    if key == "points" or (key == "keypoints" and shape is not None and len(shape) < 3):
        return [{**content, "points": entries}]
    if not isinstance(entries, list):
        raise ValueError(f"{key} in {source.file} must be a list: got {type(entries).__name__}.")
    rows: list[Mapping[str, Any]] = [
        entry if isinstance(entry, dict) else {"points": entry} for entry in entries
    ]
    beside = {name: as_list(content[name]) for name in CONFIDENCES if name in content}
    beside = {name: values for name, values in beside.items() if isinstance(values, list)}
    if not beside and shape is not None and len(shape) == 3 and shape[2] == 2:
        refuse_unknown_numbers(f"people in {source.file}", content, shape[:2])
    for name, values in beside.items():
        if len(rows) == 1 and len(values) != 1:
            values = [values]
        if len(values) != len(rows) or any(name in row for row in rows):
            raise ValueError(
                f"{name} in {source.file} must have one list a person and stand in one place: got "
                f"{len(values)} for {len(rows)} people."
            )
        rows = [{**row, name: own} for row, own in zip(rows, values, strict=True)]
    return rows


def _count_other_points(source: Source, entry: Mapping[str, Any]) -> None:
    for name in _OTHER_POINTS:
        values = entry.get(name)
        if not isinstance(values, list) or not values:
            continue
        nested = isinstance(values[0], list)
        width = 4 if name.endswith("_3d") else 3
        rows = values if nested else [values[k : k + width] for k in range(0, len(values), width)]
        count = sum(1 for row in rows if isinstance(row, list) and any(row))
        if count:
            source.remarks[f"points in {name}, which are not used"] += count


def _category_layouts(source: Source, content: Mapping[str, Any]) -> dict[Any, str]:
    """By category, the layout whose names the category lists."""
    found: dict[Any, str] = {}
    if source.layout is not None:
        return found
    categories = objects(f"categories in {source.file}", content.get("categories", []))
    for category in categories:
        names = category.get("keypoints")
        if names:
            whose = f"category {category.get('name')!r}"
            found[as_label(category.get("id"))] = _layout_of_names(source, names, whose)
    return found


def _layout_of_names(source: Source, names: Any, whose: str) -> str:
    listed = tuple(names) if isinstance(names, list) else names
    coco = LAYOUTS["coco17"].names
    for known in LAYOUTS.values():
        if listed in (known.names, known.official):
            return known.name
    if isinstance(listed, tuple) and listed[: len(coco)] == coco:
        return "coco17"
    raise ValueError(
        f"{source.file} must list its keypoints in a known order: got {shown(names)} for {whose}; "
        f"where it is one of {', '.join(LAYOUTS)} under other names, give it as layout."
    )
