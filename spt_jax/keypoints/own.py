"""People in this project's own files, as JSON or as the arrays of an .npz file."""

from collections.abc import Mapping
from typing import Any

from spt_jax.keypoints.confidences import (
    CONFIDENCES,
    as_list,
    refuse_unknown_numbers,
    shape_of,
    shown,
)
from spt_jax.keypoints.entries import Order, Person, as_label
from spt_jax.keypoints.pixels import canvas_size
from spt_jax.keypoints.source import Source, person_of

#: What a list of the keypoints' names is called.
NAMES = ("names", "keypoint_names", "joint_names", "bodyparts")


def from_own(source: Source, content: Mapping[str, Any]) -> list[Person]:
    """People of this project's own files, as JSON or as the arrays of an .npz file."""
    file = source.file
    wanted = content.get("layout") if source.layout is None else source.layout
    if wanted is not None and not isinstance(wanted, str):
        raise ValueError(f"layout in {file} must be a name: got {shown(wanted)}.")
    order = None if wanted is None else Order(wanted)
    names = next((content[name] for name in NAMES if name in content), None)
    if names is not None and order is None:
        order = source.named(as_list(names), "the file")
    width, height = canvas_size(str(file), content)
    image = as_label(content.get("image"))
    people = []
    for index, entry in enumerate(_own_entries(source, content)):
        where = f"person {index} in {file}"
        key = next((k for k in ("points", "keypoints") if k in entry), "points")
        person = person_of(source, where, entry, key, order, ())
        label = as_label(entry.get("id"))
        people.append(person._replace(image=image, width=width, height=height, id=label))
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
