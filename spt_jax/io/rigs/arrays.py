"""Poses of a rig as arrays: AMASS' keys, with the names of joints and coefficients."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from spt_jax.body.rig import RigModel
from spt_jax.files.outputs import atomic_write


def write_rig_poses(
    path: str | os.PathLike[str],
    body: RigModel,
    pose: Float[np.ndarray, "T J 3"],
    shape: Float[np.ndarray, "T B"],
    translation: Float[np.ndarray, "T 3"],
    frame_rate: float | None,
) -> None:
    """Write poses as an .npz file, atomically.

    The keys are `poses` (T, 3 J), `betas` (T, B), `trans` (T, 3), `joint_names`, `shape_names` and
    where there is one `mocap_framerate`.

    Raises:
        OSError: as in `atomic_write`.
    """
    arrays = {
        "poses": pose.reshape(len(pose), -1),
        "betas": shape,
        "trans": translation,
        "joint_names": np.array(body.joint_names, np.str_),
        "shape_names": np.array(body.shape_names, np.str_),
    }
    if frame_rate is not None:
        arrays["mocap_framerate"] = np.array(frame_rate)
    with atomic_write(Path(path)) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
