"""Bodies: the orders of COCO, OpenPose, Human3.6M, MPII, AIC, CrowdPose, PoseTrack and SMPL."""

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.keypoints.layout import USUAL_PLACES, Layout, make_layout, side

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


# https://cocodataset.org/#format-data: the "keypoints" and "skeleton" (counted from 1 there) of
# person_keypoints_*.json; sigmas from https://cocodataset.org/#keypoints-eval, section 1.3.
COCO = make_layout(
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
BODY_25 = make_layout(
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
OPENPOSE_18 = make_layout(
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
H36M = make_layout(
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
    at={**USUAL_PLACES, "head": "mid_face"},
)


# https://github.com/open-mmlab/mmpose, configs/_base_/datasets/mpii.py: the order of MPII's own
# annotations (http://human-pose.mpi-inf.mpg.de).
MPII = make_layout(
    "mpii16",
    (
        *("right_ankle", "right_knee", "right_hip", "left_hip", "left_knee", "left_ankle"),
        *("pelvis", "thorax", "upper_neck", "head_top", "right_wrist", "right_elbow"),
        *("right_shoulder", "left_shoulder", "left_elbow", "left_wrist"),
    ),
    (
        *((0, 1), (1, 2), (2, 6), (6, 3), (3, 4), (4, 5), (6, 7), (7, 8), (8, 9), (8, 12)),
        *((12, 11), (11, 10), (8, 13), (13, 14), (14, 15)),
    ),
)

# configs/_base_/datasets/aic.py there: AI Challenger's 14 points.
AIC = make_layout(
    "aic14",
    (
        *("right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow"),
        *("left_wrist", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee"),
        *("left_ankle", "head_top", "neck"),
    ),
    (
        *((2, 1), (1, 0), (0, 13), (13, 3), (3, 4), (4, 5), (8, 7), (7, 6), (6, 9), (9, 10)),
        *((10, 11), (12, 13), (0, 6), (3, 9)),
    ),
)

# configs/_base_/datasets/crowdpose.py there.
CROWDPOSE = make_layout(
    "crowdpose14",
    (
        *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist"),
        *("right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle"),
        *("right_ankle", "head_top", "neck"),
    ),
    (
        *((10, 8), (8, 6), (11, 9), (9, 7), (6, 7), (0, 6), (1, 7), (0, 1), (0, 2), (1, 3)),
        *((2, 4), (3, 5), (12, 13), (1, 13), (0, 13)),
    ),
    (
        *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist"),
        *("right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle"),
        *("right_ankle", "top_head", "neck"),
    ),
)

# configs/_base_/datasets/posetrack18.py there.
POSETRACK = make_layout(
    "posetrack17",
    ("nose", "upper_neck", "head_top", *COCO.names[3:]),
    (
        *((15, 13), (13, 11), (16, 14), (14, 12), (11, 12), (5, 11), (6, 12), (5, 6), (5, 7)),
        *((6, 8), (7, 9), (8, 10), (0, 1), (0, 2), (1, 5), (1, 6), (0, 3), (0, 4)),
    ),
    ("nose", "head_bottom", "head_top", *COCO.names[3:]),
)

# configs/_base_/datasets/jhmdb.py there; its head is the middle of the head.
JHMDB = make_layout(
    "jhmdb15",
    (
        *("upper_neck", "spine", "head", "right_shoulder", "left_shoulder", "right_hip"),
        *("left_hip", "right_elbow", "left_elbow", "right_knee", "left_knee", "right_wrist"),
        *("left_wrist", "right_ankle", "left_ankle"),
    ),
    (
        *((13, 9), (9, 5), (5, 1), (1, 6), (6, 10), (10, 14), (1, 0), (0, 2), (0, 3), (3, 7)),
        *((7, 11), (0, 4), (4, 8), (8, 12)),
    ),
    (
        *("neck", "belly", "head", "right_shoulder", "left_shoulder", "right_hip"),
        *("left_hip", "right_elbow", "left_elbow", "right_knee", "left_knee", "right_wrist"),
        *("left_wrist", "right_ankle", "left_ankle"),
    ),
    at={**USUAL_PLACES, "head": "mid_face"},
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
    return make_layout(f"smpl{count}", names, edges, at={}, surface=False)


BODIES: tuple[Layout, ...] = (
    *(COCO, BODY_25, OPENPOSE_18, H36M, MPII, AIC, CROWDPOSE, POSETRACK, JHMDB),
    *(_smpl(count) for count in SMPL_LAYOUTS),
)
