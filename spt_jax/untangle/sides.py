"""A limb that has passed through another part: the sides on which it could be, by a search.

The descent follows the overlap's gradient, which leads out on the side where the overlap is less
now, be it the longer way. Which side is clear is found by trying: the limb is swung about its
root, around twelve axes and farther and farther, until nothing collides, and back as far as nothing
does. From the nearest of these places the descent starts again, with weights that are too strong to
let it pass through once more.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from spt_jax.body.base import AbstractBody
from spt_jax.overlap.measure import Measurement, Unmeasurable
from spt_jax.untangle.descent import CENTIMETRE, Search, descend, is_near, turned, vertices_of

# A limb is the largest branch of the skeleton with at most this share of the surface.
_LARGEST_LIMB = 0.3
_MOST_LIMBS = 3

# A descent that moves the vertices farther than this, in metres and root mean square, may have gone
# out on the wrong side: of 1,086 frames of motion capture one in a hundred does. And from how many
# other sides it is tried again.
_FAR = 0.06
_MOST_STARTS = 3
_WEIGHTS = (3.0, 30.0, 100.0)

# By what angles it is swung, and how often the way back is halved.
_ANGLES = np.deg2rad([15.0, 30.0, 45.0, 65.0, 90.0])
_HALVINGS = 3

# The corners of an icosahedron: axes that are as far apart as twelve can be.
_GOLDEN = (1 + 5**0.5) / 2
_AXES = np.array(
    [np.roll([0, a, b * _GOLDEN], k) for k in range(3) for a in (-1, 1) for b in (-1, 1)]
) / np.sqrt(1 + _GOLDEN**2)


class Side(NamedTuple):
    """A pose without collisions that the descent found from another side.

    Attributes:
        pose, vertices: the pose, and the body in it.
        found: what was measured of it.
        steps: of the solver, over all sides.
        moved: the root mean square of how far the vertices have moved.
    """

    pose: Array
    vertices: Array
    found: Measurement
    steps: int
    moved: float


def other_side(
    search: Search, body: AbstractBody, fixed: Any, before: Measurement, after: Measurement
) -> Side | None:
    """The nearest pose without collisions on another side, where it is nearer than what was found.

    Args:
        search: what stays the same.
        body: a body whose pose is one rotation vector for each joint; others have no sides here.
        fixed: pose, shape and translation given, and the factor of the displacement.
        before: what was measured of the pose given.
        after: and of the best one that the descent found from there.
    """
    pose, shape, translation, factor = fixed
    best, steps = None, 0
    least = _rms(before.vertices, after.vertices) if search.is_free(after) else np.inf
    single = pose.shape == (len(body.parents), 3) and len(body.faces) == len(before.faces)
    if search.folds == "count" or not single or least <= _FAR:
        return None

    def look(at):
        vertices = vertices_of(body, jnp.asarray(at, pose.dtype), shape, translation)
        found = search.measure(vertices, before.faces)
        return search.is_free(found), found.vertices

    given = np.array(pose, np.float64)  # SciPy wants arrays that may be written to
    limbs = limbs_in_collision(before, body.part_groups, body.parents)
    for start in free_starts(given, limbs, look, _MOST_STARTS):
        turn = (start.pose - given)[np.asarray(body.free_rows)].ravel() / CENTIMETRE
        moved = jnp.asarray(np.asarray(factor, np.float64).T @ turn, pose.dtype)
        for weight in _WEIGHTS:
            weight = jnp.asarray(weight, pose.dtype)
            moved, taken, _ = descend(search, body, fixed, moved, search.margin, weight)
            steps += int(taken)
            at = turned(body, pose, factor, moved)
            if not is_near(at, pose):
                break
            vertices = vertices_of(body, at, shape, translation)
            try:
                found = search.measure(vertices, before.faces)
            except Unmeasurable:
                break
            if search.is_free(found):
                far = _rms(before.vertices, found.vertices)
                if far < least:
                    best, least = Side(at, vertices, found, steps, far), far
                break
    return best if best is None else best._replace(steps=steps)


def _rms(first, second) -> float:
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
                starts.append(Start(at, _rms(given, vertices)))
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
