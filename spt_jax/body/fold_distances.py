"""How far apart the skin of a body must be at rest for an intersection to be a collision."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

# Trunk and limbs: separates arms from the trunk, and keeps armpits, groins, elbows and knees
# together.
BODY_DISTANCE = 0.3

# What is no thicker around than this part of that distance is a finger, a toe or a jaw and no limb.
# Of the embedded body the thumb's root has 0.12 m, other fingers 0.03 to 0.08, wrists 0.17, elbows
# 0.20 and all else more.
_SLIM = 0.45
# Of its girth. Where the embedded body's fingers are bent by 90 degrees at the root, or by 100 at
# the middle knuckle, the crease joins skin up to 0.045 m apart, 0.62 of the girth there: a finger
# that is bent no farther collides neither with itself nor with the palm's fold. What goes through
# another finger or the palm is 0.06 m apart and more.
_CREASE = 0.65
# At most so much of the distance for the body: the thumb's root is as thick as two fingers.
_MOST = 1.0 / 6.0


def fold_distances(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    weights: Float[np.ndarray, "V J"],
    joints: Float[np.ndarray, "J 3"],
    parents: Sequence[int],
    distance: float = BODY_DISTANCE,
) -> Float[np.ndarray, "F"]:
    """For each face the distance at rest up to which an intersection there is a fold.

    A joint is as thick as the skin that moves most with it lies from its bone (the median, times 2
    pi). Where that is a limb's girth, `distance` holds; a finger's own girth decides for it, the
    largest along the finger.

    Args:
        vertices, faces: the body at rest.
        weights: of each vertex to each joint.
        joints: positions.
        parents: of each joint, -1 for the root.
        distance: for trunk and limbs.
    """
    owner = weights.argmax(axis=1)
    children: list[list[int]] = [[] for _ in parents]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(joint)
    allowed = np.full(len(parents), distance)
    for joint, parent in enumerate(parents):
        skin = vertices[owner == joint] - joints[joint]
        if children[joint]:
            bone = joints[children[joint]].mean(axis=0) - joints[joint]
        else:
            bone = joints[joint] - joints[max(parent, 0)]
        length = np.linalg.norm(bone)
        if not len(skin) or not length > 0:
            allowed[joint] = allowed[parent] if parent >= 0 else distance
            continue
        away = np.linalg.norm(np.cross(skin, bone / length), axis=1)
        girth = 2 * np.pi * float(np.median(away))
        if girth < _SLIM * distance:
            own = min(_CREASE * girth, _MOST * distance)
            inherited = allowed[parent] if parent >= 0 else distance
            # A finger's tip is as thick as the finger.
            allowed[joint] = max(own, inherited) if inherited < distance else own
    corners = weights[faces[:, 0]] + weights[faces[:, 1]] + weights[faces[:, 2]]
    return allowed[corners.argmax(axis=1)]
