"""Real human poses that come with the package."""

from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Mocap(NamedTuple):
    """Motion-capture frames: `names` ("crawl/0012"), `joints` and `pose`, axis-angle in radians.

    Example:
        >>> from spt_jax import load_mocap
        >>> mocap = load_mocap()
        >>> frame = mocap.names.index("crawl/0012")
        >>> mocap.pose[frame].shape, mocap.joints[0]
        ((22, 3), 'pelvis')
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    pose: Float[np.ndarray, "frames 22 3"]


def load_mocap() -> Mocap:
    """1,086 frames of real motion capture, as poses of SMPL's first 22 joints.

    Eleven motions (backflip, cartwheel, crawl, dance_a, getup_facedown, jump, punch, roll, run,
    spinkick, walk). Source and licence: `body/data/README.md`.

    Returns:
        Mocap(names, joints, pose): pose (1086, 22, 3) float32, axis-angle in radians relative to
        the parent joint; `body.pose_from_smpl` turns frames into poses of any body.

    Example:
        >>> from spt_jax.body import load_mocap
        >>> mocap = load_mocap()
        >>> mocap.names[0], mocap.pose.shape
        ('backflip/0000', (1086, 22, 3))
    """
    source = resources.files("spt_jax.body").joinpath("data", "mocap_poses.npz")
    with source.open("rb") as file, np.load(file, allow_pickle=False) as data:
        return Mocap(tuple(data["name"].tolist()), tuple(data["joints"].tolist()), data["pose"])
