"""The arguments of `untangle_motion`, checked."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax.body import AbstractBody
from spt_jax.untangle.corrections import Frames


def as_frames(body: AbstractBody, poses: Any, shape: Any, translation: Any) -> Frames:
    """The frames, of one person or several; TypeError or ValueError for what are none."""
    if isinstance(poses, Tracer):
        raise TypeError(
            "poses must be known: got a traced array; untangle_motion decides by the values that "
            "it sees, so call it outside jit, vmap and grad."
        )
    pose = jnp.asarray(poses)
    if not body.pose_is_rotations:
        raise ValueError(
            "body must have a pose that is rotations of joints, (J, 3): got one with poses of "
            f"shape {body.pose_shape}; free its frames one by one with untangle_pose."
        )
    if pose.ndim not in (3, 4) or pose.shape[-2:] != (body.pose_shape[0], 3) or not pose.size:
        raise ValueError(
            f"poses must have shape (frames, {body.pose_shape[0]}, 3), or (frames, people, "
            f"{body.pose_shape[0]}, 3), at least one frame: got {pose.shape}; body.pose_from_smpl "
            "converts poses of other joint counts."
        )
    alone = pose.ndim == 3
    if not alone and pose.shape[1] > 1 and translation is None:
        raise ValueError(
            f"translation must say where {pose.shape[1]} people are: got none, which would put "
            "them all in one place."
        )
    count, people = len(pose), 1 if alone else pose.shape[1]
    size = body.num_shape if shape is None else None
    shapes = _per_frame("shape", shape, count, people, size, alone)
    places = _per_frame("translation", translation, count, people, 3, alone)
    _check_finite(poses=pose, shape=shapes, translation=places)
    dtype = pose.dtype
    frames = np.asarray(pose).reshape(count, people, *pose.shape[-2:])
    return Frames(frames, np.asarray(shapes, dtype), np.asarray(places, dtype))


def _per_frame(
    name: str, array: Any, count: int, people: int, size: int | None, alone: bool
) -> Float[Array, "T P B"]:
    if array is None:
        return jnp.zeros((count, people, size or 0))
    given = jnp.asarray(array)
    batch = given.shape[:-1]
    fits = [(), (count,)] if alone else [(), (people,), (count, people)]
    if not given.ndim or batch not in fits:
        asked = f"{count} frames" if alone else f"{people} people, in each of {count} frames"
        raise ValueError(
            f"{name} must be one vector, or one for each of {asked}: got shape {given.shape}."
        )
    if size is not None and given.shape[-1] != size:
        raise ValueError(f"{name} must have {size} numbers a frame: got shape {given.shape}.")
    if alone:
        given = jnp.broadcast_to(given, (count, given.shape[-1]))[:, None]
    return jnp.broadcast_to(given, (count, people, given.shape[-1]))


def _check_finite(**arrays: Array) -> None:
    for name, array in arrays.items():
        wrong = np.flatnonzero(~np.isfinite(np.asarray(array)).reshape(len(array), -1).all(axis=1))
        if len(wrong):
            raise ValueError(
                f"{name} must be finite: got NaN or infinity in {len(wrong)} of {len(array)} "
                f"frames, frame {wrong[0]} the first; leave such frames out, or fill them in."
            )


def as_positive(name: str, value: Any, *, zero: bool = False) -> float:
    """A finite number above zero, or zero where that is allowed; TypeError, ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number: got {value!r}.")
    if not (0 < value < np.inf or (zero and value == 0)):
        least = "not negative" if zero else "positive"
        raise ValueError(f"{name} must be finite and {least}: got {value!r}.")
    return float(value)


def as_up(up: Any) -> Float[np.ndarray, "3"]:
    """A direction, of length one; ValueError where it has none."""
    direction = np.asarray(up, np.float64)
    if direction.shape != (3,) or not 0 < np.linalg.norm(direction) < np.inf:
        raise ValueError(f"up must be a direction, three numbers not all zero: got {up!r}.")
    return direction / np.linalg.norm(direction)


# Frames by which `up_of` goes.
_LOOKED_AT = 64


def up_of(body: AbstractBody, pose: Any) -> tuple[float, float, float]:
    """The axis, of six, along which heads are above roots in most of a motion: that is up.

    AMASS has z up, most others y, and poses of cameras y down; no file says which.

    Args:
        body: any body whose pose is rotations of joints; without a "head", its last joint counts.
        pose: (frames, J, 3); up to 64 frames of it are looked at.
    """
    names = body.joint_names
    top = names.index("head") if "head" in names else len(names) - 1
    some = np.unique(np.linspace(0, len(pose) - 1, _LOOKED_AT).astype(int))
    # As many for motions of all lengths, so that one program does for them.
    filled = np.pad(some, (0, _LOOKED_AT - len(some)), mode="edge")
    # A joint alone: no vertex is posed.
    joints = np.asarray(body.at_vertices([])(jnp.asarray(np.asarray(pose)[filled])).joints)
    mean = (joints[:, top] - joints[:, 0])[: len(some)].mean(axis=0)
    direction = [0.0, 0.0, 0.0]
    axis = int(np.abs(mean).argmax())
    direction[axis] = 1.0 if mean[axis] >= 0 else -1.0
    return direction[0], direction[1], direction[2]


def as_contacts(contacts: Any, body: AbstractBody, people: int) -> Int[np.ndarray, "C 2"]:
    """Pairs of vertices, numbered through all people.

    Raises:
        TypeError, ValueError: something else.
    """
    if contacts is None:
        return np.zeros((0, 2), np.int64)
    pairs = np.asarray(contacts)
    if not np.issubdtype(pairs.dtype, np.integer):
        raise TypeError(f"contacts must be whole numbers, vertices: got {pairs.dtype}.")
    most = people * body.num_vertices
    if pairs.ndim != 2 or pairs.shape[1] != 2 or ((pairs < 0) | (pairs >= most)).any():
        raise ValueError(
            f"contacts must be pairs of vertices from 0 to {most - 1}, shape (contacts, 2): got "
            f"shape {pairs.shape}" + (f", {pairs.min()} to {pairs.max()}." if pairs.size else ".")
        )
    return pairs.astype(np.int64)
