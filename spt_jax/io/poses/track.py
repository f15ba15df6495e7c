"""Tracks, one a person, and the files that they came from."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from spt_jax.files.outputs import atomic_write
from spt_jax.io.poses.containers import Container
from spt_jax.io.poses.rotations import axis_angles, matrices
from spt_jax.io.poses.source import Block, Way
from spt_jax.io.poses.unpickling import TorchArray

# Fields that follow from the poses, by their names: other poses are written without them.
_DERIVED = re.compile(
    r"vert|joint|j3d|j2d|pj2d|kps?$|keypoints|embedding|latent|60Hz|marker|^pose|pose$|points",
    re.IGNORECASE,
)


@dataclass(frozen=True, eq=False)
class Track:
    """One person's frames, as a file has them; what it does not have is None.

    Attributes:
        name: of the person, or of the file.
        pose: axis-angle in radians, each joint relative to its parent, in one of SMPL's layouts of
            22, 24, 52 or 55 joints; row 0 is the global orientation.
        translation: in metres.
        shape: coefficients, one set for all frames, or one a frame.
        frame_rate: frames a second.
        gender: "male", "female" or "neutral".
        names: one a frame.
        frames: the numbers that the file gives them.
        left_hand, right_hand: components of MANO's hands, where the file has these in place of
            rotations; the fingers of `pose` are at rest then, and
            `body.with_hands(body.pose_from_smpl(pose), left_hand, right_hand)` has them.
        expression: coefficients of the face.
        blocks: where in the file the rotations stand.
        copies: where they stand once more, turned as a whole or not.
    """

    name: str
    pose: Float[np.ndarray, "N J 3"]
    translation: Float[np.ndarray, "N 3"] | None = None
    shape: Float[np.ndarray, "*frames B"] | None = None
    frame_rate: float | None = None
    gender: str | None = None
    names: Sequence[str] = ()
    frames: Int[np.ndarray, "N"] | None = None
    left_hand: Float[np.ndarray, "N C"] | None = None
    right_hand: Float[np.ndarray, "N C"] | None = None
    expression: Float[np.ndarray, "N E"] | None = None
    blocks: tuple[Block, ...] = ()
    copies: tuple[tuple[Block, ...], ...] = ()

    def named(self, name: str, label: str) -> "Track":
        """The track with its person's name, and its frames called after label and number."""
        if self.names:
            return replace(self, name=name)
        count = len(self.pose)
        numbers = range(count) if self.frames is None else self.frames.tolist()
        single = count == 1 and self.frames is None
        names = [label] if single else [f"{label}/{k:04d}" for k in numbers]
        return replace(self, name=name, names=names)


@dataclass(frozen=True, eq=False)
class MotionFile:
    """A pose file that was read, with all that it takes to write it again.

    Attributes:
        path: the file.
        structure: whose structure it has, such as "WHAM".
        tracks: the people in it.
        notes: what was decided, and what is in the file and not used, one sentence each.
        unused: the names of the latter.
        container: the file as it was opened.
    """

    path: Path
    structure: str
    tracks: tuple[Track, ...]
    notes: tuple[str, ...]
    unused: tuple[str, ...]
    container: Container

    def write(
        self, path: str | os.PathLike[str], poses: Mapping[str, Float[np.ndarray, "N J 3"]]
    ) -> tuple[str, ...]:
        """Write the file with other poses, in its own structure, form and precision, atomically.

        All else stands as it did. A rotation that is the same as it was is written as it was, to
        the bit.

        Args:
            path: the file to write.
            poses: by track, the poses in place of its own, of the same shape; tracks that are not
                named stay.

        Returns:
            What does not fit the new poses any more, one sentence each.

        Raises:
            KeyError: a track that the file does not have.
            ValueError: poses of another shape.
            OSError: as in `atomic_write`.
        """
        tracks = {track.name: track for track in self.tracks}
        changes: dict[Way, np.ndarray] = {}
        for name, pose in poses.items():
            track = tracks[name]
            pose = np.asarray(pose, np.float64)
            if pose.shape != track.pose.shape:
                raise ValueError(
                    f"poses must have the shape of the track {name!r}, {track.pose.shape}: got "
                    f"{pose.shape}"
                )
            self._change(changes, track.blocks, track.pose, pose)
            for copy in track.copies:
                before = self._decoded(copy, track.pose)
                self._change(changes, copy, before, _moved(track.pose, pose, before))
        content = self.container.encode(_replaced(self.container.tree, changes))
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
        stale = [name for name in self.unused if _DERIVED.search(name)]
        if not stale or not changes:
            return ()
        return (f"{Path(path).name} keeps what followed from the poses before: {', '.join(stale)}",)

    def _decoded(self, blocks: Sequence[Block], like: np.ndarray) -> np.ndarray:
        pose = like.copy()
        for block in blocks:
            values = np.asarray(_at(self.container.tree, block.way), np.float64)[block.index]
            shaped = values.reshape(-1, len(block.joints), *block.form.tail)
            rows = slice(None) if block.rows is None else block.rows
            pose[rows, block.joints] = block.form.decode(shaped)
        return pose

    def _change(
        self,
        changes: dict[Way, np.ndarray],
        blocks: Sequence[Block],
        before: np.ndarray,
        after: np.ndarray,
    ) -> None:
        for block in blocks:
            rows = slice(None) if block.rows is None else block.rows
            new, old = (pose[rows][:, list(block.joints)] for pose in (after, before))
            moved = (new != old).any(axis=-1)
            if not moved.any():
                continue
            array = changes.get(block.way)
            if array is None:
                array = _writable(_at(self.container.tree, block.way))
            view = array[block.index]
            shaped = np.array(view, copy=True).reshape(-1, len(block.joints), *block.form.tail)
            if len(shaped) == 1 < len(new):
                if (new == new[:1]).all():  # one row for all frames, still
                    new, moved = new[:1], moved[:1]
                else:
                    array = np.repeat(shaped, len(new), axis=0).reshape(len(new), *view.shape[1:])
                    view, shaped = array, array.reshape(len(new), *shaped.shape[1:]).copy()
            shaped[moved] = block.form.encode(new)[moved]
            array[block.index] = shaped.reshape(view.shape)
            changes[block.way] = array


def _moved(before: np.ndarray, after: np.ndarray, copy: np.ndarray) -> np.ndarray:
    """What becomes of a copy: its joints as in the track, its root turned by as much."""
    pose = np.where(after == before, copy, after)
    turned = (after[:, 0] != before[:, 0]).any(axis=-1)
    if turned.any():
        by = matrices(before[turned, 0]).transpose(0, 2, 1) @ matrices(after[turned, 0])
        pose[turned, 0] = axis_angles(matrices(copy[turned, 0]) @ by)
    pose[~turned, 0] = copy[~turned, 0]
    return pose


def _writable(value: Any) -> np.ndarray:
    array = np.array(value, copy=True)
    if array.dtype.hasobject:
        array = np.stack([np.asarray(x) for x in np.ravel(array)])
    if array.dtype.kind != "f":
        array = array.astype(np.float64)
    return array.view(TorchArray) if isinstance(value, TorchArray) else array


def _at(tree: Any, way: Way) -> Any:
    for key in way:
        tree = tree[key]
    return tree


def _replaced(tree: Any, changes: Mapping[Way, np.ndarray]) -> Any:
    """The tree with other arrays in some places; nothing of the one given is changed."""
    if () in changes:
        new = changes[()]
        return new.tolist() if isinstance(tree, list) else new
    heads: dict[Any, dict[Way, np.ndarray]] = {}
    for way, value in changes.items():
        heads.setdefault(way[0], {})[way[1:]] = value
    if not heads:
        return tree
    if isinstance(tree, Mapping):
        return {k: _replaced(v, heads.get(k, {})) for k, v in tree.items()}
    if isinstance(tree, np.ndarray):  # of objects
        copy = tree.copy()
        for key, inner in heads.items():
            copy[key] = _replaced(tree[key], inner)
        return copy
    return type(tree)([_replaced(value, heads.get(k, {})) for k, value in enumerate(tree)])
