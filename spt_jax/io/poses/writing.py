"""Poses written in AMASS' layout."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jax import Array
from jaxtyping import Float

from spt_jax.files.outputs import atomic_write
from spt_jax.io.poses.containers import Container
from spt_jax.io.poses.reading import open_poses, read_motion
from spt_jax.io.poses.track import Track
from spt_jax.io.poses.whole import JOINT_COUNTS


def read_poses(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> Track:
    """The only track of a pose file.

    Args, Raises: as `load_poses`.

    Raises:
        ValueError: it holds several people.
    """
    tracks = open_poses(path, max_bytes=max_bytes).tracks
    if len(tracks) != 1:
        raise ValueError(
            f"pose file must hold one person here: got {len(tracks)} in {os.fspath(path)!r}; "
            "load_poses returns them all"
        )
    return tracks[0]


def check_joints(body: str, count: int) -> None:
    """Refuse a body whose poses `write_poses` could not write, before work is spent on them.

    Args:
        body: its name or file.
        count: of its joints.

    Raises:
        ValueError: pose files hold no poses of so many joints.
    """
    if count not in JOINT_COUNTS:
        raise ValueError(
            f"body must have {', '.join(map(str, JOINT_COUNTS[:-1]))} or {JOINT_COUNTS[-1]} "
            f"joints, whose poses can be written: got {body!r} with {count}; in Python, fit_pose "
            "takes it."
        )


def write_poses(
    path: str | os.PathLike[str],
    pose: Float[Array | np.ndarray, "..."],
    *,
    shape: Float[Array | np.ndarray, "..."] | None = None,
    translation: Float[Array | np.ndarray, "..."] | None = None,
    names: Sequence[str] | None = None,
    frame_rate: float | None = None,
    gender: str | None = None,
    expression: Float[Array | np.ndarray, "..."] | None = None,
) -> None:
    """Write poses as an .npz file in AMASS' layout, atomically; `load_poses` returns them as given.

    The keys are `poses` (N, 3 J), and where given `betas`, `trans` (N, 3), `mocap_framerate`,
    `gender`, `expression` (N, E) and `name` (N,).

    Args:
        path: the file; its suffix must be .npz.
        pose: axis-angle (N, J, 3) or (J, 3), in radians, of 22, 24, 52 or 55 joints.
        shape: (B,) or (N, B).
        translation: (N, 3) or (3,), in metres.
        names: one for each frame.
        frame_rate: frames a second.
        gender: "male", "female" or "neutral".
        expression: coefficients of the face, (E,) or (N, E).

    Raises:
        ValueError: another suffix, or what `load_poses` would not accept.
        OSError: the folder is missing or cannot be written.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax.io.pose_files import load_poses, write_poses
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "rest.npz"
        ...     write_poses(file, np.zeros((22, 3)), names=["rest"], frame_rate=30)
        ...     (track,) = load_poses(file)
        >>> track.names, track.frame_rate
        (['rest'], 30.0)
    """
    file = Path(path)
    if file.suffix.lower() != ".npz":
        raise ValueError(f"path must end in .npz: got {str(path)!r}")
    given = {
        "poses": pose,
        "betas": shape,
        "trans": translation,
        "mocap_framerate": frame_rate,
        "expression": expression,
    }
    arrays = {key: np.asarray(value) for key, value in given.items() if value is not None}
    texts = {"gender": gender, "name": names}
    arrays |= {k: np.asarray(v, dtype=np.str_) for k, v in texts.items() if v is not None}
    # What it could not read again it does not write.
    (track,) = read_motion(Container(file, "npz", arrays, bytes)).tracks
    arrays["poses"] = arrays["poses"].reshape(len(track.pose), -1)
    with atomic_write(file) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
