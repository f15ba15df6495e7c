"""Tracks of a pose file on a body: what is asked for as one motion, and what of it is left out."""

from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.cli.frames import Motion
from spt_jax.cli.motions import Chosen, rows_by_track
from spt_jax.io.pose_files import Track

if TYPE_CHECKING:
    from spt_jax.body import BodyModel


def posed_on(
    asked: Chosen, body: str, max_bytes: int | None
) -> tuple["BodyModel", Motion, list[str]]:
    """The body, the frames asked for on it, and what of them had to be left out.

    Where the file has expressions, the body's are shape coefficients behind those of the shape.

    Raises:
        As `load_body`.
    """
    from spt_jax.body import expression_as_shape, load_body

    model = load_body(
        body,
        num_shape=asked.num_shape,
        num_expression=asked.num_expression,
        max_bytes=max_bytes,
    )
    motion, notes = motion_of(asked, model, body)
    return expression_as_shape(model), motion, notes


def motion_of(asked: Chosen, model: "BodyModel", body: str) -> tuple[Motion, list[str]]:
    """The frames asked for on the body, and what of them had to be left out."""
    notes = list(asked.file.notes)
    poses, lost = [], {}
    for k, rows in rows_by_track(asked):
        track = asked.tracks[k]
        pose = track.pose[rows]
        turned = np.any(pose, axis=(0, 2)).tolist()
        layout = SMPL_LAYOUTS[track.pose.shape[1]]
        lost |= {
            name: None
            for name, used in zip(layout, turned, strict=True)
            if used and name not in model.joint_names
        }
        posed = model.pose_from_smpl(pose.astype(np.float32))
        poses.append(_with_hands(model, posed, track, rows, notes))
    if lost:
        shown = ", ".join(list(lost)[:4]) + (", ..." if len(lost) > 4 else "")
        notes.append(f"the body lacks {shown}; their rotations are left out")
    shape = _shapes(asked, model, body, notes)
    faces = _expressions(asked, model, notes)
    if faces is not None:
        flat = np.zeros((len(faces), model.num_shape), np.float32)
        if shape is not None:
            flat[:, : shape.shape[1]] = shape
        shape = np.concatenate([flat, faces], axis=1)
    shifts = [track.translation for track in asked.tracks]
    translation = None
    known = [shift for shift in shifts if shift is not None]
    if len(known) == len(shifts):
        translation = np.stack([known[k][row] for k, row in asked.rows]).astype(np.float32)
    order = [(k, row) for k, rows in rows_by_track(asked) for row in rows]
    at = {place: number for number, place in enumerate(order)}
    pose = np.concatenate(poses)[[at[place] for place in asked.rows]]
    count = 0 if faces is None else faces.shape[1]
    return Motion(asked.names, pose, shape, translation, count), notes


def _with_hands(
    model: "BodyModel", pose: Any, track: Track, rows: list[int], notes: list[str]
) -> np.ndarray:
    """The pose with the fingers that the file has as components of hands."""
    known = {hand.side: len(hand.components) for hand in model.hands}
    used: dict[str, np.ndarray] = {}
    for side, given in (("left", track.left_hand), ("right", track.right_hand)):
        if given is None:
            continue
        if given.shape[1] <= known.get(side, 0):
            used[side] = given[rows].astype(np.float32)
            continue
        what = f"{known[side]} components" if side in known else "no components"
        notes.append(
            f"the body has {what} of the {side} hand, the file {given.shape[1]}: those fingers are "
            "at rest"
        )
    return np.asarray(model.with_hands(pose, used.get("left"), used.get("right")))


def _shapes(asked: Chosen, model: "BodyModel", body: str, notes: list[str]) -> np.ndarray | None:
    given = [track.shape for track in asked.tracks]
    if all(shape is None for shape in given):
        return None
    if body == "anny":
        notes.append(
            "the file's shape is in SMPL's components, which the embedded body does not have; "
            "its mean shape is used (--body takes an SMPL file)"
        )
        return None
    widest = max(shape.shape[-1] for shape in given if shape is not None)
    if widest > model.num_shape:
        notes.append(f"shape components after the body's {model.num_shape} are left out")
    shapes = np.zeros((len(asked.rows), min(widest, model.num_shape)), np.float32)
    for at, (k, row) in enumerate(asked.rows):
        one = given[k]
        if one is not None:
            values = (one if one.ndim == 1 else one[row])[: shapes.shape[1]]
            shapes[at, : len(values)] = values
    return shapes


def _expressions(asked: Chosen, model: "BodyModel", notes: list[str]) -> np.ndarray | None:
    """The expression of each frame, in as many coefficients as the body has of them."""
    widest, known = asked.num_expression, model.num_expression
    if widest > known:
        had = f"{known} expressions, the file {widest}" if known else "no expressions"
        left = "those after them are left out" if known else "those of the file are left out"
        notes.append(f"the body has {had}: {left}")
    if not known:
        return None
    found = np.zeros((len(asked.rows), known), np.float32)
    for at, (k, row) in enumerate(asked.rows):
        given = asked.tracks[k].expression
        if given is not None:
            values = given[row][:known]
            found[at, : len(values)] = values
    return found
