"""Poses in which a limb has passed through another part of the body, made by sweeping it there.

A frame of motion capture that is free of collisions, in which one joint is turned about a fixed
axis until the overlap is at its largest: the limb is then halfway through. The pose from which
the sweep started is known to be free, and says how far the limb has to go back at most.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from spt_jax import load_body, load_mocap
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.measure import Measurement, Sampling, measure

# What is swept, what it has to pass through, how many, and the least overlap in cm^3.
KINDS = {
    "an arm through the torso": (("shoulder",), ("pelvis", "spine", "collar"), 40, 150.0),
    "a leg through the other": (("hip",), ("hip", "knee", "ankle"), 30, 150.0),
    "a hand or arm through the head": (("shoulder", "elbow"), ("head", "neck"), 30, 60.0),
}
_STEP, _STEPS = np.deg2rad(10.0), 12
_EXACT = Sampling(None, ((0.0, 0.0, -1.0),))


class Through(NamedTuple):
    """One pose: what it is, the pose, and the free one that it was made from."""

    kind: str
    pose: np.ndarray
    free: np.ndarray
    volume: float


class World:
    """The embedded body, and its collisions in a pose."""

    def __init__(self) -> None:
        self.body: Any = load_body()
        self.faces = np.asarray(self.body.faces, np.int64)
        self.exclusions = Exclusions(rest=self.body.rest_surface)
        self.groups = np.asarray(self.body.part_groups)
        self._posed = jax.jit(lambda pose: self.body(pose).vertices)

    def vertices(self, pose: np.ndarray) -> np.ndarray:
        """Of the body in a pose."""
        return np.asarray(self._posed(np.asarray(pose, np.float32)), np.float64)

    def measured(self, pose: np.ndarray) -> Measurement:
        """Its collisions."""
        eps = float(np.finfo(np.float32).eps)
        return measure(self.vertices(pose), self.faces, _EXACT, self.exclusions, eps)

    def names_in_contact(self, found: Measurement) -> set[str]:
        """The parts that collide, by their joints."""
        pairs = found.surface.pairs[found.overlap.pair_weights > 0]
        return {self.body.joint_names[k] for k in np.unique(self.groups[pairs])}


def _swept(pose: np.ndarray, joint: int, axis: np.ndarray, angle: float) -> np.ndarray:
    turned = pose.copy()
    turn = Rotation.from_rotvec(angle * axis) * Rotation.from_rotvec(pose[joint])
    turned[joint] = turn.as_rotvec()
    return turned


def made(world: World, seed: int = 0, scale: float = 1.0) -> list[Through]:
    """Poses of every kind.

    Args:
        world: the body.
        seed: of what is drawn.
        scale: what part of the number of each kind.
    """
    rng, mocap = np.random.default_rng(seed), load_mocap()
    poses = np.asarray(world.body.pose_from_smpl(mocap.pose), np.float64)
    found = []
    for kind, (roots, others, count, least) in KINDS.items():
        wanted = len(found) + round(scale * count)
        while len(found) < wanted:
            start = poses[rng.integers(len(poses))]
            side = ("left", "right")[rng.integers(2)]
            root = f"{side}_{roots[rng.integers(len(roots))]}"
            one = _through(world, start, root, rng, others, least)
            if one is not None:
                found.append(one._replace(kind=kind))
    return found


def _through(world: World, start, root: str, rng, others, least: float) -> Through | None:
    joint = list(world.body.joint_names).index(root)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    # A coarse look first: most axes lead nowhere.
    coarse = (world.measured(_swept(start, joint, axis, _STEP * k)).volume for k in (4, 8))
    if not any(volume > 0.3e-6 * least for volume in coarse):
        return None
    if world.measured(start).intersecting_pairs:
        return None
    sweep = [_swept(start, joint, axis, _STEP * k) for k in range(_STEPS)]
    volume = [1e6 * world.measured(pose).volume for pose in sweep]
    k = int(np.argmax(volume))
    if volume[k] < least or k == _STEPS - 1:
        return None
    names = world.names_in_contact(world.measured(sweep[k]))
    if not any(other in name for name in names for other in others):
        return None
    free = max(j for j in range(k) if volume[j] == 0)
    return Through("", sweep[k], sweep[free], volume[k])
