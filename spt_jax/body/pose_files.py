"""Pose files: the .npz layouts of AMASS, SMPL, SMPL-H and SMPL-X, and this project's own."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jax import Array
from jaxtyping import Float

from spt_jax.file_limits import read_npz
from spt_jax.output_files import atomic_write

JOINT_COUNTS = (22, 24, 52, 55)
"""Body alone; SMPL; SMPL-H, with fingers; SMPL-X, with jaw and eyes before the fingers."""

_HANDS = ("left_hand_pose", "right_hand_pose")
_HEAD = ("jaw_pose", "leye_pose", "reye_pose")
_POSES = ("poses", "pose")
_SHAPES = ("betas", "shape")
_TRANSLATIONS = ("trans", "transl", "translation")
_KEYS = {*_POSES, *_SHAPES, *_TRANSLATIONS, *_HANDS, *_HEAD, "global_orient", "body_pose", "name"}
# Beyond these a number is none of a body's: angles in radians, however often they wind; shape
# coefficients; and positions in metres, or in millimetres.
_MOST_RADIANS = 1e4
_MOST = {**dict.fromkeys(_SHAPES, 1e4), **dict.fromkeys(_TRANSLATIONS, 1e9)}
_ACCEPTED = (
    "poses or pose (N frames of 22, 24, 52 or 55 axis-angle rows), or global_orient with body_pose"
)


class PoseFile(NamedTuple):
    """What a pose file holds; it unpacks as (pose, shape, translation, names)."""

    pose: Float[np.ndarray, "N J 3"]
    """Axis-angle in radians, each joint relative to its parent; row 0 is the global orientation."""
    shape: Float[np.ndarray, "*frames B"] | None
    """Shape coefficients: one set (B,) for all frames, or one a frame (N, B)."""
    translation: Float[np.ndarray, "N 3"] | None
    names: list[str]


def read_poses(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> PoseFile:
    """Return the poses of an .npz file, with shape, translation and names where it has them.

    Layouts, told apart by their keys:
    - AMASS and this project: `poses` or `pose`, with frames of 66, 72, 156 or 165 numbers or of
      22, 24, 52 or 55 rows of 3; one frame may come without its leading axis.
    - SMPL, SMPL-H and SMPL-X parameters: `global_orient` and `body_pose` (21 joints, or SMPL's 23);
      with `left_hand_pose` or `right_hand_pose` the result has 52 joints, with `jaw_pose`,
      `leye_pose` or `reye_pose` 55; those of the group that are missing are zero.

    Beside either: `betas` or `shape`; `trans`, `transl` or `translation`; `name`, one a frame.
    Nothing is unpickled.

    Args:
        path: the file.
        max_bytes: what its arrays may take once unpacked; 1 GiB where None.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it cannot be read.
        ValueError: not an .npz file, pickled arrays, missing keys, wrong sizes, NaN or infinity,
            angles or positions beyond all bodies, or more bytes than the limit; the message names
            the file, the key, what was seen and what is accepted.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax.body.pose_files import read_poses
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "amass.npz"
        ...     np.savez(file, poses=np.zeros((5, 156)), trans=np.zeros((5, 3)), gender="neutral")
        ...     poses = read_poses(file)
        >>> poses.pose.shape, poses.translation.shape, poses.shape
        ((5, 52, 3), (5, 3), None)
    """
    file = Path(path)
    # Other keys are left alone: some AMASS releases pickle the gender.
    found = read_npz(file, _KEYS.__contains__, "pose file", max_bytes=max_bytes)
    arrays, keys = found.arrays, sorted(found.names)
    key = next((key for key in _POSES if key in arrays), None)
    if key is not None:
        pose = _frames(file, arrays, key, JOINT_COUNTS)
    elif "global_orient" in arrays and "body_pose" in arrays:
        pose = _from_parts(file, arrays)
    else:
        raise ValueError(f"pose file must hold {_ACCEPTED}: got {str(path)!r} with keys {keys}")
    return PoseFile(
        pose,
        _shape(file, arrays, len(pose)),
        _translation(file, arrays, len(pose)),
        _names(file, arrays, len(pose)),
    )


def write_poses(
    path: str | os.PathLike[str],
    pose: Float[Array | np.ndarray, "..."],
    *,
    shape: Float[Array | np.ndarray, "..."] | None = None,
    translation: Float[Array | np.ndarray, "..."] | None = None,
    names: Sequence[str] | None = None,
) -> None:
    """Write poses as an .npz file in AMASS' layout, atomically; `read_poses` returns them as given.

    The keys are `poses` (N, 3 J), and where given `betas`, `trans` (N, 3) and `name` (N,).

    Args:
        path: the file; its suffix must be .npz.
        pose: axis-angle (N, J, 3) or (J, 3), in radians, of 22, 24, 52 or 55 joints.
        shape: (B,) or (N, B).
        translation: (N, 3) or (3,).
        names: one for each frame.

    Raises:
        ValueError: another suffix, or what `read_poses` would not accept.
        OSError: the folder is missing or cannot be written.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax.body.pose_files import read_poses, write_poses
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "rest.npz"
        ...     write_poses(file, np.zeros((22, 3)), names=["rest"])
        ...     print(read_poses(file).names)
        ['rest']
    """
    file = Path(path)
    if file.suffix.lower() != ".npz":
        raise ValueError(f"path must end in .npz: got {str(path)!r}")
    given = {"poses": pose, "betas": shape, "trans": translation}
    arrays = {key: np.asarray(value) for key, value in given.items() if value is not None}
    frames = _frames(file, arrays, "poses", JOINT_COUNTS)
    if names is not None:
        arrays["name"] = np.asarray(names, dtype=np.str_)
        _names(file, arrays, len(frames))
    _shape(file, arrays, len(frames))
    _translation(file, arrays, len(frames))
    arrays["poses"] = arrays["poses"].reshape(len(frames), -1)
    with atomic_write(file) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def _finite(file: Path, arrays: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    values = arrays[key]
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{key} must hold numbers: got {values.dtype} in {str(file)!r}")
    if not np.isfinite(values).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise ValueError(f"{key} must be finite: got {values[place]} at {place} in {str(file)!r}")
    most = _MOST.get(key, _MOST_RADIANS)
    with np.errstate(over="ignore"):
        numbers = values.astype(np.float64)
    if not (np.abs(numbers) <= most).all():
        place = tuple(int(i) for i in np.argwhere(~(np.abs(numbers) <= most))[0])
        raise ValueError(
            f"{key} must be within {most:g} of zero: got {values[place]} at {place} in "
            f"{str(file)!r}; it is damaged, or in another unit"
        )
    return numbers


def _frames(
    file: Path, arrays: Mapping[str, np.ndarray], key: str, counts: Sequence[int]
) -> Float[np.ndarray, "N J 3"]:
    values = _finite(file, arrays, key)
    shape = values.shape
    if values.ndim == 3 and shape[1] in counts and shape[2] == 3:
        frames = values
    elif values.ndim == 2 and shape[0] in counts and shape[1] == 3:
        frames = values[None]
    elif values.ndim in (1, 2) and shape[-1] in [3 * count for count in counts]:
        frames = values.reshape(-1, shape[-1] // 3, 3)
    else:
        rows = " or ".join(map(str, counts))
        raise ValueError(
            f"{key} must hold frames of {rows} axis-angle rows, (N, J, 3) or (N, 3 J): got shape "
            f"{shape} in {str(file)!r}; convert rotation matrices and hand components first"
        )
    if len(frames) == 0:
        raise ValueError(f"{key} must hold at least one frame: got none in {str(file)!r}")
    return frames


def _from_parts(file: Path, arrays: Mapping[str, np.ndarray]) -> Float[np.ndarray, "N J 3"]:
    body = _frames(file, arrays, "body_pose", (21, 23))
    root = _frames(file, arrays, "global_orient", (1,))
    parts = [root, body]
    hands, head = (any(key in arrays for key in group) for group in (_HANDS, _HEAD))
    if (hands or head) and body.shape[1] != 21:
        raise ValueError(
            f"body_pose must hold 21 rows beside separate hands or face: got {body.shape[1]} in "
            f"{str(file)!r}; SMPL's last two rows are its hands"
        )
    wanted = [(key, 1) for key in _HEAD if head] + [(key, 15) for key in _HANDS if hands or head]
    for key, count in wanted:
        parts.append(
            _frames(file, arrays, key, (count,))
            if key in arrays
            else np.zeros((len(body), count, 3))
        )
    lengths = [len(part) for part in parts]
    frames = max(lengths)
    if any(length not in (1, frames) for length in lengths):
        keys = ["global_orient", "body_pose", *(key for key, _ in wanted)]
        raise ValueError(
            f"{', '.join(keys)} must have one number of frames: got {lengths} in {str(file)!r}"
        )
    return np.concatenate([np.broadcast_to(p, (frames, *p.shape[1:])) for p in parts], axis=1)


def _shape(
    file: Path, arrays: Mapping[str, np.ndarray], frames: int
) -> Float[np.ndarray, "*frames B"] | None:
    key = next((key for key in _SHAPES if key in arrays), None)
    if key is None:
        return None
    values = _finite(file, arrays, key)
    if values.ndim == 2 and len(values) == 1 and frames != 1:
        values = values[0]
    if values.ndim not in (1, 2) or (values.ndim == 2 and len(values) != frames):
        raise ValueError(
            f"{key} must have shape (B,) or ({frames}, B): got {values.shape} in {str(file)!r}"
        )
    return values


def _translation(
    file: Path, arrays: Mapping[str, np.ndarray], frames: int
) -> Float[np.ndarray, "N 3"] | None:
    key = next((key for key in _TRANSLATIONS if key in arrays), None)
    if key is None:
        return None
    values = _finite(file, arrays, key)
    if values.shape not in ((3,), (1, 3), (frames, 3)):
        raise ValueError(
            f"{key} must have shape (3,) or ({frames}, 3): got {values.shape} in {str(file)!r}"
        )
    return np.broadcast_to(values, (frames, 3)).copy()


def _names(file: Path, arrays: Mapping[str, np.ndarray], frames: int) -> list[str]:
    if "name" not in arrays:
        return [file.stem] if frames == 1 else [f"{file.stem}/{i:04d}" for i in range(frames)]
    names = np.atleast_1d(arrays["name"])
    if names.dtype.kind != "U" or names.shape != (frames,):
        raise ValueError(
            f"name must hold {frames} strings: got {names.dtype} {names.shape} in {str(file)!r}"
        )
    try:
        return [str(name) for name in names]
    except ValueError as error:  # a number that is no letter
        raise ValueError(f"name must hold text: got {error} in {str(file)!r}") from error
