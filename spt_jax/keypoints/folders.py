"""Folders of OpenPose's files, one a frame."""

import re
from pathlib import Path
from typing import Any

from spt_jax.files.limits import MAX_JSON_BYTES, check_bytes, read_json
from spt_jax.keypoints.openpose import is_alphapose, is_openpose


def read_folder(folder: Path, what: str, max_bytes: int | None) -> dict[str | int, dict[str, Any]]:
    """What each .json file of a folder holds, by its name without "_keypoints".

    Names are in the order of their numbers: frame 2 before frame 10.

    Raises:
        ValueError: there is none, or one that is no frame of OpenPose's or AlphaPose's; all of them
            together are larger than the limit of one file.
    """
    files = sorted(folder.glob("*.json"), key=lambda file: _in_order(file.stem))
    if not files:
        raise ValueError(f"{what} must be a file or a folder of .json files: got none in {folder}.")
    limit = MAX_JSON_BYTES if max_bytes is None else max_bytes
    check_bytes(f"the files of {what}", folder, sum(file.stat().st_size for file in files), limit)
    frames: dict[str | int, dict[str, Any]] = {}
    for file in files:
        content = read_json(file, what, max_bytes=max_bytes)
        if not isinstance(content, dict) or not (is_openpose(content) or is_alphapose(content)):
            raise ValueError(
                f"{file} must be a frame of OpenPose's, as all files of a folder: got "
                f"{sorted(content)[:8] if isinstance(content, dict) else type(content).__name__}; "
                "give files of other kinds one by one."
            )
        frames[file.stem.removesuffix("_keypoints")] = content
    if len(frames) < len(files):
        raise ValueError(
            f"{folder} must have one file a frame: got two with and without _keypoints."
        )
    return frames


def is_sequence(folder: Path) -> bool:
    """Whether all .json files of a folder are named as OpenPose names the frames of a video.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax.keypoints.folders import is_sequence
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> _ = (folder / "walk_000000000012_keypoints.json").write_text("{}")
        >>> is_sequence(folder)
        True
    """
    names = [file.stem for file in folder.glob("*.json")] if folder.is_dir() else []
    return bool(names) and all(re.search(r"\d_keypoints$", name) for name in names)


def _in_order(name: str) -> list[tuple[int, str]]:
    return [
        (int(part), "") if part.isdigit() else (-1, part)
        for part in re.split(r"(\d+)", name)
        if part
    ]
