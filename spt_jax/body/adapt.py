"""Bodies of other packages, and plain functions, as bodies of this one."""

import copy
import dataclasses
from collections.abc import Callable
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np

from spt_jax.body.adapted import TURN, AdaptedBody
from spt_jax.body.function_body import FunctionBody, body_of_function
from spt_jax.body.model_rotations import MATRICES


@overload
def adapt(model: Any) -> AdaptedBody: ...


@overload
def adapt(model: Callable, *, faces: Any, rest_pose: Any) -> FunctionBody: ...


def adapt(model: Any, *, faces: Any = None, rest_pose: Any = None) -> AdaptedBody | FunctionBody:
    """A body of the package body-models, or a function of a pose, as a body of this package.

    Everything of body-models (MHR, SOMA, Anny, SKEL, SMPL and its family, FLAME, GNM, ...) that is
    made with `runtime="jax"` has what it takes: rest surface, part groups, `untangle_pose`. So has
    any object with its `parameter_spec`, `pose_joint_indices`, `forward_vertices`,
    `forward_skeleton`, `skin_weights`, `faces`, `joint_names` and `parents`.

    Args:
        model: such a model; or a function that returns the vertices (V, 3) of a pose in JAX.
        faces: of a function, the triangles (F, 3).
        rest_pose: of a function, a pose in which nothing collides; poses have its shape.

    Returns:
        An `AdaptedBody`, or of a function a `FunctionBody`.

    Raises:
        TypeError: a model of another runtime, or neither model nor function.
        ValueError: a function without faces or rest_pose, or faces that do not fit its vertices.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax import untangle_pose
        >>> from spt_jax.body import adapt
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> pair = trimesh.util.concatenate([ball, ball.copy().apply_translation([3, 0, 0])])
        >>> second = jnp.asarray(pair.vertices[:, :1] > 1.5, jnp.float32)
        >>> points = jnp.asarray(pair.vertices, jnp.float32)
        >>> rest = jnp.zeros((1, 3))
        >>> body = adapt(lambda x: points + second * x, faces=pair.faces, rest_pose=rest)
        >>> found = untangle_pose(body, jnp.array([[-1.5, 0.0, 0.0]]))
        >>> bool(found.before.volume > 0.1), bool(found.is_free)
        (True, True)
    """
    if hasattr(model, "parameter_spec") and hasattr(model, "forward_vertices"):
        if faces is not None or rest_pose is not None:
            raise ValueError("faces and rest_pose are for functions: got them with a model.")
        return _of_model(model)
    if not callable(model):
        raise TypeError(
            f"model must be a body of body-models or a function: got {type(model).__name__}."
        )
    return body_of_function(model, faces, rest_pose)


def _of_model(model: Any) -> AdaptedBody:
    runtime = getattr(getattr(model, "runtime", None), "name", "jax")
    if runtime != "jax":
        raise TypeError(
            f'model must compute in JAX: got runtime {runtime!r}; create it with runtime="jax".'
        )
    corners = np.asarray(model.faces, np.int64)
    if corners.shape[-1] == 4:
        corners = corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        # A quad with a corner twice is a triangle.
        corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    parents = tuple(int(parent) for parent in model.parents)
    kind = getattr(getattr(model, "_config", None), "rotation_type", None)
    if kind is not None and kind not in MATRICES:
        # Axis angles of body-models have no derivative at zero, forwards not even where they are
        # held fixed; its configuration says how rotations are written, and nothing else does.
        model = copy.copy(model)
        model._config = dataclasses.replace(model._config, rotation_type="rotmat")
    leaves, structure = jax.tree.flatten(model)
    return AdaptedBody(
        tuple(leaves),
        structure,
        jnp.asarray(corners, jnp.int32),
        jnp.asarray(model.skin_weights),
        parents,
        tuple(map(str, model.joint_names)),
        _rows(model, parents),
        kind,
    )


def _rows(model: Any, parents: tuple[int, ...]) -> tuple[tuple[str, int, str], ...] | None:
    """The rows of a pose: what turns the whole, then rotations in the order of their joints."""
    poses = {name: spec for name, spec in model.parameter_spec.items() if spec.role == "pose"}
    if any(spec.rotation_type is None for spec in poses.values()):
        return None
    joints = dict(getattr(model, "pose_joint_indices", {}))
    found: list[tuple[int, str, int]] = []
    for number, (name, spec) in enumerate(poses.items()):
        matrix = spec.rotation_type in MATRICES
        count = 1 if len(spec.dims) == (2 if matrix else 1) else spec.dims[0]
        own = joints.get(name, ())
        at = own if len(own) == count else [len(parents) * (1 + number)] * count
        found += [(joint, name, k) for k, joint in enumerate(at)]
    found.sort(key=lambda row: (row[0], row[2]))
    names = dict(enumerate(map(str, model.joint_names)))
    rows = tuple((name, k, names.get(joint, f"{name} {k}")) for joint, name, k in found)
    has_root = bool(found) and found[0][0] < len(parents) and parents[found[0][0]] < 0
    return rows if has_root else ((TURN, 0, TURN), *rows)
