"""Points and their confidences, brought to one form from the many in which detectors write them."""

import math
import reprlib
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

#: What confidences are called where they stand beside the points; the first that is there is used.
CONFIDENCES = (
    *("confidence", "confidences", "keypoint_scores", "keypoints_scores", "keypoint_score"),
    *("scores", "score", "kp_score", "kp_scores", "conf", "confs"),
    *("visibility", "visible", "keypoints_visible"),
)

# Of a point or a list of them, what is no confidence.
_NO_CONFIDENCES = ("x", "y", "z", "name")

# Rounded to float32 on one side.
_SAME = 1e-5


def as_rows(
    where: str,
    values: Any,
    entry: Mapping[str, Any],
    remarks: Counter[str],
    *,
    key: str | None = None,
) -> list[Any]:
    """The numbers of one person's keypoints as one flat list x, y, confidence, x, y, ...

    Args:
        where: names the person and the file, for errors.
        values: [x, y, c, x, y, c, ...], [[x, y, c], ...], [[x, y], ...], [{"x", "y", ...}, ...] or
            {"x": [...], "y": [...], ...}.
        entry: what stands beside them; one of CONFIDENCES may be the points' confidences.
        remarks: of what is left out or assumed, which are counted up.
        key: what the values are called in the file, where `where` does not say it.

    Raises:
        ValueError: they are no such list; numbers beside them that may be confidences, under an
            unknown name; confidences in the rows and beside them that differ.
    """
    listed = where if key is None else f"{key} of {where}"
    values, entry = _without_objects(listed, values, entry)
    if not isinstance(values, list) or not values:
        raise ValueError(
            f"{listed} must be a list of x, y and confidence: got {shown(values)}; leave out a "
            "person without keypoints."
        )
    if any(isinstance(row, list) for row in values):
        rows = values
    else:
        rows = _pairs_or_triples(listed, values, entry)
    for k, row in enumerate(rows):
        if not isinstance(row, list) or len(row) not in (2, 3) or len(row) != len(rows[0]):
            raise ValueError(
                f"{listed} must have rows [x, y, confidence], or all [x, y]: got {shown(row)} for "
                f"keypoint {k}."
            )
    known = _confidences_beside(where, entry, len(rows), remarks)
    if known is None:
        if len(rows[0]) == 3:
            return [number for row in rows for number in row]
        refuse_unknown_numbers(where, entry, (len(rows),))
        remarks["people without confidences, all of whose points count in full"] += 1
        return [number for row in rows for number in (*row, 1.0)]
    name, beside = known
    for k, row in enumerate(rows):
        if len(row) == 3 and not _same(row[2], beside[k]):
            raise ValueError(
                f"{where} must have one confidence a keypoint: got {shown(row[2])} in the row of "
                f"keypoint {k} and {shown(beside[k])} in {name}; leave one of them out (a third "
                "column of depths is none)."
            )
    if "score" in name:
        beside = [_or_missing(trust, remarks) for trust in beside]
    return [number for row, trust in zip(rows, beside, strict=True) for number in (*row[:2], trust)]


def as_list(values: Any) -> Any:
    """An array as nested lists; anything else as it is."""
    return values.tolist() if isinstance(values, np.ndarray) else values


def shape_of(values: Any, axes: int = 4) -> tuple[int, ...] | None:
    """The shape of nested lists; None where they have none, or more axes than that."""
    if not isinstance(values, list) or axes == 0:
        return None
    rows = {shape_of(row, axes - 1) if isinstance(row, list) else () for row in values}
    if not rows:
        return (0,)
    inner = rows.pop()
    return None if rows or inner is None else (len(values), *inner)


def shown(value: Any) -> str:
    """A value as errors show it, cut where it is long or deep."""
    text = reprlib.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def refuse_unknown_numbers(where: str, entry: Mapping[str, Any], shape: tuple[int, ...]) -> None:
    """Refuse what may be the confidences of points that have none.

    Raises:
        ValueError: an entry of that shape whose name is not known.
    """
    for name, values in entry.items():
        numbers = as_list(values)
        if name in CONFIDENCES or _squeezed(shape_of(numbers)) != _squeezed(shape):
            continue
        if all(isinstance(number, (int, float)) for number in _flat(numbers)):
            raise ValueError(
                f"{where} must have confidences under a known name: got one number a keypoint in "
                f"{name!r}; call it confidence if it is that, and leave it out if not."
            )


def _confidences_beside(
    where: str, entry: Mapping[str, Any], count: int, remarks: Counter[str]
) -> tuple[str, list[Any]] | None:
    """The name and the list of the confidences in an entry; None without any."""
    found = {
        name: as_list(entry[name])
        for name in CONFIDENCES
        if isinstance(entry.get(name), (list, np.ndarray))
    }
    if shape_of(found.get("score")) == (1,) != (count,):
        del found["score"]  # the detector's, of the whole person
    for name, values in found.items():
        if _squeezed(shape_of(values)) != _squeezed((count,)):
            raise ValueError(
                f"{name} of {where} must have one number a keypoint, {count}: got "
                f"{shown(shape_of(values) or values)}."
            )
    flat = {name: _flat(values) for name, values in found.items()}
    if not flat:
        return None
    name, *others = flat
    for other in others:
        if not all(_same(a, b) for a, b in zip(flat[other], flat[name], strict=True)):
            remarks[f"numbers in {other}, which are not used beside {name}"] += count
    return name, flat[name]


def _without_objects(
    where: str, values: Any, entry: Mapping[str, Any]
) -> tuple[Any, Mapping[str, Any]]:
    """Points given as objects, as lists; and where their confidences are."""
    values = as_list(values)
    if isinstance(values, dict):  # Ultralytics
        entry, columns = values, [values.get("x"), values.get("y")]
        sizes = [len(column) if isinstance(column, list) else None for column in columns]
        if None in sizes or sizes[0] != sizes[1]:
            raise ValueError(
                f"{where} must have lists x and y of one length: got {shown(values)}; a list of "
                "[x, y, confidence] will do as well."
            )
        beside = {name: value for name, value in entry.items() if name not in _NO_CONFIDENCES}
        return [list(row) for row in zip(*columns, strict=True)], beside
    if isinstance(values, list) and values and all(isinstance(row, dict) for row in values):
        for k, row in enumerate(values):
            if not {"x", "y"} <= set(row) or set(row) - {"name"} != set(values[0]) - {"name"}:
                raise ValueError(
                    f"{where} must have x and y in each of its objects, and the same entries: got "
                    f"{shown(row)} for keypoint {k}."
                )
        names = [name for name in values[0] if name not in _NO_CONFIDENCES]
        beside = {name: [row[name] for row in values] for name in names}
        return [[row["x"], row["y"]] for row in values], {**entry, **beside}
    return values, entry


def _pairs_or_triples(where: str, values: list[Any], entry: Mapping[str, Any]) -> list[list[Any]]:
    shapes = [shape_of(as_list(entry.get(name))) for name in CONFIDENCES]
    counts = {math.prod(shape) for shape in shapes if shape is not None}
    width = 2 if len(values) % 2 == 0 and len(values) // 2 in counts else 3
    if len(values) % width:
        raise ValueError(
            f"{where} must have three numbers a keypoint, x, y and confidence: got "
            f"{len(values)} numbers; the list is cut or of another kind."
        )
    return [values[k : k + width] for k in range(0, len(values), width)]


def _or_missing(score: Any, remarks: Counter[str]) -> Any:
    """Logits of MMPose's SimCC heads fall below 0 where they see nothing."""
    if isinstance(score, (int, float)) and score < 0:
        remarks["points with a score below 0, taken as missing"] += 1
        return 0.0
    return score


def _flat(values: Any) -> list[Any]:
    if not isinstance(values, list):
        return [values]
    return [number for row in values for number in _flat(row)]


def _squeezed(shape: tuple[int, ...] | None) -> tuple[int, ...] | None:
    return None if shape is None else tuple(size for size in shape if size != 1)


def _same(one: Any, other: Any) -> bool:
    if one == other or not all(isinstance(value, (int, float)) for value in (one, other)):
        return one == other
    try:
        return math.isclose(one, other, rel_tol=_SAME, abs_tol=_SAME)
    except OverflowError:
        return False
