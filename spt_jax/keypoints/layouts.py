"""The orders in which data sets and detectors list keypoints, in one vocabulary of names."""

from typing import NamedTuple

from spt_jax.body.poses import SMPL_LAYOUTS


class Layout(NamedTuple):
    """One order of keypoints.

    Names are SMPL's joint names wherever a keypoint corresponds to one ("left_hip", "neck"), and
    for the rest nose, left_eye, left_ear, left_big_toe, left_small_toe, left_heel, head_top, spine,
    thorax, with right_ for left_. Left is the person's own.

    Attributes:
        name: what functions call it.
        names: the keypoints, in order.
        official: the keypoints as the source calls them.
        edges: pairs of keypoints to draw lines between; `edge_side` tells left from right.
        points: where each keypoint lies on a body: a joint, a landmark, or one of
            `spt_jax.keypoints.regressor.COMBINATIONS`.
        sigmas: COCO's standard deviation of an annotated point, per square root of the person's
            area; None where the source states none.
        surface: whether a name that is both a landmark and a joint of some body, such as left_eye,
            means the landmark on the skin.
    """

    name: str
    names: tuple[str, ...]
    official: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    points: tuple[str, ...]
    sigmas: tuple[float, ...] | None = None
    surface: bool = True


def side(name: str) -> str:
    """Tell "left", "right" or "middle" of a keypoint's name.

    Example:
        >>> from spt_jax.keypoints.layouts import side
        >>> side("left_knee"), side("nose")
        ('left', 'middle')
    """
    for word in ("left", "right"):
        if name.startswith(f"{word}_"):
            return word
    return "middle"


def edge_side(layout: Layout, edge: tuple[int, int]) -> str:
    """Tell "left", "right" or "middle" of a line: the side of the ends, where they agree on one.

    Example:
        >>> from spt_jax.keypoints.layouts import LAYOUTS, edge_side
        >>> edge_side(LAYOUTS["body25"], (8, 9)), edge_side(LAYOUTS["coco17"], (5, 6))
        ('right', 'middle')
    """
    sides = {side(layout.names[end]) for end in edge} - {"middle"}
    return sides.pop() if len(sides) == 1 else "middle"


# What of a layout's keypoints is not the joint or landmark of its own name.
_AT = {
    # Annotators and detectors put hips farther out than SMPL's joints lie.
    "left_hip": "left_wide_hip",
    "right_hip": "right_wide_hip",
    "pelvis": "between_hips",
    "neck": "between_shoulders",
    "thorax": "between_shoulders",
    "spine": "mid_spine",
}

_OPENPOSE = {
    **{"Nose": "nose", "Neck": "neck", "MidHip": "pelvis"},
    **{
        f"{letter}{part}": f"{word}_{name}"
        for letter, word in (("R", "right"), ("L", "left"))
        for part, name in (
            *(("Shoulder", "shoulder"), ("Elbow", "elbow"), ("Wrist", "wrist"), ("Hip", "hip")),
            *(("Knee", "knee"), ("Ankle", "ankle"), ("Eye", "eye"), ("Ear", "ear")),
            *(("BigToe", "big_toe"), ("SmallToe", "small_toe"), ("Heel", "heel")),
        )
    },
}


def _layout(name, names, edges, official=None, sigmas=None, at=_AT, surface=True) -> Layout:
    names = tuple(names)
    points = tuple(at.get(keypoint, keypoint) for keypoint in names)
    return Layout(name, names, tuple(official or names), tuple(edges), points, sigmas, surface)


# https://cocodataset.org/#format-data: the "keypoints" and "skeleton" (counted from 1 there) of
# person_keypoints_*.json; sigmas from https://cocodataset.org/#keypoints-eval, section 1.3.
_COCO = _layout(
    "coco17",
    (
        *("nose", "left_eye", "right_eye", "left_ear", "right_ear"),
        *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
        *("left_wrist", "right_wrist", "left_hip", "right_hip"),
        *("left_knee", "right_knee", "left_ankle", "right_ankle"),
    ),
    (
        *((15, 13), (13, 11), (16, 14), (14, 12), (11, 12), (5, 11), (6, 12), (5, 6), (5, 7)),
        *((6, 8), (7, 9), (8, 10), (1, 2), (0, 1), (0, 2), (1, 3), (2, 4), (3, 5), (4, 6)),
    ),
    sigmas=(
        *(0.026, 0.025, 0.025, 0.035, 0.035, 0.079, 0.079, 0.072, 0.072),
        *(0.062, 0.062, 0.107, 0.107, 0.087, 0.087, 0.089, 0.089),
    ),
)

# https://github.com/CMU-Perceptual-Computing-Lab/openpose/blob/master/doc/02_output.md and
# src/openpose/pose/poseParameters.cpp (POSE_BODY_25_BODY_PARTS, POSE_BODY_25_PAIRS_RENDER).
_BODY_25_NAMES = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar"),
    *("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"),
)
_BODY_25 = _layout(
    "body25",
    (_OPENPOSE[part] for part in _BODY_25_NAMES),
    (
        *((1, 8), (1, 2), (1, 5), (2, 3), (3, 4), (5, 6), (6, 7), (8, 9), (9, 10), (10, 11)),
        *((8, 12), (12, 13), (13, 14), (1, 0), (0, 15), (15, 17), (0, 16), (16, 18)),
        *((14, 19), (19, 20), (14, 21), (11, 22), (22, 23), (11, 24)),
    ),
    _BODY_25_NAMES,
)

# The same file's POSE_COCO_BODY_PARTS: COCO's keypoints and the neck, in OpenPose's own order.
_OPENPOSE_18_NAMES = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar"),
)
_OPENPOSE_18 = _layout(
    "openpose18",
    (_OPENPOSE[part] for part in _OPENPOSE_18_NAMES),
    (
        *((1, 2), (1, 5), (2, 3), (3, 4), (5, 6), (6, 7), (1, 8), (8, 9), (9, 10)),
        *((1, 11), (11, 12), (12, 13), (1, 0), (0, 14), (14, 16), (0, 15), (15, 17)),
    ),
    _OPENPOSE_18_NAMES,
)

# The 17 of Human3.6M's 32 joints that are evaluated, 0 1 2 3 6 7 8 12 13 14 15 17 18 19 25 26 27:
# Martinez et al. 2017, https://github.com/una-dinosauria/3d-pose-baseline, src/data_utils.py.
# Joint 9, "Neck/Nose", is the motion capture's joint between neck and head, moved to the front.
_H36M = _layout(
    "h36m17",
    (
        *("pelvis", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee"),
        *("left_ankle", "spine", "thorax", "head", "head_top", "left_shoulder", "left_elbow"),
        *("left_wrist", "right_shoulder", "right_elbow", "right_wrist"),
    ),
    (
        *((0, 1), (1, 2), (2, 3), (0, 4), (4, 5), (5, 6), (0, 7), (7, 8), (8, 9), (9, 10)),
        *((8, 11), (11, 12), (12, 13), (8, 14), (14, 15), (15, 16)),
    ),
    (
        *("Hip", "RHip", "RKnee", "RFoot", "LHip", "LKnee", "LFoot", "Spine", "Thorax"),
        *("Neck/Nose", "Head", "LShoulder", "LElbow", "LWrist", "RShoulder", "RElbow", "RWrist"),
    ),
    at={**_AT, "head": "mid_face"},
)

_TREE = {
    **{"spine1": "pelvis", "spine2": "spine1", "spine3": "spine2", "neck": "spine3"},
    **{"head": "neck", "jaw": "head", "eye": "head", "hip": "pelvis", "knee": "hip"},
    **{"ankle": "knee", "foot": "ankle", "collar": "spine3", "shoulder": "collar"},
    **{"elbow": "shoulder", "wrist": "elbow", "hand": "wrist"},
}


def _smpl(count: int) -> Layout:
    names = SMPL_LAYOUTS[count]
    edges = []
    for k, name in enumerate(names[1:], start=1):
        prefix = "" if side(name) == "middle" else f"{side(name)}_"
        part = name.removeprefix(prefix)
        if part in _TREE:
            parent = _TREE[part]
        else:  # a finger's joint, counted from the hand
            parent = "wrist" if part[-1] == "1" else f"{part[:-1]}{int(part[-1]) - 1}"
        if f"{prefix}{parent}" in names:
            parent = f"{prefix}{parent}"
        edges.append((names.index(parent), k))
    return _layout(f"smpl{count}", names, edges, at={}, surface=False)


#: Every layout by its name.
LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (_COCO, _BODY_25, _OPENPOSE_18, _H36M, *(_smpl(count) for count in SMPL_LAYOUTS))
}


def as_layout(name: str, count: int | None = None) -> Layout:
    """The layout of that name; "smpl" is SMPL's with `count` joints.

    Args:
        name: a key of LAYOUTS, or "smpl".
        count: how many keypoints there are, where that is known.

    Returns:
        The layout, which has `count` keypoints.

    Raises:
        TypeError: `name` is no string.
        ValueError: an unknown name; "smpl" without a count or with one that no body of the family
            has; another count than the layout's.

    Example:
        >>> from spt_jax.keypoints.layouts import as_layout
        >>> as_layout("smpl", 24).names[22], as_layout("body25").names[8]
        ('left_hand', 'pelvis')
    """
    if not isinstance(name, str):
        raise TypeError(f"a layout must be named by a string: got {name!r}.")
    if name == "smpl":
        if count not in SMPL_LAYOUTS:
            counts = ", ".join(str(known) for known in SMPL_LAYOUTS)
            raise ValueError(
                f'layout "smpl" must have {counts} keypoints: got '
                f'{"no count" if count is None else count}; write "smpl24" for SMPL\'s own.'
            )
        return LAYOUTS[f"smpl{count}"]
    if name not in LAYOUTS:
        known = ", ".join(f'"{key}"' for key in LAYOUTS)
        raise ValueError(f'layout must be one of {known} or "smpl": got {name!r}.')
    layout = LAYOUTS[name]
    if count is not None and count != len(layout.names):
        raise ValueError(
            f"layout {name} has {len(layout.names)} keypoints: got {count}; name the layout in "
            "which your keypoints are."
        )
    return layout
