"""Which feet stand on the ground, frame by frame."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from spt_jax.body import AbstractBody
from spt_jax.untangle.corrections import Frames

# A foot stands no higher than this above the ground, in metres, and no faster, in metres a second.
LOW, SLOW = 0.05, 0.3

# Joints whose skin, with that of all joints below, is a foot's.
_ANKLES = ("left_ankle", "right_ankle")


class Standing(NamedTuple):
    """Feet, and when they stand.

    Attributes:
        feet: which vertices are of each foot; of a body without joints of such names no foot.
        share: of each frame, person and foot, 1 where it stands.
    """

    feet: Bool[np.ndarray, "K V"]
    share: Float[np.ndarray, "T P K"]


def standing_feet(
    body: AbstractBody,
    frames: Frames,
    frames_per_second: float,
    up: Float[np.ndarray, "3"],
    *,
    on_ground: bool,
) -> Standing:
    """Which feet are low, and slow, in each frame.

    Args:
        body: the body.
        frames: the motion.
        frames_per_second: its rate.
        up: the direction that is up, of length one.
        on_ground: whether the translation of the frames says where the ground is: at the lowest
            place of the whole motion. Otherwise it is wherever each body is lowest in each frame,
            and the speed of a foot is unknown.
    """
    feet = feet_of(body)
    if not len(feet):
        return Standing(feet, np.zeros((*frames.pose.shape[:2], 0)))
    known = tuple(tuple(np.flatnonzero(foot).tolist()) for foot in feet)
    parts = [
        [np.asarray(x)[:count] for x in _heights(body, batch, known, up.astype(frames.pose.dtype))]
        for count, batch in frames.batches()
    ]
    lowest, soles, middles = (np.concatenate(x) for x in zip(*parts, strict=True))
    ground = lowest.min() if on_ground else lowest[..., None]
    low = soles - ground < LOW
    if on_ground and len(middles) > 1:
        step = np.linalg.norm(np.diff(middles, axis=0), axis=-1) * frames_per_second
        # Slower than that to the frame before and to the one after.
        step = np.concatenate([step[:1], step, step[-1:]])
        low &= np.maximum(step[1:], step[:-1]) < SLOW
    return Standing(feet, low.astype(np.float64))


def feet_of(body: AbstractBody) -> Bool[np.ndarray, "K V"]:
    """Which vertices each foot's joints move more than all others."""
    found = []
    for name in _ANKLES:
        if name in body.joint_names:
            own = [body.joint_names.index(name)]
            own += [j for j, p in enumerate(body.parents) if _is_below(body.parents, p, own[0])]
            foot = np.asarray(body.weights)[:, own].sum(axis=1) > 0.5
            if foot.any():
                found.append(foot)
    return np.array(found, bool).reshape(-1, body.num_vertices)


def _is_below(parents: tuple[int, ...], joint: int, ancestor: int) -> bool:
    while joint >= 0 and joint != ancestor:
        joint = parents[joint]
    return joint == ancestor


@eqx.filter_jit
def _heights(body, frames: Frames, feet: tuple[tuple[int, ...], ...], up):
    """Of each frame and person the lowest place, that of each foot, and the middle of each foot."""
    vertices = body(*frames).vertices
    height = vertices @ up
    soles = [height[..., np.array(foot)].min(axis=-1) for foot in feet]
    middles = [vertices[..., np.array(foot), :].mean(axis=-2) for foot in feet]
    return height.min(axis=-1), jnp.stack(soles, axis=-1), jnp.stack(middles, axis=-2)
