"""Animations as poses of a rig, and poses as rotations of the file's nodes."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from spt_jax.io.rigs.animations import Animation, Channel
from spt_jax.io.rigs.building import Built
from spt_jax.io.rigs.nodes import matrices_of_quaternions


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion of a rig: `body(clip.pose, clip.shape, clip.translation)` are its frames.

    Attributes:
        name: of the animation; "rest" for the pose that the file shows without one.
        times: of the frames, in seconds.
        pose: axis-angle of each joint, in radians.
        shape: morph targets, and what shifts and scales joints; as `RigModel.shape_names`.
        translation: of the root, in metres.
        frame_rate: frames a second; None for a single pose.
    """

    name: str
    times: Float[np.ndarray, "T"]
    pose: Float[np.ndarray, "T J 3"]
    shape: Float[np.ndarray, "T B"]
    translation: Float[np.ndarray, "T 3"]
    frame_rate: float | None

    def with_pose(self, pose: Float[Array | np.ndarray, "T J 3"]) -> "Clip":
        """The same with other poses.

        Raises:
            ValueError: not one for each frame.
        """
        found = np.asarray(pose, np.float64)
        if found.shape != self.pose.shape:
            raise ValueError(f"pose must have shape {self.pose.shape}: got {found.shape}.")
        if not np.isfinite(found).all():
            raise ValueError("pose must be finite: got NaN or infinity; leave such frames out.")
        return replace(self, pose=found)


def sample(
    built: Built, weights: dict[int, np.ndarray], animation: Animation | None, rate: float | None
) -> Clip:
    """An animation's frames as poses.

    Args:
        built: the rig.
        weights: of each node with morph targets, what the file gives them.
        animation: None for the pose without one.
        rate: frames a second, or None.
    """
    times, fps = (np.zeros(1), None) if animation is None else animation.times(rate)
    channels = () if animation is None else animation.channels
    joints, body, count = built.joints, built.body, len(times)
    turn = np.repeat(np.stack([one.rotation for one in joints.locals])[None], count, axis=0)
    targets = body.shape_basis.shape[-1]
    shape, translation = np.zeros((count, body.num_shape)), np.zeros((count, 3))
    for node, first in built.targets.items():
        shape[:, first : first + len(weights[node])] = weights[node]
    for channel in channels:
        values = channel.at(times)
        if channel.path == "weights":
            if channel.node in built.targets:
                first = built.targets[channel.node]
                shape[:, first : first + values.shape[1]] = values
        elif channel.node in joints.place:
            joint = joints.place[channel.node]
            if channel.path == "rotation":
                turn[:, joint] = matrices_of_quaternions(values)
            elif channel.path == "translation" and joint == 0:
                change = values - joints.translation[0]
                translation = change @ (built.scale * joints.before[0, :3, :3]).T
            else:
                _fill(shape, targets, built, channel, values, joint)
    return Clip(
        "rest" if animation is None else animation.name,
        times,
        pose_of_rotations(built, turn),
        shape,
        translation,
        fps,
    )


def _fill(shape, first: int, built: Built, channel: Channel, values, joint: int) -> None:
    joints = built.joints
    if channel.path == "translation" and joint in joints.shifting:
        at = first + 3 * joints.shifting.index(joint)
        shape[:, at : at + 3] = values - joints.translation[joint]
    elif channel.path == "scale" and joint in joints.scaling:
        at = first + 3 * (len(joints.shifting) + joints.scaling.index(joint))
        shape[:, at : at + 3] = values - np.diag(joints.stretch[joint])


def pose_of_rotations(built: Built, turn: Float[np.ndarray, "T J 3 3"]) -> Any:
    """Poses of the rig from rotations of its nodes."""
    frame, bind = built.joints.bind_frame, built.joints.bind_rotation
    away = frame @ turn @ bind.transpose(0, 2, 1) @ frame.transpose(0, 2, 1)
    vectors = Rotation.from_matrix(away.reshape(-1, 3, 3)).as_rotvec()
    return vectors.reshape(*turn.shape[:2], 3)


def quaternions_of_pose(built: Built, pose: Float[np.ndarray, "T J 3"]) -> Any:
    """Rotations of the rig's nodes from poses: (x, y, z, w), each next to the one before."""
    frame, bind = built.joints.bind_frame, built.joints.bind_rotation
    away = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(*pose.shape, 3)
    turn = frame.transpose(0, 2, 1) @ away @ frame @ bind
    found = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_quat().reshape(*pose.shape[:2], 4)
    turned = np.sum(found[1:] * found[:-1], axis=-1) < 0
    found[1:][np.cumsum(turned, axis=0) % 2 == 1] *= -1
    return found
