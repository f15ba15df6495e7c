"""A motion whose frames are files of their own, in a folder: opened as one, and written again."""

import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.files.outputs import folder_error
from spt_jax.io.poses.containers import WHAT
from spt_jax.io.poses.track import MotionFile, Track

_NUMBER = re.compile(r"(\d+)\D*$")


class Place(NamedTuple):
    """Where a row of a track stands: which file, which of its tracks."""

    file: int
    track: str


@dataclass(frozen=True, eq=False)
class MotionFolder(MotionFile):
    """A folder of pose files of a frame each; `MotionFile` says what it has.

    Attributes:
        files: one a frame, or one a person and frame.
        places: by track, where each of its frames stands.
    """

    files: tuple[MotionFile, ...] = ()
    places: Mapping[str, tuple[Place, ...]] | None = None

    def write(
        self, path: str | os.PathLike[str], poses: Mapping[str, Float[np.ndarray, "N J 3"]]
    ) -> tuple[str, ...]:
        """Write the folder with other poses, each file in its own structure; whole or not at all.

        Args, Returns: as `MotionFile.write`.

        Raises:
            OSError: there is a file at `path`, or it cannot be written.
            KeyError, ValueError: as `MotionFile.write`.
        """
        target = Path(path)
        changed: dict[int, dict[str, np.ndarray]] = {}
        tracks = {track.name: track for track in self.tracks}
        for name, pose in poses.items():
            if np.shape(pose) != tracks[name].pose.shape:
                raise ValueError(
                    f"poses must have the shape of the track {name!r}, {tracks[name].pose.shape}: "
                    f"got {np.shape(pose)}"
                )
            for row, place in enumerate((self.places or {})[name]):
                changed.setdefault(place.file, {})[place.track] = np.asarray(pose)[row : row + 1]
        try:
            made = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        except OSError as error:
            raise folder_error(target.parent, error) from error
        notes: dict[str, None] = {}
        try:
            for number, file in enumerate(self.files):
                inner = made / file.path.relative_to(self.path)
                inner.parent.mkdir(parents=True, exist_ok=True)
                said = file.write(inner, changed.get(number, {}))
                notes |= dict.fromkeys(one.replace(inner.name, target.name) for one in said)
            os.chmod(made, 0o777 & ~_umask())
            if target.is_dir():  # of an earlier run: a file would be replaced, too
                os.rename(target, made / ".before")
                os.rename(made, target)
                shutil.rmtree(target / ".before")
            else:
                os.rename(made, target)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        return tuple(notes)


def read_folder(path: Path, files: Sequence[MotionFile]) -> MotionFolder:
    """Files of a frame each as one motion, in the order of their numbers.

    Where they lie in folders of their own, a frame each, as SMPLify-X writes them, people are
    called as the files in these are; else as each file calls them, and where none does, as the
    folder.

    Raises:
        ValueError: there is no file, or one of several frames, or people of several layouts.
    """
    if not files:
        raise ValueError(
            f"a folder of frames must hold pose files: got none in {os.fspath(path)!r}; check the "
            "path, or give the folder that they lie in."
        )
    rows: dict[str, list[tuple[Place, Track, int]]] = {}
    ordered = sorted(files, key=lambda file: _order(file.path.relative_to(path)))
    unnamed = all([track.name for track in file.tracks] == [file.path.stem] for file in files)
    for number, file in enumerate(ordered):
        inner = file.path.relative_to(path)
        for track in file.tracks:
            if len(track.pose) != 1:
                raise ValueError(
                    f"a folder of frames must hold files of one frame each: got {len(track.pose)} "
                    f"in {str(file.path)!r}; open such files one by one, or `spt-jax clean` the "
                    "folder."
                )
            nested = len(inner.parts) > 1
            name = file.path.stem if nested else path.name if unnamed else track.name
            at = _number(inner.parts[0], number)
            rows.setdefault(name, []).append((Place(number, track.name), track, at))
    tracks = tuple(_joined(path, name, found) for name, found in rows.items())
    kinds = Counter(file.structure for file in files)
    notes = list(dict.fromkeys(note for file in ordered for note in file.notes))
    unused = tuple(dict.fromkeys(name for file in ordered for name in file.unused))
    return MotionFolder(
        path=path,
        structure=f"{' and '.join(kinds)}, a file a frame",
        tracks=tuple(track.named(track.name, track.name) for track in tracks),
        notes=(f"{len(files)} files are taken for frames of one motion", *notes),
        unused=unused,
        container=ordered[0].container,
        files=tuple(ordered),
        places={name: tuple(place for place, _, _ in found) for name, found in rows.items()},
    )


def _joined(path: Path, name: str, found: Sequence[tuple[Place, Track, int]]) -> Track:
    tracks = [track for _, track, _ in found]
    layouts = {track.pose.shape[1] for track in tracks}
    if len(layouts) > 1:
        raise ValueError(
            f"{WHAT}s of one motion must have one layout: got {sorted(layouts)} joints of {name!r} "
            f"in {os.fspath(path)!r}."
        )
    shifts = [track.translation for track in tracks]
    shapes = [None if t.shape is None else np.reshape(t.shape, (1, -1)) for t in tracks]
    widths = {None if shape is None else shape.shape[1] for shape in shapes}
    genders = {track.gender for track in tracks}
    whole = [shape for shape in shapes if shape is not None]
    known = [shift for shift in shifts if shift is not None]
    return Track(
        name,
        np.concatenate([track.pose for track in tracks]),
        translation=np.concatenate(known) if len(known) == len(shifts) else None,
        shape=np.concatenate(whole) if len(widths) == 1 and None not in widths else None,
        frame_rate=tracks[0].frame_rate,
        gender=genders.pop() if len(genders) == 1 else None,
        frames=np.array([number for _, _, number in found]),
        blocks=tracks[0].blocks,
    )


def _order(inner: Path) -> tuple[tuple[str, int, str], ...]:
    """Numbers by size, not by letters: 2 before 10."""
    return tuple((_NUMBER.sub("", part), _number(part, -1), part) for part in inner.parts)


def _number(name: str, other: int) -> int:
    found = _NUMBER.search(name.partition(".")[0])
    return int(found[1]) if found is not None and len(found[1]) < 16 else other


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
