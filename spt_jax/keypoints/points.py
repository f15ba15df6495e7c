"""Points of a body between its joints: what data sets call a neck, a hip or a spine."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from jax.core import Tracer

from spt_jax.body import BodyModel
from spt_jax.keypoints.landmarks import LANDMARKS

# COCO's and OpenPose's hips are about two thirds as far apart as their shoulders, 0.24 m on an
# adult, and that is 0.65 of the width of the skin there. SMPL's hip joints are about a third of
# that width apart, the embedded body's 0.60 of it.
_HIP_WIDTH = 0.65
_AROUND_HIPS = ("pelvis", "left_hip", "right_hip", "spine1")
_SPINE = ("pelvis", "spine1", "spine2", "spine3")
_TRUNK = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")

#: Points that are none of a body's joints or landmarks, and what they are.
COMBINATIONS: dict[str, str] = {
    "between_shoulders": "half-way between the shoulder joints",
    "between_hips": "half-way between the hip joints",
    "left_wide_hip": "on the line of the hip joints, at 0.65 of the skin's half width there at "
    "rest, or at the joint where that is farther out",
    "right_wide_hip": "as left_wide_hip",
    "mid_spine": "on the chain pelvis, spine1, spine2, spine3, half-way from the hips up to the "
    "shoulders at rest",
    "upper_neck": "half-way between the joints of neck and head",
    "mid_face": "half-way between the head joint and the nose",
    "left_hand": "in the middle of the first knuckles of index, middle, ring and pinky, where no "
    "joint is so named",
    "right_hand": "as left_hand",
}


def needs_landmarks(points: Iterable[str], joints: set[str], surface: bool) -> bool:
    """Whether one of the points lies on the surface, rather than at one of the joints."""
    return any(
        point == "mid_face" or (point in LANDMARKS and (surface or point not in joints))
        for point in points
    )


def weights_of(body: BodyModel, point: str) -> dict[str, float]:
    """The joints and landmarks of which a point is the weighted sum.

    Args:
        body: the body; for hips and spine its rest surface and joints are read.
        point: a joint, a landmark or one of COMBINATIONS.

    Returns:
        A weight for each name, summing to 1. Of a name that is none of those, itself.

    Raises:
        TypeError: the body is traced, and the point depends on its measures.

    Example:
        >>> from spt_jax.body import load_body
        >>> from spt_jax.keypoints.points import weights_of
        >>> weights_of(load_body(), "between_hips")
        {'left_hip': 0.5, 'right_hip': 0.5}
    """
    if point in body.joint_names:
        return {point: 1.0}
    if point in ("between_shoulders", "between_hips"):
        part = point.removeprefix("between_").removesuffix("s")
        return {f"left_{part}": 0.5, f"right_{part}": 0.5}
    if point in ("left_wide_hip", "right_wide_hip"):
        side, other = ("left", "right") if point.startswith("left") else ("right", "left")
        spread = _hip_spread(body)
        return {f"{side}_hip": (1 + spread) / 2, f"{other}_hip": (1 - spread) / 2}
    if point == "mid_spine":
        return _mid_spine(body)
    if point == "upper_neck":
        return {"neck": 0.5, "head": 0.5}
    if point == "mid_face":
        return {"head": 0.5, "nose": 0.5}
    if point in ("left_hand", "right_hand"):
        side = point.removesuffix("hand")
        return {f"{side}{finger}1": 0.25 for finger in ("index", "middle", "ring", "pinky")}
    return {point: 1.0}


def _hip_spread(body: BodyModel) -> float:
    """How many times as far apart as the hip joints the detectors' hips lie; at least 1."""
    if not {"left_hip", "right_hip"} <= set(body.joint_names):
        return 1.0  # the caller finds that they are missing
    left, right = (_rest_joint(body, f"{side}_hip") for side in ("left", "right"))
    apart, height = np.linalg.norm(left - right), (left[1] + right[1]) / 2
    columns = [k for k, name in enumerate(body.joint_names) if name in _AROUND_HIPS]
    # Not the hands, which hang beside the hips of a body that rests with its arms down.
    skin = np.asarray(body.template)[np.asarray(body.weights)[:, columns].sum(axis=1) > 0.5]
    band = skin[np.abs(skin[:, 1] - height) <= 0.25 * apart, 0]
    if len(band) == 0 or not apart > 0:
        return 1.0
    return max(1.0, float(_HIP_WIDTH * (band.max() - band.min()) / apart))


def _mid_spine(body: BodyModel) -> dict[str, float]:
    if not {*_SPINE, *_TRUNK} <= set(body.joint_names):
        return dict.fromkeys((*_SPINE, *_TRUNK), 0.125)  # the caller finds which are missing
    heights = [float(_rest_joint(body, name)[1]) for name in _SPINE]
    middle = sum(float(_rest_joint(body, name)[1]) for name in _TRUNK) / 4
    for (low, bottom), (high, top) in pairwise(zip(_SPINE, heights, strict=True)):
        if bottom <= middle < top:
            share = (middle - bottom) / (top - bottom)
            return {low: 1 - share, high: share}
    return {_SPINE[0] if middle < heights[0] else _SPINE[-1]: 1.0}


def _rest_joint(body: BodyModel, name: str) -> np.ndarray:
    if isinstance(body.template, Tracer):
        raise TypeError(
            "body must be known: got a traced body; make its keypoint regressor outside jit, grad "
            "and vmap."
        )
    return np.asarray(body.joint_template, np.float64)[body.joint_names.index(name)]
