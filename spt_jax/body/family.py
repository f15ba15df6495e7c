"""A body model from the arrays that files of the SMPL family hold."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from spt_jax.body.file_checks import (
    check_regressor,
    check_shape,
    check_weights,
    parents_of,
    whole_numbers,
)
from spt_jax.body.hands import Hand
from spt_jax.body.layouts import Layout, layout_of
from spt_jax.body.model import BodyModel

Regress: TypeAlias = Callable[[np.ndarray], np.ndarray]

_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_FINGER_JOINTS = 15
# Of each hand by its side: one in MANO's files, two in those of SMPL-H and SMPL-X.
_HANDS = {"": "MANO", "l": "left", "r": "right"}
ARRAYS = (
    *_KEYS,
    "posedirs",
    *(f"hands_{kind}{side}" for kind in ("components", "mean") for side in _HANDS),
)
"""The arrays that are read; files hold more of them (landmarks, texture coordinates)."""


def body_of(
    arrays: Mapping[str, np.ndarray],
    names: Sequence[str],
    path: Path,
    num_shape: int | None,
    num_expression: int | None,
    dtype: np.dtype,
) -> BodyModel:
    """The model that a file's arrays are.

    Args:
        arrays: those of `ARRAYS` that the file has.
        names: of everything that it has.
        path: the file, for messages.
        num_shape, num_expression: how many components to keep; None keeps all.
        dtype: of the model's arrays.

    Raises:
        ValueError: an array is missing, has another shape, or holds what it must not.
    """
    missing = [name for name in _KEYS if name not in arrays]
    if missing:
        raise ValueError(
            f"{path} lacks {', '.join(missing)}; a body model has {', '.join(_KEYS)}. "
            f"{_what_it_is(names)}"
        )
    _check_shapes(arrays, path)
    layout = layout_of(arrays, path)
    faces = whole_numbers("f", arrays["f"], path)
    tree = whole_numbers("kintree_table", arrays["kintree_table"], path)
    count = len(arrays["v_template"])
    if faces.size and not 0 <= faces.min() <= faces.max() < count:
        raise ValueError(
            f"f in {path} must index into v_template: got indices {faces.min()} to {faces.max()} "
            f"for {count} vertices; indices are 0-based."
        )
    check_weights("weights", arrays["weights"], path)
    joints_of, shift = _joints_of(arrays, path)
    template = arrays["v_template"].astype(np.float64)
    shapes, expressions = _components(arrays, layout, num_shape, num_expression)
    posedirs = arrays.get("posedirs")
    faces_basis = joint_basis = None
    if expressions is not None:
        faces_basis = jnp.asarray(expressions, dtype)
        joint_basis = jnp.asarray(joints_of(expressions), dtype)
    return BodyModel(
        template=jnp.asarray(template, dtype),
        shape_basis=jnp.asarray(shapes, dtype),
        joint_template=jnp.asarray(joints_of(template) + shift, dtype),
        joint_shape_basis=jnp.asarray(joints_of(shapes), dtype),
        weights=jnp.asarray(arrays["weights"], dtype),
        faces=jnp.asarray(faces, jnp.int32),
        parents=parents_of(tree, layout.names, path),
        joint_names=layout.names,
        pose_basis=None if posedirs is None else jnp.asarray(posedirs, dtype),
        expression_basis=faces_basis,
        joint_expression_basis=joint_basis,
        hands=_hands(arrays, layout, path, dtype),
        pose_features=layout.features,
    )


def _what_it_is(names: Sequence[str]) -> str:
    """What a file without a model's arrays is, as far as the names of its arrays show."""
    known = set(names)
    if known & {"poses", "pose", "body_pose", "global_orient", "pose_body", "root_orient"}:
        return "It is a file of poses: load_poses reads it."
    if known & {"vertices", "faces", "verts"}:
        return "It seems to be a mesh: BodyModel takes arrays, and untangle_mesh a mesh alone."
    if known & {"betas", "shape"}:
        return "It is a file of shapes, which are arguments of a model, and none itself."
    if any(name.startswith(("lmk", "static_lmk", "dynamic_lmk")) for name in known):
        return "It holds landmarks, which belong to a model and are none."
    if {"hands_meanl", "hands_meanr"} & known:
        return "It holds hand components without a body."
    shown = ", ".join(sorted(known)[:6]) or "nothing"
    return f"This one has {shown}{', ...' if len(known) > 6 else ''}."


def _check_shapes(arrays: Mapping[str, np.ndarray], path: Path) -> None:
    vertices = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    tree = arrays["kintree_table"]
    joints = tree.shape[-1] if tree.ndim == 2 else 0
    regressor = arrays["J_regressor"]
    # SUPR's regressor gives each coordinate by itself, from all of them and a constant.
    affine = regressor.shape == (3 * joints, 3 * vertices + 1)
    expected = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, None),
        "J_regressor": regressor.shape if affine else (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (None, 3),
        "posedirs": (vertices, 3, None),
    }
    for side in _HANDS:
        expected[f"hands_components{side}"] = (None, 3 * _FINGER_JOINTS)
        expected[f"hands_mean{side}"] = (3 * _FINGER_JOINTS,)
    for name, shape in expected.items():
        if name in arrays and not _is_placeholder(name, arrays[name]):
            check_shape(name, arrays[name], shape, path)


def _is_placeholder(name: str, array: np.ndarray) -> bool:
    """Whether it stands for hand components that are not there, as some converted files have it."""
    return name.startswith("hands_") and array.size == 0


def _joints_of(arrays: Mapping[str, np.ndarray], path: Path) -> tuple[Regress, np.ndarray]:
    """How joints follow from points or from their displacements, and what is added of points."""
    given = arrays["J_regressor"].astype(np.float64)
    joints, vertices = arrays["kintree_table"].shape[1], len(arrays["v_template"])
    if given.shape == (joints, vertices):
        check_regressor(given, path)
        return lambda points: np.einsum("jv,v...->j...", given, points), np.zeros((joints, 3))

    def from_coordinates(points: np.ndarray) -> np.ndarray:
        flat = points.reshape(3 * vertices, *points.shape[2:])
        return (given[:, :-1] @ flat).reshape(joints, 3, *points.shape[2:])

    return from_coordinates, given[:, -1].reshape(joints, 3)


def _components(
    arrays: Mapping[str, np.ndarray],
    layout: Layout,
    num_shape: int | None,
    num_expression: int | None,
) -> tuple[np.ndarray, np.ndarray | None]:
    given = arrays["shapedirs"]
    count = given.shape[-1]
    own = layout.expressions.get(count, count)
    shapes, expressions = given[..., :own][..., :num_shape], None
    if own < count:
        expressions = given[..., own:][..., :num_expression].astype(np.float64)
    return shapes.astype(np.float64), expressions


def _hands(
    arrays: Mapping[str, np.ndarray], layout: Layout, path: Path, dtype: np.dtype
) -> tuple[Hand, ...]:
    found = []
    for mark, side in _HANDS.items():
        components, mean = (arrays.get(f"hands_{kind}{mark}") for kind in ("components", "mean"))
        if components is None or not components.size:
            continue
        side = layout.names[0].split("_")[0] if side == "MANO" else side
        joints = tuple(
            joint
            for joint, name in enumerate(layout.names)
            if name.startswith(f"{side}_") and name[-1] in "123"
        )
        if len(joints) != _FINGER_JOINTS:
            raise ValueError(
                f"hands_components{mark} in {path} must belong to a hand of {_FINGER_JOINTS} "
                f"joints: got a {layout.name} model with {len(joints)} of them."
            )
        if mean is None or not mean.size:
            mean = np.zeros(3 * _FINGER_JOINTS)
        found.append(Hand(side, joints, jnp.asarray(components, dtype), jnp.asarray(mean, dtype)))
    return tuple(found)
