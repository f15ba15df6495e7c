"""What a body model must be: checked where one is made."""

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from spt_jax.body.posing import POSE_FEATURES, count_features

if TYPE_CHECKING:
    from spt_jax.body.model import BodyModel
    from spt_jax.body.rig import RigModel


def check_model(body: "BodyModel") -> None:
    """Raise TypeError or ValueError where the arrays of a body do not fit together."""
    vertices = body.template.shape[0] if body.template.ndim else 0
    joints = body.joint_template.shape[0] if body.joint_template.ndim else 0
    coefficients = body.shape_basis.shape[-1] if body.shape_basis.ndim else 0
    if body.pose_features not in POSE_FEATURES:
        raise ValueError(
            f"pose_features must be one of {', '.join(map(repr, POSE_FEATURES))}: got "
            f"{body.pose_features!r}."
        )
    if (body.expression_basis is None) != (body.joint_expression_basis is None):
        raise ValueError(
            "expression_basis and joint_expression_basis must be given together: got one of them."
        )
    expressions = 0 if body.expression_basis is None else body.expression_basis.shape[-1]
    expected = {
        "template": (vertices, 3),
        "shape_basis": (vertices, 3, coefficients),
        "joint_template": (joints, 3),
        "joint_shape_basis": (joints, 3, coefficients),
        "weights": (vertices, joints),
        "pose_basis": (vertices, 3, count_features(body.pose_features, max(joints, 1))),
        "expression_basis": (vertices, 3, expressions),
        "joint_expression_basis": (joints, 3, expressions),
    }
    _check_arrays(body, expected)
    _check_faces(body.faces, vertices)
    _check_parents(body.parents, body.joint_names, joints)
    for hand in body.hands:
        if not all(0 <= joint < joints for joint in hand.joints):
            raise ValueError(
                f"the joints of the {hand.side} hand must be among the body's {joints}: got "
                f"{hand.joints}."
            )


def _check_arrays(body: Any, expected: dict[str, tuple[int, ...]]) -> None:
    for name, shape in expected.items():
        array = getattr(body, name)
        if array is None:
            continue
        if array.shape != shape:
            raise ValueError(
                f"{name} must have shape {shape}, as the other arrays have it: got {array.shape}."
            )
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise TypeError(f"{name} must be floating-point: got dtype {array.dtype}.")


def _check_faces(faces: Any, vertices: int) -> None:
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces must be triangles, (F, 3): got shape {faces.shape}.")
    if faces.dtype != np.int32:
        raise TypeError(f"faces must be int32: got {faces.dtype}; cast them.")
    if not isinstance(faces, Tracer) and faces.size:
        low, high = int(np.min(faces)), int(np.max(faces))
        if low < 0 or high >= vertices:
            raise ValueError(
                f"faces must index into vertices: got indices {low} to {high} for {vertices} "
                "vertices; indices are 0-based."
            )


def _check_parents(parents: tuple[int, ...], names: tuple[str, ...], joints: int) -> None:
    if len(parents) != joints or len(names) != joints:
        raise ValueError(
            f"parents and joint_names must have one entry for each of {joints} joints: got "
            f"{len(parents)} and {len(names)}."
        )
    for joint, parent in enumerate(parents):
        if (parent != -1) if joint == 0 else not 0 <= parent < joint:
            raise ValueError(
                "parents must be -1 for joint 0 and an earlier joint for every other: got "
                f"{parent} for joint {joint} ({names[joint]}); reorder the joints."
            )


def checked_rows(indices: Any, count: int) -> np.ndarray:
    """Which vertices are kept, once each is one of them.

    Raises:
        TypeError: indices that are not whole numbers, or are traced.
        ValueError: indices that are no list, or out of range.
    """
    if isinstance(indices, Tracer):
        raise TypeError("indices must be known when traced: got a traced array.")
    rows = np.asarray(indices)
    if rows.size == 0:
        rows = rows.astype(np.int32)
    if not np.issubdtype(rows.dtype, np.integer):
        raise TypeError(f"indices must be whole numbers: got dtype {rows.dtype}.")
    if rows.ndim != 1:
        raise ValueError(f"indices must be a list of vertices: got shape {rows.shape}.")
    if rows.size and (rows.min() < 0 or rows.max() >= count):
        worst = int(rows.min() if rows.min() < 0 else rows.max())
        raise ValueError(
            f"indices must be from 0 to {count - 1}, one for each vertex: got "
            f"{worst}; indices are 0-based."
        )
    return rows


def check_rig(rig: "RigModel") -> None:
    """Raise TypeError or ValueError where the arrays of a rig do not fit together."""
    vertices, joints, bones = rig.template.shape[0], len(rig.parents), len(rig.bones)
    targets = rig.shape_basis.shape[-1]
    expected = {
        "template": (vertices, 3),
        "shape_basis": (vertices, 3, targets),
        "bone_weights": (vertices, bones),
        "inverse_bind": (bones, 3, 4),
        "before": (joints, 3, 4),
        "joint_translation": (joints, 3),
        "joint_stretch": (joints, 3, 3),
        "bind_rotation": (joints, 3, 3),
        "bind_frame": (joints, 3, 3),
    }
    _check_arrays(rig, expected)
    _check_faces(rig.faces, vertices)
    _check_parents(rig.parents, rig.joint_names, joints)
    if any(not 0 <= joint < joints for joint in (*rig.bones, *rig.shifting, *rig.scaling)):
        raise ValueError(f"bones, shifting and scaling must name joints from 0 to {joints - 1}.")
    names = targets + 3 * (len(rig.shifting) + len(rig.scaling))
    if len(rig.shape_names) != names:
        raise ValueError(f"shape_names must be {names} names: got {len(rig.shape_names)}.")
