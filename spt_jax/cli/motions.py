"""What of a pose file is asked for, and how its motions are written when they are done."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.cli.frames import Motion
from spt_jax.io.pose_files import MotionFile, Track, choose, open_poses, write_poses


class HasPose(Protocol):
    """What was done of a frame."""

    @property
    def pose(self) -> Any:
        """Axis-angle of each joint."""


@dataclass(frozen=True, eq=False)
class Chosen:
    """What of a pose file was asked for.

    Attributes:
        file: the file.
        tracks: the people.
        rows: of each of the frames asked for, which track and which of its frames it is.
    """

    file: MotionFile
    tracks: tuple[Track, ...]
    rows: tuple[tuple[int, int], ...]

    @property
    def names(self) -> list[str]:
        """Of the frames asked for."""
        return [self.tracks[k].names[row] for k, row in self.rows]

    @property
    def num_shape(self) -> int:
        """How many shape components the body should have."""
        shapes = [track.shape.shape[-1] for track in self.tracks if track.shape is not None]
        return max([10, *shapes])

    @property
    def num_expression(self) -> int:
        """How many expressions the body should have: none where the file has none."""
        faces = [track.expression for track in self.tracks if track.expression is not None]
        return max([0, *(face.shape[-1] for face in faces if face.any())])


def chosen(path: Path, people: str, frames: str, max_bytes: int | None) -> Chosen:
    """The people and frames asked for of a pose file.

    Args:
        path: the file.
        people: "all", or names and numbers from 0, separated by commas.
        frames: "all", or numbers from 0, ranges and names, separated by commas.
        max_bytes: as in `load_poses`.

    Raises:
        ValueError, OSError: as `load_poses`; nobody or no frame of that name.
    """
    file = open_poses(path, max_bytes=max_bytes)
    wanted = None if people == "all" else [one.strip() for one in people.split(",")]
    tracks = tuple(choose(file, wanted))
    places = [(k, row) for k, track in enumerate(tracks) for row in range(len(track.pose))]
    rows = select_frames([tracks[k].names[row] for k, row in places], frames)
    return Chosen(file, tracks, tuple(places[row] for row in rows))


def select_frames(names: Sequence[str], wanted: str) -> list[int]:
    """Rows of the frames asked for, in that order, each once; all of them for "all".

    Raises:
        ValueError: something that is neither a name, nor a row, nor a range of rows.
    """
    if wanted == "all":
        return list(range(len(names)))
    rows: list[int] = []
    for item in map(str.strip, wanted.split(",")):
        ends = re.fullmatch(r"(\d+)(?:-(\d+))?", item)
        if item in names:
            rows.append(names.index(item))
            continue
        first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
        if not first <= last < len(names):
            raise ValueError(
                f"frames must be rows 0 to {len(names) - 1}, ranges of them or names such as "
                f"{names[0]!r}: got {item!r}; separate several by commas."
            )
        rows += range(first, last + 1)
    return list(dict.fromkeys(rows))


def rows_by_track(asked: Chosen) -> list[tuple[int, list[int]]]:
    """The frames asked for of each track, in the order of the tracks."""
    found: dict[int, list[int]] = {}
    for k, row in asked.rows:
        found.setdefault(k, []).append(row)
    return sorted(found.items())


def write_motions(
    folder: Path, done: Sequence[HasPose], motion: Motion, asked: Chosen
) -> list[str]:
    """Write the untangled poses in AMASS' layout, a file a person; return the files' names.

    Shape, expression, translation and gender come along, and the frame rate where the frames follow
    each other.
    """
    written = []
    places = {place: k for k, place in enumerate(asked.rows)}
    labels = [re.sub(r"[^\w.-]+", "_", track.name) or "person" for track in asked.tracks]
    for k, rows in rows_by_track(asked):
        track, order = asked.tracks[k], [places[k, row] for row in rows]
        label = labels[k] if labels.count(labels[k]) == 1 else f"{labels[k]}_{k}"
        single = len(asked.file.tracks) == 1
        written.append("poses.npz" if single else f"poses_{label}.npz")
        follow = rows == list(range(rows[0], rows[0] + len(rows)))
        shape, face = _apart(motion, order)
        write_poses(
            folder / written[-1],
            np.stack([done[at].pose for at in order]),
            shape=shape,
            expression=face,
            translation=None if motion.translation is None else motion.translation[order],
            names=[motion.names[at] for at in order],
            frame_rate=track.frame_rate if follow else None,
            gender=track.gender,
        )
    return written


def _apart(motion: Motion, rows: list[int]) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Shape and expression of some frames."""
    if motion.shape is None:
        return None, None
    own = motion.shape.shape[1] - motion.expressions
    face = motion.shape[rows, own:] if motion.expressions else None
    return motion.shape[rows, :own], face


def write_like_input(
    folder: Path, done: Sequence[HasPose], motion: Motion, asked: Chosen, joints: Sequence[str]
) -> tuple[str, tuple[str, ...]]:
    """Write the input once more with the untangled poses; its name, and what does not fit them.

    Rotations that did not change, joints that the body lacks, and frames and people that were not
    asked for stand as they did.
    """
    poses = {track.name: track.pose.copy() for track in asked.tracks}
    for at, (k, row) in enumerate(asked.rows):
        track = asked.tracks[k]
        layout = SMPL_LAYOUTS[track.pose.shape[1]]
        for joint, name in enumerate(layout):
            if name in joints:
                of_body = joints.index(name)
                if (done[at].pose[of_body] != motion.pose[at, of_body]).any():
                    poses[track.name][row, joint] = done[at].pose[of_body]
    path = asked.file.path
    name = f"{path.stem}_untangled{path.suffix}"
    stale = asked.file.write(folder / name, poses)
    return name, (*stale, *_hands_as_given(name, done, motion, asked, joints))


def _hands_as_given(
    name: str, done: Sequence[HasPose], motion: Motion, asked: Chosen, joints: Sequence[str]
) -> list[str]:
    """What to say of hands that are components in the file and whose fingers were moved."""
    said = []
    for side in ("left", "right"):
        own = [k for k, joint in enumerate(joints) if joint.startswith(side) and joint[-1] in "123"]
        of_side = [getattr(track, f"{side}_hand") is not None for track in asked.tracks]
        if any(
            of_side[k] and (done[at].pose[own] != motion.pose[at, own]).any()
            for at, (k, _) in enumerate(asked.rows)
        ):
            said.append(
                f"{name} keeps the components of the {side} hand as they were: how its fingers "
                "were moved stands in the poses that are written beside it"
            )
    return said
