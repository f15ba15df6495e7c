"""How a BVH's skeleton stands where SMPL's stands in its T pose.

A joint of BVH turns axes of its own, and where these point in a T pose is every program's choice.
Three are known, and tried in this order:

1. The zero pose is a T or A pose: the axes are the world's, as Biovision, Mixamo and CMU have them.
   It may face any side, and z may be up.
2. The axes follow the bones, x along each, as in LAFAN1 (Harvey et al., "Robust Motion
   In-betweening", 2020) and other exports of MotionBuilder: in the zero pose all bones lie along x.
3. The first frame is a T or A pose, as calibrations are.

`B` of a joint are its axes in such a stance, as columns. What turns SMPL's rest pose into the
joint's axes is then R = B^T F A, where F is the side to which the stance faces, and A turns a bone
of SMPL's T to where the stance has it (an A pose). A frame's turn against its parent is
R_parent^T turn R.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spt_jax.io.poses.bvh_tree import Joint

# Beyond this the bones do not say how a joint is turned about its own bone.
_MOST_DEGREES = 75.0
# As far as bones of one stance differ between skeletons: less is anatomy, more is an A pose.
_ANATOMY = 15.0

_LEFT, _RIGHT = np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])
_UP, _DOWN = np.array([0.0, 1.0, 0.0]), np.array([0.0, -1.0, 0.0])
_FORWARD, _BACK = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])

# Towards which joint a bone runs, and its direction in SMPL's T pose: y up, x to the left.
_TOWARDS: dict[str, tuple[str, np.ndarray]] = {
    **{f"{side}_hip": (f"{side}_knee", _DOWN) for side in ("left", "right")},
    **{f"{side}_knee": (f"{side}_ankle", _DOWN) for side in ("left", "right")},
    "left_shoulder": ("left_elbow", _LEFT),
    "left_elbow": ("left_wrist", _LEFT),
    "right_shoulder": ("right_elbow", _RIGHT),
    "right_elbow": ("right_wrist", _RIGHT),
}

# Where x and y of joints point whose x runs along the bone; the foot is on the ground, so that its
# bone falls from the ankle to the ball, by as much on LAFAN1's skeleton as on SMPL's.
_FALL = np.radians(25.0)
_ALONG: dict[str, tuple[np.ndarray, np.ndarray]] = {
    **dict.fromkeys(("pelvis", "spine1", "spine2", "spine3", "neck", "head"), (_UP, _FORWARD)),
    **{
        f"{side}_{joint}": axes
        for side in ("left", "right")
        for joint, axes in {
            "hip": (_DOWN, _FORWARD),
            "knee": (_DOWN, _FORWARD),
            "ankle": (
                np.cos(_FALL) * _FORWARD + np.sin(_FALL) * _DOWN,
                np.cos(_FALL) * _UP + np.sin(_FALL) * _FORWARD,
            ),
            "foot": (_FORWARD, _UP),
        }.items()
    },
    **{f"left_{joint}": (_LEFT, _BACK) for joint in ("collar", "shoulder", "elbow", "wrist")},
    **{f"right_{joint}": (_RIGHT, _BACK) for joint in ("collar", "shoulder", "elbow", "wrist")},
}


class Rest(NamedTuple):
    """The stance in which SMPL's body is in its T pose.

    Attributes:
        turns: what turns SMPL's rest pose into the axes of each joint that is known.
        above: what stands before a joint's own rotation, for each of them: with it the rotations of
            unknown joints between it and the known one above are those of the stance.
        places: of all joints then, in SMPL's axes and the file's unit.
        note: what had to be decided, as a sentence.
    """

    turns: dict[int, np.ndarray]
    above: dict[int, np.ndarray]
    places: np.ndarray
    note: str

    @property
    def height(self) -> float:
        """From the lowest to the highest point, or across, in the file's unit."""
        return float(np.ptp(self.places, axis=0).max())


class _MisfitError(Exception):
    """A stance is no T or A pose; the message says which bone is how far off."""


def rest_of(
    joints: Sequence[Joint],
    found: Mapping[str, int],
    first_frame: Callable[[], list[np.ndarray]],
    file: str,
) -> Rest:
    """The first of the stances that is a T or A pose.

    Args:
        joints: of the file.
        found: which of them is which of SMPL's.
        first_frame: gives each joint's rotation against its parent in the first frame.
        file: what messages call the file.

    Raises:
        ValueError: none of them is one; the message says how far off the zero pose is.
    """
    misfit = None
    for kind, axes in _stances(joints, found, first_frame):
        try:
            return _rest(joints, found, axes, kind)
        except _MisfitError as error:
            misfit = misfit or error
    raise ValueError(
        "the skeleton must rest in a T or A pose, or stand in one in its first frame, or have x "
        f"along its bones as LAFAN1 has: got {file!r}, which rests with {misfit}; set the T pose "
        "as its rest pose in the program that wrote it, such as Blender"
    )


def _stances(
    joints: Sequence[Joint],
    found: Mapping[str, int],
    first_frame: Callable[[], list[np.ndarray]],
) -> Iterator[tuple[str, list[np.ndarray]]]:
    """Each joint's axes in the stances that are known, parents before children."""
    yield "rest", [np.eye(3) for _ in joints]
    names = {k: name for name, k in found.items()}
    along: list[np.ndarray] = []
    for k, joint in enumerate(joints):
        axes = _ALONG.get(names.get(k, ""))
        if axes is not None:
            along.append(np.stack([*axes, np.cross(*axes)], axis=1))
        else:
            along.append(along[joint.parent] if joint.parent >= 0 else np.eye(3))
    yield "along", along
    frame: list[np.ndarray] = []
    for joint, turn in zip(joints, first_frame(), strict=True):
        frame.append(frame[joint.parent] @ turn if joint.parent >= 0 else turn)
    yield "frame", frame


def _rest(
    joints: Sequence[Joint], found: Mapping[str, int], axes: list[np.ndarray], kind: str
) -> Rest:
    """The stance with these axes.

    Raises:
        _MisfitError: it is no T or A pose.
    """
    places = _places(joints, axes)
    facing = _facing(places, found, snapped=kind != "frame")
    if kind == "along" and not np.array_equal(facing, np.eye(3)):
        raise _MisfitError("another side in front")
    largest, hanging = 0.0, {}
    for name, (child, direction) in _TOWARDS.items():
        if name not in found or child not in found:
            continue
        bone = facing.T @ (places[found[child]] - places[found[name]])
        length = np.linalg.norm(bone)
        if not length > 0:
            continue
        turn, angle = _between(direction, bone / length)
        if angle > (_ANATOMY if kind == "along" else _MOST_DEGREES):
            raise _MisfitError(f"{joints[found[name]].name} {angle:.0f} degrees off")
        if angle > _ANATOMY:
            largest = max(largest, angle)
            hanging[found[name]] = turn
    known = sorted(found.values())
    turns = {k: axes[k].T @ facing @ hanging.get(k, np.eye(3)) for k in known}
    above = {}
    for k in known:
        parent, up = joints[k].parent, joints[k].parent
        while up >= 0 and up not in turns:
            up = joints[up].parent
        if up < 0:
            above[k] = axes[parent] if parent >= 0 else np.eye(3)
        else:
            above[k] = turns[up].T @ axes[up].T @ axes[parent]
    bodily = [facing.T @ one for one in axes]
    return Rest(turns, above, _places(joints, bodily), _said(kind, largest, facing))


def _places(joints: Sequence[Joint], axes: Sequence[np.ndarray]) -> np.ndarray:
    """Where joints are whose axes these are."""
    places = np.zeros((len(joints), 3))
    for k, joint in enumerate(joints):
        if joint.parent >= 0:
            places[k] = places[joint.parent] + axes[joint.parent] @ joint.offset
    return places


def _facing(places: np.ndarray, found: Mapping[str, int], *, snapped: bool) -> np.ndarray:
    """Which way is left, up and forward, as columns, from the hips and shoulders.

    Args:
        places: of all joints.
        found: which of them is which.
        snapped: whether it is one of the 24 ways along the axes: skeletons that rest do, and how
            the trunk leans is their anatomy.

    Raises:
        _MisfitError: hips and shoulders do not say it.
    """
    hips = [places[found[f"{side}_hip"]] for side in ("left", "right")]
    arms = [places[found[f"{side}_shoulder"]] for side in ("left", "right")]
    up = arms[0] + arms[1] - hips[0] - hips[1]
    left = hips[0] - hips[1] + arms[0] - arms[1]
    length = np.linalg.norm(up)
    across = left - up * (left @ up) / length**2 if length > 0 else left
    if not length > 0 or not np.linalg.norm(across) > 0.1 * np.linalg.norm(left):
        raise _MisfitError("hips and shoulders in one place, or in one line")
    up, left = up / length, across / np.linalg.norm(across)
    facing = np.stack([left, up, np.cross(left, up)], axis=1)
    return max(_CUBE, key=lambda one: np.sum(one * facing)) if snapped else facing


_CUBE = [
    matrix
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(matrix := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
]


def _between(direction: np.ndarray, bone: np.ndarray) -> tuple[np.ndarray, float]:
    """The smallest turn from one direction to another, and its angle in degrees."""
    angle = float(np.degrees(np.arccos(np.clip(bone @ direction, -1, 1))))
    axis = np.cross(direction, bone)
    size = np.linalg.norm(axis)
    if not size > 0:
        return np.eye(3), angle
    return Rotation.from_rotvec(axis / size * np.radians(angle)).as_matrix(), angle


def _said(kind: str, hanging: float, facing: np.ndarray) -> str:
    """What had to be decided."""
    if kind == "along":
        return "x of the skeleton's joints is taken to run along its bones, as in LAFAN1"
    if kind == "frame":
        return "the first frame is taken for the T pose, since the skeleton does not rest in one"
    said = []
    if hanging:
        said.append(f"the skeleton's rest pose is turned into SMPL's T, by {hanging:.0f} degrees")
    if not np.array_equal(facing, np.eye(3)):
        _, up, front = map(_axis, facing.T)
        said.append(f"the skeleton rests with {up} up and {front} in front")
    return "; ".join(said)


def _axis(direction: np.ndarray) -> str:
    """Which axis a direction is, such as "-y"."""
    k = int(np.abs(direction).argmax())
    return ("-" if direction[k] < 0 else "") + "xyz"[k]
