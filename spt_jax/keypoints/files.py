"""Keypoint files: COCO's annotations and results, OpenPose's, and this project's own."""

import json
import os
import zipfile
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .entries import Person, as_label, as_number, as_points, as_rows, as_size, choose_layout
from .layouts import LAYOUTS

_ACCEPTED = (
    'COCO annotations ({"images", "annotations", "categories"}), COCO results ([{"image_id", '
    '"keypoints", "score"}, ...]), OpenPose ({"people": [{"pose_keypoints_2d"}, ...]}), or '
    '{"layout", "people": [[[x, y, confidence], ...], ...]}'
)

# What NumPy and zipfile raise on archives that are cut, damaged, pickled or packed in unknown ways.
_DAMAGE = (
    *(OSError, ValueError, EOFError, NotImplementedError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)

NO_KEYPOINTS = "no keypoints"
NO_VISIBLE_POINT = "no visible point"
CROWD = "crowd"


class KeypointFile(NamedTuple):
    """What a keypoint file holds.

    Attributes:
        people: those with at least one visible point, in the file's order.
        width, height: of the image in pixels, where the file knows it and all people share it.
        skipped: how many were left out, by reason: "no visible point", "no keypoints" (a box or an
            outline alone) or "crowd" (COCO's outlines of many people).
    """

    people: list[Person]
    width: int | None
    height: int | None
    skipped: dict[str, int]


def read_keypoints(path: str | os.PathLike[str], *, layout: str | None = None) -> KeypointFile:
    """The people of a file of 2D keypoints.

    Formats, told apart by what they hold:

    - COCO annotations: a JSON object with `annotations`. v = 0 is missing, v = 1 (labelled but
      hidden) has confidence 0.5, v = 2 has 1. Crowds and people without a labelled point are
      skipped and counted.
    - COCO results: a JSON list of objects with `keypoints`; the third number is a confidence.
    - OpenPose: a JSON object with `people`, each with `pose_keypoints_2d` of 25 or 18 keypoints.
    - This project's: a JSON object with `layout` and `people`, a list of [x, y] or [x, y,
      confidence] each, or `points` for one person; `width` and `height` beside them. Or an .npz
      file with `keypoints` (N, K, 2 or 3) or (K, 2 or 3), and where wanted `confidence` (N, K) or
      (K,), `layout`, `width` and `height`; nothing is unpickled.

    A point with confidence 0 is missing, and its place is not used. Confidences above 1, which some
    detectors give, become 1.

    Args:
        path: the file, .json or .npz.
        layout: the keypoints' order, a key of `spt_jax.keypoints.LAYOUTS` or "smpl", for a file
            that does not say or says otherwise.

    Returns:
        A KeypointFile; its list of people is empty where nobody has a visible point.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such file, is cut or damaged, has another number of keypoints than its
            layout, or an entry is no finite number or impossible; the message names the file, the
            person, counted from 0, and the entry.

    Example:
        >>> import json, pathlib, tempfile
        >>> from spt_jax.keypoints import read_keypoints
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "walk_keypoints.json"
        >>> person = {"pose_keypoints_2d": [320, 240, 0.9] * 24 + [0, 0, 0]}
        >>> _ = path.write_text(json.dumps({"people": [person]}))
        >>> (person,) = read_keypoints(path).people
        >>> person.layout, person.points[0].tolist(), float(person.confidence[24])
        ('body25', [320.0, 240.0], 0.0)
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"keypoint file must exist: got {str(path)!r}; check the spelling.")
    if not file.is_file():
        raise ValueError(f"keypoint file must be a file: got {str(path)!r}, a folder.")
    skipped: Counter[str] = Counter()
    if file.suffix.lower() == ".npz":
        people = _from_npz(file, layout)
    else:
        content = _read_json(file)
        if isinstance(content, list):
            people = _from_results(file, content, layout, skipped)
        elif isinstance(content, dict) and "annotations" in content:
            people = _from_annotations(file, content, layout, skipped)
        elif isinstance(content, dict) and _is_openpose(content):
            people = _from_openpose(file, content, layout, skipped)
        elif isinstance(content, dict) and ("people" in content or "points" in content):
            people = _from_own(file, content, layout)
        else:
            seen = sorted(content)[:8] if isinstance(content, dict) else type(content).__name__
            raise ValueError(f"{file} must hold {_ACCEPTED}: got {seen}.")
    visible = [person for person in people if person.confidence.any()]
    if len(visible) < len(people):
        skipped[NO_VISIBLE_POINT] += len(people) - len(visible)
    sizes = {(person.width, person.height) for person in people}
    width, height = sizes.pop() if len(sizes) == 1 else (None, None)
    return KeypointFile(visible, width, height, dict(skipped))


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{file} must be JSON text or an .npz file: got bytes that are no text at position "
            f"{error.start}."
        ) from error
    except json.JSONDecodeError as error:
        raise ValueError(
            f"{file} must be JSON: got {error.msg} at line {error.lineno}, column {error.colno}; "
            "it is cut or damaged."
        ) from error
    except (ValueError, RecursionError) as error:  # an integer of thousands of digits; [[[[...
        raise ValueError(f"{file} must be JSON: got {error}; it is damaged.") from error


def _from_annotations(
    file: Path, content: dict[str, Any], layout: str | None, skipped: Counter[str]
) -> list[Person]:
    images = {}
    for index, image in enumerate(_objects(f"images in {file}", content.get("images", []))):
        where = f"image {index} in {file}"
        size = tuple(as_size(f"{key} of {where}", image.get(key)) for key in ("width", "height"))
        label = as_label(image.get("file_name"))
        images[as_label(image.get("id"))] = (label, *size)
    layouts = _category_layouts(file, content, layout)
    people = []
    annotations = _objects(f"annotations in {file}", content["annotations"])
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
            flat = as_rows(where, entry["keypoints"])
            wanted = layouts.get(as_label(entry.get("category_id")), layout)
            order = choose_layout(where, flat, wanted, ("coco17",))
            points, confidence = as_points(where, flat, order, flags=True)
            image_id = as_label(entry.get("image_id"))
            image, width, height = images.get(image_id, (None, None, None))
            image = image_id if image is None else image
            people.append(Person(points, confidence, order.name, image, width, height, label))
    if annotations and skipped[NO_KEYPOINTS] == len(annotations):
        raise ValueError(
            f"{file} must have keypoints: got {len(annotations)} annotations without any; COCO's "
            "are in person_keypoints_*.json, not in instances_*.json."
        )
    return people


def _category_layouts(file: Path, content: dict[str, Any], layout: str | None) -> dict[Any, str]:
    """By category, the layout whose names the category lists."""
    found: dict[Any, str] = {}
    if layout is not None:
        return found
    for category in _objects(f"categories in {file}", content.get("categories", [])):
        names = category.get("keypoints")
        if not names:
            continue
        names = tuple(names) if isinstance(names, list) else names
        for known in LAYOUTS.values():
            if names in (known.names, known.official):
                found[as_label(category.get("id"))] = known.name
                break
        else:
            raise ValueError(
                f"{file} must list its keypoints in a known order: got {names!r} for category "
                f"{category.get('name')!r}; where it is one of {', '.join(LAYOUTS)} under other "
                "names, give it as layout."
            )
    return found


def _from_results(
    file: Path, content: list[Any], layout: str | None, skipped: Counter[str]
) -> list[Person]:
    people = []
    for index, entry in enumerate(_objects(str(file), content)):
        if "keypoints" not in entry:
            skipped[NO_KEYPOINTS] += 1
            continue
        where = f"person {index} in {file}"
        flat = as_rows(where, entry["keypoints"])
        order = choose_layout(where, flat, layout, ("coco17",))
        points, confidence = as_points(where, flat, order)
        score = entry.get("score")
        people.append(
            Person(
                points,
                confidence,
                order.name,
                as_label(entry.get("image_id")),
                id=as_label(entry.get("id")),
                score=None if score is None else as_number(f"score of {where}", score),
            )
        )
    if content and not people:
        raise ValueError(
            f"{file} must hold {_ACCEPTED}: got a list of {len(content)} objects without keypoints."
        )
    return people


def _is_openpose(content: dict[str, Any]) -> bool:
    people = content.get("people")
    if not isinstance(people, list):
        return False
    named = any(isinstance(person, dict) and "pose_keypoints_2d" in person for person in people)
    # An image without people has an empty list and OpenPose's version.
    return named or (not people and "layout" not in content)


def _from_openpose(
    file: Path, content: dict[str, Any], layout: str | None, skipped: Counter[str]
) -> list[Person]:
    people = []
    for index, entry in enumerate(_objects(f"people in {file}", content["people"])):
        if not entry.get("pose_keypoints_2d"):  # a face or a hand alone
            skipped[NO_KEYPOINTS] += 1
            continue
        where = f"person {index} in {file}"
        flat = as_rows(where, entry["pose_keypoints_2d"])
        order = choose_layout(where, flat, layout, ("body25", "openpose18"))
        points, confidence = as_points(where, flat, order)
        label = entry.get("person_id")  # [-1] where OpenPose did not track
        label = label[0] if isinstance(label, list) and label and label != [-1] else None
        people.append(Person(points, confidence, order.name, id=as_label(label)))
    return people


def _from_own(file: Path, content: dict[str, Any], layout: str | None) -> list[Person]:
    wanted = content.get("layout") if layout is None else layout
    if wanted is not None and not isinstance(wanted, str):
        raise ValueError(f"layout in {file} must be a name: got {wanted!r}.")
    size = [as_size(f"{key} in {file}", content.get(key)) for key in ("width", "height")]
    entries = [content["points"]] if "people" not in content else content["people"]
    if not isinstance(entries, list):
        raise ValueError(f"people in {file} must be a list: got {type(entries).__name__}.")
    people = []
    for index, entry in enumerate(entries):
        where = f"person {index} in {file}"
        label = None
        if isinstance(entry, dict):
            label = as_label(entry.get("id"))
            entry = entry.get("points", entry.get("keypoints"))
        flat = as_rows(where, entry)
        order = choose_layout(where, flat, wanted, ())
        points, confidence = as_points(where, flat, order)
        image = as_label(content.get("image"))
        people.append(Person(points, confidence, order.name, image, *size, id=label))
    return people


def _from_npz(file: Path, layout: str | None) -> list[Person]:
    names = ("keypoints", "confidence", "layout", "width", "height")
    if not zipfile.is_zipfile(file):  # np.load would take it for a pickle, and say only that
        raise ValueError(f"{file} must be an .npz archive: got other bytes; it is cut or damaged.")
    try:
        with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in names if name in archive.files}
            keys = sorted(archive.files)
    except (
        OSError,
        ValueError,
        EOFError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(f"{file} must be an .npz file of numbers: got {error}.") from error
    if "keypoints" not in arrays:
        raise ValueError(
            f"{file} must hold keypoints, (N, K, 2 or 3) or (K, 2 or 3), and optionally "
            f"{', '.join(names[1:])}: got {', '.join(keys) or 'nothing'}."
        )
    rows = arrays["keypoints"]
    rows = rows[None] if rows.ndim == 2 else rows
    confidence = arrays.get("confidence")
    if rows.ndim != 3 or rows.shape[2] not in (2, 3):
        raise ValueError(
            f"keypoints in {file} must have shape (N, K, 2 or 3) or (K, 2 or 3): got "
            f"{arrays['keypoints'].shape}."
        )
    for name, array in (("keypoints", rows), ("confidence", confidence)):
        if array is not None and array.dtype.kind not in "iuf":
            raise ValueError(f"{name} in {file} must be real numbers: got dtype {array.dtype}.")
    if confidence is not None:
        if confidence.size != rows.shape[0] * rows.shape[1]:
            raise ValueError(
                f"confidence in {file} must have one number a keypoint, {rows.shape[:2]}: got "
                f"{confidence.shape}."
            )
        confidence = confidence.reshape(*rows.shape[:2], 1)
        rows = np.concatenate([rows[..., :2], confidence], axis=2)
    content: dict[str, Any] = {"people": rows.tolist()}
    for name in names[2:]:
        if name in arrays:
            content[name] = arrays[name].item() if arrays[name].size == 1 else arrays[name].tolist()
    return _from_own(file, content, layout)


def _objects(where: str, value: Any) -> list[dict[str, Any]]:
    if not isinstance(value, list):
        raise ValueError(f"{where} must be a list: got {type(value).__name__}.")
    for index, entry in enumerate(value):
        if not isinstance(entry, dict):
            raise ValueError(
                f"{where} must be a list of objects: got {type(entry).__name__} at entry {index}."
            )
    return value
