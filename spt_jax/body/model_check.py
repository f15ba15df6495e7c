"""What a body model must be: checked where one is made."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from spt_jax.body.posing import POSE_FEATURES, count_features

if TYPE_CHECKING:
    from spt_jax.body.model import BodyModel


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
    for name, shape in expected.items():
        array = getattr(body, name)
        if array is None:
            continue
        if array.shape != shape:
            raise ValueError(
                f"{name} must have shape {shape} for {vertices} vertices, {joints} joints and "
                f"{coefficients} shape coefficients: got {array.shape}."
            )
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise TypeError(f"{name} must be floating-point: got dtype {array.dtype}.")
    if body.faces.ndim != 2 or body.faces.shape[1] != 3:
        raise ValueError(f"faces must be triangles, (F, 3): got shape {body.faces.shape}.")
    if body.faces.dtype != np.int32:
        raise TypeError(f"faces must be int32: got {body.faces.dtype}; cast them.")
    if len(body.parents) != joints or len(body.joint_names) != joints:
        raise ValueError(
            f"parents and joint_names must have one entry for each of {joints} joints: got "
            f"{len(body.parents)} and {len(body.joint_names)}."
        )
    for joint, parent in enumerate(body.parents):
        if (parent != -1) if joint == 0 else not 0 <= parent < joint:
            raise ValueError(
                "parents must be -1 for joint 0 and an earlier joint for every other: got "
                f"{parent} for joint {joint} ({body.joint_names[joint]}); reorder the joints."
            )
    for hand in body.hands:
        if not all(0 <= joint < joints for joint in hand.joints):
            raise ValueError(
                f"the joints of the {hand.side} hand must be among the body's {joints}: got "
                f"{hand.joints}."
            )
    if not isinstance(body.faces, Tracer) and body.faces.size:
        low, high = int(np.min(body.faces)), int(np.max(body.faces))
        if low < 0 or high >= vertices:
            raise ValueError(
                f"faces must index into vertices: got indices {low} to {high} for {vertices} "
                "vertices; indices are 0-based."
            )
