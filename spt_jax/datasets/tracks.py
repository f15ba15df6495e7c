"""A track of a pose file as a motion of a body, and back; and how such a motion moves."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from spt_jax.body import BodyModel
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.io.pose_files import Track

# Frames that are posed at a time: one program does for any number.
BATCH = 8


class Posed(NamedTuple):
    """A track on a body, in its precision.

    Attributes:
        pose: axis-angle of each frame, in radians.
        shape: coefficients of each frame; the body's mean where the file has none that it takes.
            Those of the expression are the last.
        translation: in metres; zero where the file has none.
        notes: what was left out.
    """

    pose: Float[np.ndarray, "T J 3"]
    shape: Float[np.ndarray, "T B"]
    translation: Float[np.ndarray, "T 3"]
    notes: tuple[str, ...]


def on_body(track: Track, body: BodyModel, *, embedded: bool, expressions: int) -> Posed:
    """A track on a body.

    Args:
        track: of a pose file.
        body: whose joints are found by name.
        embedded: whether it is the body of the package, whose shape components are not SMPL's.
        expressions: how many of the body's shape components are expressions, the last ones.
    """
    notes = []
    layout = SMPL_LAYOUTS[track.pose.shape[1]]
    used = np.any(track.pose, axis=(0, 2))
    lost = [n for n, u in zip(layout, used, strict=True) if u and n not in body.joint_names]
    if lost:
        shown = ", ".join(lost[:4]) + (", ..." if len(lost) > 4 else "")
        notes.append(f"rotations of {shown} stay as they are, which the body does not have")
    if track.left_hand is not None or track.right_hand is not None:
        notes.append("components of hands stay as they are; fingers are taken at rest")
    count = len(track.pose)
    shape = np.zeros((count, body.num_shape), np.float32)
    if track.shape is not None and embedded:
        notes.append("shape is in SMPL's components; the embedded body's mean shape is taken")
    elif track.shape is not None:
        given = np.broadcast_to(track.shape, (count, track.shape.shape[-1]))
        own = body.num_shape - expressions
        width = min(given.shape[1], own)
        shape[:, :width] = given[:, :width]
        if given[:, width:].any():
            notes.append(f"shape components after the body's {own} are left out")
    face = track.expression
    if face is not None:
        width = min(face.shape[1], expressions)
        first = body.num_shape - expressions
        shape[:, first : first + width] = face[:, :width]
        if face[:, width:].any():
            what = f"expressions after the body's {expressions}" if expressions else "expressions"
            notes.append(f"{what} are left out")
    place = np.zeros((count, 3)) if track.translation is None else track.translation
    # Batch by batch: JAX compiles what is done with arrays for each of their lengths.
    given = track.pose.astype(np.float32)
    parts = [np.asarray(body.pose_from_smpl(given[at]))[:left] for at, left in _batches(count)]
    pose = np.concatenate(parts)
    return Posed(pose, shape, place.astype(np.float32), tuple(notes))


def in_track(
    track: Track,
    body: BodyModel,
    before: Float[np.ndarray, "T J 3"],
    after: Float[np.ndarray, "T J 3"],
) -> Float[np.ndarray, "T K 3"]:
    """The track's own pose with the rotations that changed on the body; all others to the bit."""
    pose = track.pose.copy()
    for joint, name in enumerate(SMPL_LAYOUTS[pose.shape[1]]):
        if name in body.joint_names:
            k = body.joint_names.index(name)
            changed = (before[:, k] != after[:, k]).any(axis=1)
            pose[changed, joint] = after[changed, k]
    return pose


@eqx.filter_jit
def _vertices(body: BodyModel, pose: Any, shape: Any, translation: Any) -> Any:
    return body(pose, shape, translation).vertices


def skins(body: BodyModel, posed: Posed) -> Iterator[Float[np.ndarray, "N V 3"]]:
    """The vertices of all frames, at most `BATCH` frames at a time."""
    for at, left in _batches(len(posed.pose)):
        found = _vertices(body, posed.pose[at], posed.shape[at], posed.translation[at])
        yield np.asarray(found)[:left]


def _batches(count: int) -> Iterator[tuple[np.ndarray, int]]:
    """`BATCH` frames at a time, the last one repeated, and how many are left with the first."""
    for start in range(0, count, BATCH):
        yield np.minimum(np.arange(start, start + BATCH), count - 1), count - start


def second_differences(body: BodyModel, posed: Posed) -> tuple[float, float]:
    """How rough a motion is: mean and largest second difference of its vertices, in metres."""
    total, largest, count = 0.0, 0.0, 0
    last = np.zeros((0, body.num_vertices, 3), np.float32)
    for batch in skins(body, posed):
        frames = np.concatenate([last, batch])
        last = frames[-2:]
        if len(frames) > 2:
            size = np.linalg.norm(np.diff(frames, n=2, axis=0), axis=-1)
            total, count = total + float(size.sum(dtype=np.float64)), count + size.size
            largest = max(largest, float(size.max()))
    return (total / count if count else 0.0), largest


def displacements(body: BodyModel, before: Posed, after: Posed) -> tuple[float, float]:
    """Mean and largest distance by which vertices were moved, in metres."""
    total, largest, count = 0.0, 0.0, 0
    for one, other in zip(skins(body, before), skins(body, after), strict=True):
        size = np.linalg.norm(other - one, axis=-1)
        total, count = total + float(size.sum(dtype=np.float64)), count + size.size
        largest = max(largest, float(size.max()))
    return total / count, largest
