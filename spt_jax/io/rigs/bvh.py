"""Motions of any body as BVH, which every animation program opens."""

import os
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from spt_jax.body.base import AbstractBody
from spt_jax.files.outputs import atomic_write

_CHANNELS = "Zrotation Xrotation Yrotation"
# A bone's tip, where nothing says how long it is: this part of the way from its parent.
_TIP = 0.5


def write_bvh(
    path: str | os.PathLike[str],
    body: AbstractBody,
    poses: Float[Array | np.ndarray, "T J 3"],
    *,
    translation: Float[Array | np.ndarray, "T 3"] | None = None,
    frames_per_second: float = 30.0,
) -> None:
    """Write a motion as .bvh: the body's joints at rest as offsets in metres, and Euler angles.

    A pose's rotations are about axes that are the world's at rest, which is what BVH has, so
    nothing is lost but what BVH cannot say: shapes, scales, and joints that shift.

    Args:
        path: the file; .bvh.
        body: whose joints turn.
        poses: axis-angle of each frame, in radians.
        translation: of each frame, in metres.
        frames_per_second: of the motion.

    Raises:
        ValueError: another suffix; poses or a translation that do not fit, or are not finite; a
            rate that is not positive.
        OSError: as in `atomic_write`.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax import load_body, load_mocap, load_poses
        >>> from spt_jax.io import write_bvh
        >>> body, mocap = load_body(), load_mocap()
        >>> rows = [name.startswith("walk/") for name in mocap.names]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "walk.bvh"
        ...     write_bvh(file, body, body.pose_from_smpl(mocap.pose[rows][:4]))
        ...     (track,) = load_poses(file)
        >>> track.pose.shape, track.frame_rate
        ((4, 52, 3), 30.0)
    """
    target = Path(path)
    if target.suffix.lower() != ".bvh":
        raise ValueError(f"path must end in .bvh: got {target.name!r}.")
    if not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
    turns = np.asarray(poses, np.float64)
    if turns.ndim != 3 or turns.shape[1:] != body.pose_shape or not len(turns):
        raise ValueError(
            f"poses must have shape (frames, {body.num_joints}, 3): got {turns.shape}."
        )
    places = np.zeros((len(turns), 3))
    if translation is not None:
        places = np.asarray(translation, np.float64)
    if places.shape != (len(turns), 3):
        raise ValueError(f"translation must have shape ({len(turns)}, 3): got {places.shape}.")
    if not np.isfinite(turns).all() or not np.isfinite(places).all():
        raise ValueError("poses and translation must be finite: got NaN or infinity.")
    joints = np.asarray(body(jnp.zeros(body.pose_shape)).joints, np.float64)
    order: list[int] = []
    head = _hierarchy(body, joints, order)
    degrees = Rotation.from_rotvec(turns[:, order].reshape(-1, 3)).as_euler("ZXY", degrees=True)
    rows = np.concatenate([joints[0] + places, degrees.reshape(len(turns), -1)], axis=1)
    lines = [
        *head,
        "MOTION",
        f"Frames: {len(turns)}",
        f"Frame Time: {1 / frames_per_second!r}",
        *(" ".join(f"{x:.9g}" for x in row) for row in rows.tolist()),
    ]
    with atomic_write(target) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _hierarchy(body: AbstractBody, joints: np.ndarray, order: list[int]) -> list[str]:
    """The lines of the skeleton; `order` is filled with the joints as they come."""
    children: list[list[int]] = [[] for _ in body.parents]
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            children[parent].append(joint)
    lines = ["HIERARCHY"]
    # Not by recursion: a chain of a thousand links is a body, too.
    stack: list[int | str] = [0]
    depth = 0
    while stack:
        item = stack.pop()
        if isinstance(item, str):
            depth -= 1
            lines.append("  " * depth + item)
            continue
        order.append(item)
        parent, pad = body.parents[item], "  " * depth
        away = joints[item] - (joints[parent] if parent >= 0 else 0)
        name = re.sub(r"\s+", "_", body.joint_names[item])
        moves = "6 Xposition Yposition Zposition" if parent < 0 else "3"
        lines += [
            f"{pad}{'ROOT' if parent < 0 else 'JOINT'} {name}",
            f"{pad}{{",
            f"{pad}  OFFSET {_numbers(away)}",
            f"{pad}  CHANNELS {moves} {_CHANNELS}",
        ]
        stack.append("}")
        stack += reversed(children[item])
        if not children[item]:
            tip = _TIP * away if parent >= 0 else np.zeros(3)
            lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET {_numbers(tip)}"]
            lines.append(f"{pad}  }}")
        depth += 1
    return lines


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in values.tolist())
