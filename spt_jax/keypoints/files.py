"""Keypoint files: COCO's annotations and results, OpenPose's, and this project's own."""

import math
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from spt_jax.files.archives import read_npz
from spt_jax.files.limits import MAX_JSON_BYTES, as_file, read_bytes, read_json
from spt_jax.keypoints.coco import from_annotations, from_mmpose, from_results
from spt_jax.keypoints.confidences import CONFIDENCES
from spt_jax.keypoints.deeplabcut import from_deeplabcut
from spt_jax.keypoints.entries import Person
from spt_jax.keypoints.folders import read_folder
from spt_jax.keypoints.openpose import (
    are_frames,
    from_frames,
    from_openpose,
    is_alphapose,
    is_openpose,
)
from spt_jax.keypoints.own import NAMES, from_own
from spt_jax.keypoints.pixels import SIZES, in_pixels
from spt_jax.keypoints.source import ACCEPTED, NO_VISIBLE_POINT, Source

_WHAT = "keypoint file"
_KNOWN = {
    *("keypoints", "layout", "image", *CONFIDENCES, *NAMES),
    *(name for pair in SIZES for name in pair),
}


class KeypointFile(NamedTuple):
    """What a keypoint file holds.

    Attributes:
        people: those with at least one visible point, in the file's order.
        width, height: of the image in pixels, where the file knows it and all people share it.
        skipped: how many were left out, by reason: "no visible point", "no keypoints" (a box or an
            outline alone) or "crowd" (COCO's outlines of many people).
        notes: what of the file is not used or not used as it stands, one line each: points of
            the face and of unknown names, points at (0, 0), confidences above 1, points scaled to
            pixels.
    """

    people: list[Person]
    width: int | None
    height: int | None
    skipped: dict[str, int]
    notes: tuple[str, ...] = ()


def read_keypoints(
    path: str | os.PathLike[str],
    *,
    layout: str | None = None,
    map: Mapping[str, str] | None = None,
    max_bytes: int | None = None,
) -> KeypointFile:
    """The people of a file of 2D keypoints.

    Formats, recognized by their content:

    - COCO annotations: a JSON object with `annotations`. v = 0 is missing, v = 1 (labelled but
      hidden) has confidence 0.5, v = 2 has 1. Crowds and people without a labelled point are
      skipped and counted. Feet and hands of COCO-WholeBody (`foot_kpts`, `lefthand_kpts`,
      `righthand_kpts`) are read where anybody has any.
    - COCO results, and the lists that MMPose, AlphaPose, Detectron2 and Ultralytics write: a JSON
      list of objects with `keypoints`, or of frames with `instances`; MMPose's `instance_info`.
    - OpenPose: a JSON object with `people`, each with `pose_keypoints_2d` of 25 or 18 keypoints,
      and with hands where anybody's were seen; or a list of them, as ControlNet writes; AlphaPose's
      two forms of it, with `people` or `bodies`, one frame or all by the names of their images.
      A folder of such files is a sequence, one frame a file, in the order of their numbers.
    - DeepLabCut: a .csv table with one row a frame, of one or several individuals.
    - This project's: a JSON object with `layout` or `names` and `people`, a list of [x, y] or
      [x, y, confidence] each, or `points` for one person; `width` and `height` beside them. Or an
      .npz file with `keypoints` (N, K, 2 or 3) or (K, 2 or 3), and where wanted `confidence`
      (N, K) or (K,), `layout` or `names`, `width` and `height`; nothing is unpickled.

    Where a file names its keypoints they are read by their names, in the words of Human3.6M, COCO,
    OpenPose, MPII, AI Challenger, CrowdPose, PoseTrack, JHMDB, Human-Art, MediaPipe, SMPL and the
    like, in any order; `map` says what others are. Without names, COCO's 17 points are expected, or
    23, 26, 133 or 136 that begin with them: feet, Halpe's and whole bodies. Confidences are the
    third number of a point, or stand beside the points as `confidence`, `keypoint_scores` (MMPose),
    `scores` (rtmlib), `visible` (Ultralytics) or the like; one number a point under another name is
    refused. A point with confidence 0 or at (0, 0) is missing. Confidences above 1, which some
    detectors give, become 1. Points that all lie in 0..1 are shares of the image's size: they are
    scaled where the file states it, and refused where not. Points of the face but for nose, eyes
    and ears are not used. `notes` says what was left out or changed.

    Args:
        path: the file, .json, .npz or .csv, or a folder of OpenPose's files.
        layout: the keypoints' order, a key of `spt_jax.keypoints.LAYOUTS`, "smpl", or names with
            commas between them, for a file that does not say or says otherwise.
        map: by this package's names, what the file calls keypoints of other names:
            `{"left_wrist": "paw_l"}`.
        max_bytes: how large the file may be, and its arrays once unpacked; None for 256 MiB of JSON
            and 1 GiB of arrays.

    Returns:
        A KeypointFile; its list of people is empty where nobody has a visible point.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such file, is cut, damaged or larger than the limit, has another number
            of keypoints than its layout, or an entry is no finite number or impossible; the message
            names the file, the person, counted from 0, and the entry.

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
    file = Path(path) if os.path.isdir(path) else as_file(path, _WHAT)
    if map and layout is not None:
        raise ValueError("map must be left out where a layout is given: it says what names mean.")
    source = Source(file, layout, map or {}, Counter(), Counter())
    people = _people(source, max_bytes)
    people = in_pixels(file, people, source.remarks)
    visible = [person for person in people if person.confidence.any()]
    if len(visible) < len(people):
        source.skipped[NO_VISIBLE_POINT] += len(people) - len(visible)
    sizes = {(person.width, person.height) for person in people}
    width, height = sizes.pop() if len(sizes) == 1 else (None, None)
    notes = tuple(f"{what}: {count}" for what, count in source.remarks.items())
    return KeypointFile(visible, width, height, dict(source.skipped), notes)


def _people(source: Source, max_bytes: int | None) -> list[Person]:
    if source.file.is_dir():
        return from_frames(source, read_folder(source.file, _WHAT, max_bytes))
    if source.file.suffix.lower() == ".csv":
        limit = MAX_JSON_BYTES if max_bytes is None else max_bytes
        return from_deeplabcut(source, read_bytes(source.file, _WHAT, max_bytes=limit))
    if source.file.suffix.lower() == ".npz":
        return from_own(source, _read_npz(source.file, max_bytes))
    content = read_json(source.file, _WHAT, max_bytes=max_bytes)
    if isinstance(content, list):
        if content and all(isinstance(entry, dict) and is_openpose(entry) for entry in content):
            if len(content) == 1:
                return from_openpose(source, content[0])
            return from_frames(source, dict(enumerate(content)))
        return from_results(source, content)
    if isinstance(content, dict):
        if "annotations" in content:
            return from_annotations(source, content)
        if "instance_info" in content:
            return from_mmpose(source, content)
        if is_openpose(content) or is_alphapose(content):
            return from_openpose(source, content)
        if are_frames(content):
            return from_frames(source, content)
        if {"people", "points", "keypoints"} & set(content):
            return from_own(source, content)
    seen = sorted(content)[:8] if isinstance(content, dict) else type(content).__name__
    raise ValueError(f"{source.file} must hold {ACCEPTED}: got {seen}.")


def _read_npz(file: Path, max_bytes: int | None) -> dict[str, Any]:
    arrays, names = read_npz(file, _KNOWN.__contains__, _WHAT, max_bytes=max_bytes)
    if "keypoints" not in arrays:
        raise ValueError(
            f"{file} must hold keypoints, (N, K, 2 or 3) or (K, 2 or 3), and optionally "
            f"confidence, layout, width, height: got {', '.join(sorted(names)) or 'nothing'}."
        )
    rows = arrays["keypoints"]
    if rows.ndim not in (2, 3) or rows.shape[-1] not in (2, 3):
        raise ValueError(
            f"keypoints in {file} must have shape (N, K, 2 or 3) or (K, 2 or 3): got {rows.shape}."
        )
    for name in ("keypoints", *(name for name in CONFIDENCES if name in arrays)):
        if arrays[name].dtype.kind not in "iuf":
            kind = arrays[name].dtype
            raise ValueError(f"{name} in {file} must be real numbers: got dtype {kind}.")
    for name in set(names) - _KNOWN:  # it may hold one number a keypoint, and then it is refused
        try:
            array = read_npz(file, {name}.__contains__, _WHAT, max_bytes=max_bytes).arrays[name]
        except ValueError:  # objects, and whatever else is no array of numbers
            continue
        if array.size == math.prod(rows.shape[:-1]) and array.dtype.kind in "iuf":
            arrays[name] = array
    return {
        name: array.item() if array.size == 1 and name not in CONFIDENCES else array.tolist()
        for name, array in arrays.items()
    }
