"""Whole bodies: feet, hands and faces beside a body's points."""

from itertools import pairwise

from spt_jax.keypoints.body_tables import BODY_25, COCO, OPENPOSE_18
from spt_jax.keypoints.layout import USUAL_PLACES, Layout, make_layout

_SIDES = ("left", "right")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_WHERE_FACES_LIE = dict.fromkeys((f"face{k}" for k in range(70)), "")


def hand_names(side: str) -> tuple[str, ...]:
    """The 21 points of a hand: its root, and four of each finger from the palm to the tip.

    So OpenPose, MediaPipe, COCO-WholeBody and Halpe have them. SMPL's finger joints are the first
    three: of the thumb the joints of its metacarpal, its knuckle and its one joint.
    """
    rows = [
        (*(f"{side}_{finger}{k}" for k in (1, 2, 3)), f"{side}_{finger}_tip") for finger in _FINGERS
    ]
    return (f"{side}_hand_root", *(name for row in rows for name in row))


def _hand_edges(root: int) -> list[tuple[int, int]]:
    """Lines of a hand whose root is that row."""
    chains = [(root, *range(root + 1 + 4 * k, root + 5 + 4 * k)) for k in range(len(_FINGERS))]
    return [edge for chain in chains for edge in pairwise(chain)]


def _with_hands(body: Layout) -> Layout:
    """A body's points, then those of the left hand and of the right, as in OpenPose's files."""
    count = len(body.names)
    wrists = [body.names.index(f"{side}_wrist") for side in _SIDES]
    roots = [count, count + 21]
    return make_layout(
        f"{body.name}_hands",
        (*body.names, *hand_names("left"), *hand_names("right")),
        (
            *body.edges,
            *zip(wrists, roots, strict=True),
            *_hand_edges(roots[0]),
            *_hand_edges(roots[1]),
        ),
        (*body.official, *hand_names("left"), *hand_names("right")),
    )


def _face(count: int) -> tuple[str, ...]:
    return tuple(f"face{k}" for k in range(count))


def _official_hands() -> list[str]:
    names = dict(
        zip(
            _FINGERS,
            ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger"),
            strict=True,
        )
    )
    return [
        name
        for side in _SIDES
        for name in (
            f"{side}_hand_root",
            *(f"{side}_{names[f]}{k}" for f in _FINGERS for k in range(1, 5)),
        )
    ]


_FEET = tuple(f"{side}_{part}" for side in _SIDES for part in ("big_toe", "small_toe", "heel"))
_FOOT_EDGES = tuple(
    (COCO.names.index(f"{name.split('_')[0]}_ankle"), 17 + k) for k, name in enumerate(_FEET)
)
_COCO_23 = make_layout("coco23", (*COCO.names, *_FEET), (*COCO.edges, *_FOOT_EDGES))

# https://github.com/jin-s13/COCO-WholeBody: 17 body, 6 feet, 68 face, 21 of each hand.
_WHOLEBODY = make_layout(
    "wholebody133",
    (*_COCO_23.names, *_face(68), *hand_names("left"), *hand_names("right")),
    (*_COCO_23.edges, (9, 91), (10, 112), *_hand_edges(91), *_hand_edges(112)),
    (*_COCO_23.names, *(f"face-{k}" for k in range(68)), *_official_hands()),
    at=USUAL_PLACES | _WHERE_FACES_LIE,
)

# https://github.com/Fang-Haoshu/Halpe-FullBody: head is its top, hip the middle of the hips.
_HALPE_BODY = (
    *(*COCO.names, "head_top", "neck", "pelvis", "left_big_toe", "right_big_toe"),
    *("left_small_toe", "right_small_toe", "left_heel", "right_heel"),
)
_HALPE_OFFICIAL = tuple(
    {"head_top": "head", "pelvis": "hip"}.get(name, name) for name in _HALPE_BODY
)
_HALPE_EDGES = (
    *((15, 13), (13, 11), (11, 19), (16, 14), (14, 12), (12, 19), (17, 18), (18, 19), (18, 5)),
    *((5, 7), (7, 9), (18, 6), (6, 8), (8, 10), (1, 2), (0, 1), (0, 2), (1, 3), (2, 4)),
    *((15, 20), (15, 22), (15, 24), (16, 21), (16, 23), (16, 25)),
)
_HALPE_26 = make_layout("halpe26", _HALPE_BODY, _HALPE_EDGES, _HALPE_OFFICIAL)
_HALPE_136 = make_layout(
    "halpe136",
    (*_HALPE_BODY, *_face(68), *hand_names("left"), *hand_names("right")),
    (*_HALPE_EDGES, (9, 94), (10, 115), *_hand_edges(94), *_hand_edges(115)),
    (*_HALPE_OFFICIAL, *(f"face-{k}" for k in range(68)), *_official_hands()),
    at=USUAL_PLACES | _WHERE_FACES_LIE,
)

# https://ai.google.dev/edge/mediapipe/solutions/vision/pose_landmarker: eyes have three points of
# which the middle one is used, hands a knuckle of pinky, index and thumb, feet their big toe.
_MEDIAPIPE_NAMES = (
    *("nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye"),
    *("right_eye_outer", "left_ear", "right_ear", "left_mouth", "right_mouth"),
    *(f"{side}_{part}" for part in ("shoulder", "elbow", "wrist") for side in _SIDES),
    *(f"{side}_{part}" for part in ("pinky1", "index1", "thumb2") for side in _SIDES),
    *(f"{side}_{part}" for part in ("hip", "knee", "ankle", "heel", "big_toe") for side in _SIDES),
)
_MEDIAPIPE = make_layout(
    "mediapipe33",
    _MEDIAPIPE_NAMES,
    (
        *((0, 2), (2, 7), (0, 5), (5, 8), (11, 12), (11, 13), (13, 15), (15, 17), (15, 19)),
        *((15, 21), (12, 14), (14, 16), (16, 18), (16, 20), (16, 22), (11, 23), (12, 24)),
        *((23, 24), (23, 25), (25, 27), (27, 29), (27, 31), (24, 26), (26, 28), (28, 30), (28, 32)),
    ),
    (
        *(*_MEDIAPIPE_NAMES[:9], "mouth_left", "mouth_right", *_MEDIAPIPE_NAMES[11:17]),
        *(f"{side}_{part}" for part in ("pinky", "index", "thumb") for side in _SIDES),
        *(*_MEDIAPIPE_NAMES[23:31], "left_foot_index", "right_foot_index"),
    ),
    at=USUAL_PLACES
    | {f"{side}_{part}": "" for side in _SIDES for part in ("eye_inner", "eye_outer", "mouth")},
)

# https://github.com/open-mmlab/mmpose, configs/_base_/datasets/humanart21.py.
_HUMAN_ART = make_layout(
    "humanart21",
    (*COCO.names, "left_middle_tip", "right_middle_tip", "left_big_toe", "right_big_toe"),
    (*COCO.edges, (9, 17), (10, 18), (15, 19), (16, 20)),
    (*COCO.names, "left_finger", "right_finger", "left_toe", "right_toe"),
)

_HANDS = tuple(make_layout(f"{side}_hand21", hand_names(side), _hand_edges(0)) for side in _SIDES)

WHOLE_BODIES: tuple[Layout, ...] = (
    *(_COCO_23, _WHOLEBODY, _HALPE_26, _HALPE_136, _MEDIAPIPE, _HUMAN_ART),
    *(_with_hands(BODY_25), _with_hands(OPENPOSE_18), *_HANDS),
)
