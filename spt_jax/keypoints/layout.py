"""What the order of keypoints is."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple


class Layout(NamedTuple):
    """One order of keypoints.

    Names are SMPL's joint names wherever a keypoint corresponds to one ("left_hip", "neck"), and
    for the rest nose, left_eye, left_ear, left_big_toe, left_small_toe, left_heel, head_top, spine,
    thorax, with right_ for left_. Left is the person's own.

    Attributes:
        name: what functions call it.
        names: the keypoints, in order.
        official: the keypoints as the source calls them.
        edges: pairs of keypoints to draw lines between; `edge_side` gives the side of each.
        points: where each keypoint lies on a body: a joint, a landmark, a fingertip, or one of
            `spt_jax.keypoints.points.COMBINATIONS`; "" for points of the face, which lie nowhere.
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
        >>> from spt_jax.keypoints.layout import side
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
        >>> from spt_jax.keypoints import LAYOUTS, edge_side
        >>> edge_side(LAYOUTS["body25"], (8, 9)), edge_side(LAYOUTS["coco17"], (5, 6))
        ('right', 'middle')
    """
    sides = {side(layout.names[end]) for end in edge} - {"middle"}
    return sides.pop() if len(sides) == 1 else "middle"


# What of a layout's keypoints is not the joint or landmark of its own name.
USUAL_PLACES: dict[str, str] = {
    # Annotators and detectors put hips farther out than SMPL's joints lie.
    "left_hip": "left_wide_hip",
    "right_hip": "right_wide_hip",
    "pelvis": "between_hips",
    "neck": "between_shoulders",
    "thorax": "between_shoulders",
    "spine": "mid_spine",
    "left_hand_root": "left_wrist",
    "right_hand_root": "right_wrist",
}


def make_layout(
    name: str,
    names: Iterable[str],
    edges: Iterable[tuple[int, int]],
    official: Iterable[str] | None = None,
    sigmas: tuple[float, ...] | None = None,
    at: Mapping[str, str] = USUAL_PLACES,
    surface: bool = True,
) -> Layout:
    """A layout whose keypoints are the joints and landmarks of their names, but for those in `at`.

    Example:
        >>> from spt_jax.keypoints.layout import make_layout
        >>> make_layout("two", ("left_hip", "nose"), [(0, 1)]).points
        ('left_wide_hip', 'nose')
    """
    names = tuple(names)
    points = tuple(at.get(keypoint, keypoint) for keypoint in names)
    return Layout(name, names, tuple(official or names), tuple(edges), points, sigmas, surface)
