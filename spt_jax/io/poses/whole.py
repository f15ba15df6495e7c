"""Whole poses in one array: AMASS and what follows it, MOYO, Motion-X, and this project's own."""

from typing import Any

import numpy as np

from spt_jax.io.poses.parts import has_parts, read_parts, track_of
from spt_jax.io.poses.rotations import AXIS_ANGLE, MATRIX, form_of
from spt_jax.io.poses.source import (
    MOST_METRES,
    MOST_SHAPE,
    Block,
    Source,
    UnknownStructureError,
    Way,
    spelt,
)
from spt_jax.io.poses.track import Track

JOINT_COUNTS = (22, 24, 52, 55)
"""Body alone; SMPL; SMPL-H, with fingers; SMPL-X, with jaw and eyes before the fingers."""
# The wrist and three joints a finger, which are read as no body.
_HAND = 16
POSES = ("poses", "pose", "fullpose")
# Motion-X: where in the 322 numbers of a frame what stands.
_MOTION_X = {
    "root and body": (0, range(22)),
    "hands": (66, range(25, 55)),
    "jaw": (156, (22,)),
}
_MOTION_X_WIDTH = 322


def whole_pose(source: Source, way: Way, index: tuple[Any, ...] = ()) -> tuple[np.ndarray, Block]:
    """Frames of whole poses of SMPL's layouts.

    Raises:
        UnknownStructureError: the poses are those of a hand.
        ValueError: the array has another shape.
    """
    for count in JOINT_COUNTS:
        found = source.rotations(way, range(count), index=index)
        if found is not None:
            return found
    values = source.numbers(way, index)
    if form_of(values, _HAND, forms=(AXIS_ANGLE, MATRIX)) is not None:
        raise UnknownStructureError(
            f"{spelt(way)} must hold poses of a body: got {_HAND} rotations a frame, as those of "
            f"one hand of MANO, in {source.file!r}; in Python, untangle_pose with load_body of a "
            "MANO file takes them"
        )
    shape = values.shape
    raise ValueError(
        f"{spelt(way)} must hold frames of 22 or 24 or 52 or 55 rotations, as axis-angle (N, J, 3) "
        f"or (N, 3 J), matrices, 6D or quaternions: got shape {shape} in {source.file!r}"
    )


def read_whole(source: Source) -> list[Track]:
    """AMASS, MOYO and this project's own: `poses`, `pose` or `fullpose`, one person.

    AMASS writes `poses` with `trans`, `betas`, `gender` and a frame rate (nghorbani/amass,
    notebooks/01-AMASS_Visualization.ipynb); its SMPL-X files hold the parts once more. MOYO's
    pickles, which MoSh++ writes, have `fullpose` (sha2nkt/moyo_toolkit, moyo/utils/mesh_utils.py).
    """
    way = source.first((), POSES)
    assert way is not None
    pose, block = whole_pose(source, way)
    copies = (read_parts(source).blocks,) if has_parts(source) else ()
    return [
        track_of(
            source, source.stem, pose, (block,), copies=copies, names=_names(source, len(pose))
        )
    ]


def _names(source: Source, frames: int) -> list[str]:
    way = source.first((), ("name",))
    if way is None:
        return []
    source.used |= {way, ("joints",)}  # this project's own: its joints are SMPL's, in their order
    names = np.atleast_1d(np.asarray(source.get(way)))
    if names.dtype.kind != "U" or names.shape != (frames,):
        raise ValueError(
            f"name must hold {frames} strings: got {names.dtype} {names.shape} in {source.file!r}"
        )
    try:
        return [str(name) for name in names]
    except ValueError as error:  # a number that is no letter
        raise ValueError(f"name must hold text: got {error} in {source.file!r}") from error


def is_motion_x(tree: Any) -> bool:
    """An array of frames of 322 numbers."""
    return isinstance(tree, np.ndarray) and tree.ndim == 2 and tree.shape[1] == _MOTION_X_WIDTH


def read_motion_x(source: Source) -> list[Track]:
    """Motion-X: an array of 322 numbers a frame (IDEA-Research/Motion-X, README.md)."""
    pose = np.zeros((len(source.tree), 55, 3))
    blocks = []
    for start, joints in _MOTION_X.values():
        index = (slice(None), slice(start, start + 3 * len(joints)))
        values = source.numbers((), index).reshape(-1, len(joints), 3)
        block = Block((), index, AXIS_ANGLE, tuple(joints))
        pose[:, block.joints] = values
        blocks.append(block)
    if not len(pose):
        raise ValueError(f"pose file must hold at least one frame: got none in {source.file!r}")
    columns = {"expression": (159, 209), "translation": (309, 312), "shape": (312, 322)}
    most = {"translation": MOST_METRES}
    given: dict[str, Any] = {
        name: source.numbers((), (slice(None), slice(*ends)), most.get(name, MOST_SHAPE))
        for name, ends in columns.items()
    }
    source.note("not used: face_shape")
    return [Track(source.stem, pose, blocks=tuple(blocks), **given)]


def read_bare(source: Source) -> list[Track]:
    """An array of whole poses and nothing beside it."""
    pose, block = whole_pose(source, ())
    return [Track(source.stem, pose, blocks=(block,))]
