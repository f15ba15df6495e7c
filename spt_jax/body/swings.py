"""Limbs swung about their roots until nothing collides: where else a limb could be.

A limb is swung around twelve axes and farther and farther, until nothing collides, and back as far
as nothing does. Of what lies on which side no gradient knows.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from spt_jax.overlap.measure import Measurement, Unmeasurable

# A limb is the largest branch of the skeleton with at most this share of the surface.
_LARGEST_LIMB = 0.3
_MOST_LIMBS = 3

# By what angles it is swung, and how often the way back is halved.
_ANGLES = np.deg2rad([15.0, 30.0, 45.0, 65.0, 90.0])
_HALVINGS = 3

# The corners of an icosahedron: axes that are as far apart as twelve can be.
_GOLDEN = (1 + 5**0.5) / 2
_AXES = np.array(
    [np.roll([0, a, b * _GOLDEN], k) for k in range(3) for a in (-1, 1) for b in (-1, 1)]
) / np.sqrt(1 + _GOLDEN**2)


def rms(first: Float[np.ndarray, "V 3"], second: Float[np.ndarray, "V 3"]) -> float:
    """The root mean square of how far vertices are from others, in their unit."""
    return float(np.sqrt(((second - first) ** 2).sum(axis=1).mean()))


class Start(NamedTuple):
    """A pose without collisions, and the root mean square of how far it moves the vertices."""

    pose: Float[np.ndarray, "J 3"]
    moved: float


def limbs_in_collision(
    found: Measurement, groups: Int[np.ndarray, "F"], parents: tuple[int, ...]
) -> list[int]:
    """Roots of the limbs that collide, the one with most intersections first.

    Args:
        found: the body measured.
        groups: the joint that moves each face.
        parents: the parent of each joint, -1 for a root.
    """
    faces, vertices = found.faces, found.vertices
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.bincount(groups, area, len(parents)) / area.sum()
    for joint in range(len(parents) - 1, 0, -1):  # parents come before their children
        if parents[joint] >= 0:
            share[parents[joint]] += share[joint]
    pairs = found.surface.pairs[found.overlap.pair_weights > 0]
    count = np.zeros(len(parents), np.int64)
    for joint, number in enumerate(np.bincount(groups[pairs].ravel(), minlength=len(parents))):
        root = -1
        while joint >= 0 and share[joint] <= _LARGEST_LIMB:
            root, joint = joint, parents[joint]
        if root >= 0:
            count[root] += number
    order = np.argsort(-count, kind="stable")[:_MOST_LIMBS]
    return [int(joint) for joint in order if count[joint]]


def free_starts(
    pose: Float[np.ndarray, "J 3"], limbs: list[int], look: Any, most: int
) -> list[Start]:
    """Poses without collisions, with one limb swung about its root; the nearest ones first.

    Args:
        pose: the pose given.
        limbs: roots of what may be swung.
        look: of a pose whether it is free, and the vertices.
        most: so many at most.
    """
    _, given = look(pose)
    starts = []
    for joint in limbs:
        for axis in _AXES:
            found = _along(pose, joint, axis, look)
            if found is not None:
                at, vertices = found
                starts.append(Start(at, rms(given, vertices)))
    return sorted(starts, key=lambda start: start.moved)[:most]


def _along(pose, joint: int, axis, look):
    """The first free pose along one swing, and its vertices."""
    before, found, angle = 0.0, None, 0.0
    for angle in _ANGLES:
        found = _looked(_swung(pose, joint, angle * axis), look)
        if found is not None:
            break
        before = angle
    if found is None:
        return None
    for _ in range(_HALVINGS):
        middle = (before + angle) / 2
        nearer = _looked(_swung(pose, joint, middle * axis), look)
        if nearer is None:
            before = middle
        else:
            angle, found = middle, nearer
    return found


def _looked(pose, look):
    try:
        free, vertices = look(pose)
    except Unmeasurable:
        return None
    return (pose, vertices) if free else None


def _swung(pose, joint: int, turn) -> Float[np.ndarray, "J 3"]:
    """The pose with a joint turned in its parent's frame; its vector stays near the one given."""
    given = pose[joint]
    found = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(given)).as_rotvec()
    length = np.linalg.norm(found)
    if length > 0:
        # The same rotation by other vectors along the same line: a full turn more or less.
        others = [found + k * 2 * np.pi * found / length for k in (-1, 0, 1)]
        found = min(others, key=lambda one: np.linalg.norm(one - given))
    swung = pose.copy()
    swung[joint] = found
    return swung
