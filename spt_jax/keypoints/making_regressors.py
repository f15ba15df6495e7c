"""The ways to a `KeypointRegressor`: a layout, names, indices of joints, or a dense matrix."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array
from scipy.sparse import sparray, spmatrix

from spt_jax.body import BodyModel
from spt_jax.body.poses import FINGERS
from spt_jax.keypoints.landmarks import FINGERTIPS, LANDMARKS, find_fingertips, find_landmarks
from spt_jax.keypoints.layouts import as_layout
from spt_jax.keypoints.points import COMBINATIONS, needs_landmarks, weights_of
from spt_jax.keypoints.regressor import KeypointRegressor

#: What keypoints are, in each of the ways of `keypoint_regressor`.
AnyLayout: TypeAlias = (
    str | Sequence[str] | Sequence[int] | ArrayLike | sparray | spmatrix | KeypointRegressor
)


def keypoint_regressor(
    body: BodyModel,
    layout: AnyLayout,
    *,
    count: int | None = None,
    names: str | Sequence[str] | None = None,
) -> KeypointRegressor:
    """The map from a body's joints and vertices to keypoints in the order that a user has them.

    Joints of a layout are the body's of the same name, faces and feet vertices
    (`spt_jax.keypoints.landmarks`), and what lies between is in COMBINATIONS: the neck of
    BODY_25 and the thorax of H36M-17 half-way between the shoulders, the middle of the hips, the
    hips of COCO-17, BODY_25 and H36M-17 farther out than SMPL's joints, H36M-17's spine half-way
    up the back and its "Neck/Nose" half-way between the head joint and the nose.

    Args:
        body: the body; for landmarks its template and weights are read.
        layout: what each keypoint is; one of

            - a key of `spt_jax.keypoints.LAYOUTS`, such as "coco17", "body25_hands", "wholebody133"
              or "smpl24"; "smpl" with a `count`; names with commas between them, in any data set's
              words;
            - a sequence of names: joints of the body, landmarks, or COMBINATIONS;
            - a sequence of whole numbers: joints of the body;
            - a dense regressor as SMPL's users have them: (K, V) from the vertices, of which those
              with a weight are kept, or (K, J) from the joints; NumPy, JAX or SciPy sparse. Its
              rows sum to 1;
            - a KeypointRegressor, which comes back as it is.
        count: how many keypoints there are, to be checked against `layout`; None leaves that out.
        names: names for the rows of a dense regressor: a layout's name or a sequence. By None they
            are "point0", "point1" and so on, and nothing is known about them.

    Returns:
        A KeypointRegressor, in the dtype of the body.

    Raises:
        TypeError: `layout` is none of these; the body, or a dense regressor, is traced.
        ValueError: an unknown layout; a keypoint that this body lacks; an index out of range; a
            dense regressor that does not fit the body, is not finite or whose rows do not sum to 1;
            another count than `count`.

    Example:
        >>> from spt_jax.body import load_body
        >>> from spt_jax.keypoints import keypoint_regressor
        >>> regressor = keypoint_regressor(load_body(), ["left_wrist", "nose"])
        >>> regressor.names, len(regressor.vertices)
        (('left_wrist', 'nose'), 1)
    """
    given: Any = layout
    if isinstance(layout, KeypointRegressor):
        made = layout
        if made.joint_weights.shape[-1] != body.num_joints or any(
            vertex >= body.num_vertices for vertex in made.vertices
        ):
            raise ValueError(
                f"layout must be a regressor for this body, {body.num_joints} joints and "
                f"{body.num_vertices} vertices: got one for {made.joint_weights.shape[-1]} joints "
                f"and vertices up to {max(made.vertices, default=0)}; make it anew for this body."
            )
    elif isinstance(layout, str):
        known = as_layout(layout, count)
        made = _from_names(
            body,
            known.names,
            known.points,
            known.name,
            surface=known.surface,
            whole=not known.surface,
        )
    elif _is_sequence_of(layout, str):
        made = _from_names(body, tuple(given), tuple(given), "layout", surface=False)
    elif _is_sequence_of(layout, (int, np.integer)) or _is_row_of_indices(layout):
        made = _from_indices(body, [int(index) for index in given])
    else:
        made = _from_dense(body, layout, names)
        names = None
    if names is not None:
        raise ValueError(
            "names must be left out unless layout is a dense regressor: its keypoints have names, "
            f"{', '.join(made.names[:3])}, ..."
        )
    if count is not None and count != len(made.names):
        raise ValueError(
            f"layout must give as many keypoints as there are: got {len(made.names)} for {count} "
            "keypoints."
        )
    return made


def _is_sequence_of(value: Any, kind: Any) -> bool:
    return (
        isinstance(value, (list, tuple))
        and len(value) > 0
        and all(isinstance(entry, kind) and not isinstance(entry, bool) for entry in value)
    )


def _is_row_of_indices(value: Any) -> bool:
    if isinstance(value, Tracer) or not isinstance(value, (np.ndarray, Array)):
        return False
    return value.ndim == 1 and bool(np.issubdtype(value.dtype, np.integer)) and value.size > 0


def _from_indices(body: BodyModel, indices: list[int]) -> KeypointRegressor:
    for index in indices:
        if not 0 <= index < body.num_joints:
            raise ValueError(
                f"layout must be from 0 to {body.num_joints - 1}, the body's joints: got {index}; "
                "indices are 0-based."
            )
    rows = [{body.joint_names[index]: 1.0} for index in indices]
    return _assemble(body, tuple(body.joint_names[index] for index in indices), rows, {})


def _from_names(
    body: BodyModel,
    names: tuple[str, ...],
    points: tuple[str, ...],
    what: str,
    *,
    surface: bool,
    whole: bool = True,
) -> KeypointRegressor:
    """The regressor of points by name.

    `surface`: "left_eye" is the vertex also where the body, SMPL-X, has a joint of that name.
    `whole`: whether fingers that the body lacks, and points of the face, are an error.
    """
    own = set(body.joint_names)
    landmarks = find_landmarks(body) if needs_landmarks(points, own, surface) else {}
    if not surface:
        landmarks = {name: vertex for name, vertex in landmarks.items() if name not in own}
    if any(point in FINGERTIPS for point in points):
        landmarks |= find_fingertips(body)
    placed = tuple(
        whole or point in own or point in landmarks or not (point == "" or _is_of_a_finger(point))
        for point in points
    )
    anywhere = "head" if "head" in own else body.joint_names[0]
    rows = [
        weights_of(body, point) if there else {anywhere: 1.0}
        for point, there in zip(points, placed, strict=True)
    ]
    missing = [
        name
        for name, row in zip(names, rows, strict=True)
        if not all(source in own or source in landmarks for source in row)
    ]
    if missing:
        raise ValueError(
            f"{what} must be keypoints of the body: it lacks {', '.join(missing[:5])}"
            f"{' and more' if len(missing) > 5 else ''}; it has the joints "
            f"{', '.join(body.joint_names)}, and all have {', '.join((*LANDMARKS, *COMBINATIONS))}."
            " List those that you have."
        )
    made = _assemble(body, names, rows, landmarks)
    return made if all(placed) else dataclasses.replace(made, placed=placed)


def _is_of_a_finger(point: str) -> bool:
    return point in FINGERTIPS or point in FINGERS


def _assemble(
    body: BodyModel,
    names: tuple[str, ...],
    rows: list[dict[str, float]],
    landmarks: dict[str, int],
) -> KeypointRegressor:
    joints = {name: k for k, name in enumerate(body.joint_names) if name not in landmarks}
    used = sorted({source for row in rows for source in row if source not in joints})
    columns = {name: k for k, name in enumerate(used)}
    joint_weights = np.zeros((len(names), body.num_joints))
    vertex_weights = np.zeros((len(names), len(used)))
    for k, row in enumerate(rows):
        for source, weight in row.items():
            if source in joints:
                joint_weights[k, joints[source]] += weight
            else:
                vertex_weights[k, columns[source]] += weight
    dtype = body.template.dtype
    return KeypointRegressor(
        names,
        tuple(landmarks[name] for name in used),
        jnp.asarray(joint_weights, dtype),
        jnp.asarray(vertex_weights, dtype),
    )


def _from_dense(
    body: BodyModel, layout: Any, names: str | Sequence[str] | None
) -> KeypointRegressor:
    if isinstance(layout, Tracer):
        raise TypeError("layout must be known: got a traced array; make the regressor outside jit.")
    try:
        given = np.asarray(layout.toarray() if hasattr(layout, "toarray") else layout)
    except ValueError:  # rows of different lengths
        given = np.empty(0, object)
    numbers = np.issubdtype(given.dtype, np.floating) or np.issubdtype(given.dtype, np.integer)
    if not numbers or given.ndim == 0:
        raise TypeError(
            "layout must be a layout's name, a list of names or of joint indices, or an array of "
            f"weights: got {type(layout).__name__}."
        )
    columns = given.shape[-1] if given.ndim == 2 and len(given) else -1
    if columns not in (body.num_vertices, body.num_joints):
        raise ValueError(
            f"layout must be (K, {body.num_vertices}), from this body's vertices, or "
            f"(K, {body.num_joints}), from its joints: got shape {given.shape}; a regressor made "
            "for SMPL's 6890 vertices fits only a body with SMPL's mesh."
        )
    weights = given.astype(np.float64)
    if not np.isfinite(weights).all():
        row = int(np.flatnonzero(~np.isfinite(weights).all(axis=1))[0])
        raise ValueError(f"layout must be finite: got NaN or infinity in row {row}.")
    sums = weights.sum(axis=1)
    if np.abs(sums - 1).max() > 1e-2:
        row = int(np.abs(sums - 1).argmax())
        raise ValueError(
            f"layout must have rows that sum to 1, or keypoints would not move with the body: got "
            f"{sums[row]:.4g} in row {row}; divide each row by its sum."
        )
    dtype = body.template.dtype
    labels = _labels(names, len(weights))
    if columns == body.num_vertices:
        used = np.flatnonzero((weights != 0).any(axis=0))
        none = np.zeros((len(weights), body.num_joints))
        vertices = tuple(int(vertex) for vertex in used)
        return KeypointRegressor(
            labels, vertices, jnp.asarray(none, dtype), jnp.asarray(weights[:, used], dtype)
        )
    none = np.zeros((len(weights), 0))
    return KeypointRegressor(labels, (), jnp.asarray(weights, dtype), jnp.asarray(none, dtype))


def _labels(names: str | Sequence[str] | None, count: int) -> tuple[str, ...]:
    if names is None:
        return tuple(f"point{k}" for k in range(count))
    if isinstance(names, str):
        return as_layout(names, count).names
    if not _is_sequence_of(names, str) or len(names) != count:
        raise ValueError(
            f"names must be a layout's name or {count} strings, one a row: got {names!r}."
        )
    return tuple(names)
