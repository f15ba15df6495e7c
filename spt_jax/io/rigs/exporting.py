"""A body model as a rig file: its skin, joints, shapes and motion, for programs that show them."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from spt_jax.body.model import BodyModel
from spt_jax.files.outputs import atomic_write
from spt_jax.io.rigs.document import Document
from spt_jax.io.rigs.rewriting import Written

_UNSIGNED_SHORT, _UNSIGNED_INT = 5123, 5125


def write_rig(
    path: str | os.PathLike[str],
    body: BodyModel,
    poses: Float[Array | np.ndarray, "T J 3"] | None = None,
    *,
    shape: Float[Array | np.ndarray, "B"] | None = None,
    translation: Float[Array | np.ndarray, "T 3"] | None = None,
    frames_per_second: float = 30.0,
    name: str = "motion",
) -> None:
    """Write a body as a rigged .glb, which Blender, Unity and three.js open, with its motion.

    The skin has all weights of the body, in as many sets of four as it takes. Shape components are
    morph targets of the skin alone, since joints do not follow morph targets: give the `shape` that
    the joints are to fit. Pose blend shapes are left out; glTF has none.

    Args:
        path: the file; .glb.
        body: SMPL's family or the embedded body.
        poses: axis-angle of each frame, in radians; None for a file without an animation.
        shape: of the written body.
        translation: of each frame, in metres.
        frames_per_second: of the motion.
        name: of the animation.

    Raises:
        ValueError: another suffix, poses or a translation that do not fit the body or each other,
            or are not finite; a rate that is not positive.
        OSError: as in `atomic_write`.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax import load_body, load_mocap
        >>> from spt_jax.io import load_rig, write_rig
        >>> body, mocap = load_body(num_shape=0), load_mocap()
        >>> rows = [name.startswith("walk/") for name in mocap.names]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "walk.glb"
        ...     write_rig(file, body, body.pose_from_smpl(mocap.pose[rows]), name="walk")
        ...     load_rig(file).animations
        ('walk',)
    """
    target = Path(path)
    if target.suffix.lower() != ".glb":
        raise ValueError(f"path must end in .glb: got {target.name!r}.")
    if not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
    frames = None if poses is None else _frames("poses", poses, (None, body.num_joints, 3))
    places = None
    if translation is not None:
        if frames is None:
            raise ValueError("translation goes with poses: got it without; give both.")
        places = _frames("translation", translation, (len(frames), 3))
    coefficients = np.zeros(0) if shape is None else np.asarray(shape, np.float64)
    vertices = _at_shape(body.template, body.shape_basis, coefficients)
    joints = _at_shape(body.joint_template, body.joint_shape_basis, coefficients)
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "spt_jax"},
        "scene": 0,
        "scenes": [{"nodes": [body.num_joints, 0]}],
    }
    written = Written(tree, Document(target, tree, (), None))
    tree["nodes"] = _nodes(body, joints)
    tree["meshes"] = [_mesh(written, body, vertices)]
    bind = np.repeat(np.eye(4)[None], len(joints), axis=0)
    bind[:, :3, 3] = -joints
    matrices = written.accessor(bind.transpose(0, 2, 1).reshape(-1, 16), "MAT4")
    tree["skins"] = [
        {"joints": list(range(body.num_joints)), "skeleton": 0, "inverseBindMatrices": matrices}
    ]
    if frames is not None:
        moves = None if places is None else joints[0] + places
        tree["animations"] = [_animation(written, frames, moves, frames_per_second, name)]
    with atomic_write(target) as temporary:
        temporary.write_bytes(written.document().as_glb())


def _frames(name: str, given: Any, shape: tuple[int | None, ...]) -> Float[np.ndarray, "..."]:
    array = np.asarray(given, np.float64)
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or not len(array):
        wanted = ", ".join("frames" if want is None else str(want) for want in shape)
        raise ValueError(f"{name} must have shape ({wanted}): got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite: got NaN or infinity; leave such frames out.")
    return array


def _at_shape(mean: Any, basis: Any, shape: np.ndarray) -> Float[np.ndarray, "N 3"]:
    if shape.ndim != 1 or len(shape) > basis.shape[-1]:
        raise ValueError(
            f"shape must be at most {basis.shape[-1]} coefficients: got shape {shape.shape}."
        )
    return np.asarray(mean, np.float64) + np.asarray(basis, np.float64)[..., : len(shape)] @ shape


def _nodes(body: BodyModel, joints: Float[np.ndarray, "J 3"]) -> list[dict[str, Any]]:
    nodes: list[dict[str, Any]] = []
    for joint, parent in enumerate(body.parents):
        away = joints[joint] - (joints[parent] if parent >= 0 else 0)
        nodes.append({"name": body.joint_names[joint], "translation": away.tolist()})
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    return [*nodes, {"name": "body", "mesh": 0, "skin": 0}]


def _mesh(written: Written, body: BodyModel, vertices: Float[np.ndarray, "V 3"]) -> dict[str, Any]:
    faces = np.asarray(body.faces, np.int64)
    attributes = {
        "POSITION": written.accessor(vertices, "VEC3", bounds=True),
        "NORMAL": written.accessor(_normals(vertices, faces), "VEC3"),
    }
    weights = np.asarray(body.weights, np.float64)
    most = max(int(np.count_nonzero(weights, axis=1).max(initial=1)), 1)
    sets = -(-most // 4)
    heaviest = np.argsort(-weights, axis=1, kind="stable")[:, : 4 * sets]
    missing = 4 * sets - heaviest.shape[1]
    values = np.pad(np.take_along_axis(weights, heaviest, axis=1), ((0, 0), (0, missing)))
    # Joints that do not weigh are 0, as the specification has it.
    chosen = np.where(values > 0, np.pad(heaviest, ((0, 0), (0, missing))), 0)
    values = (values / values.sum(axis=1, keepdims=True)).astype(np.float32)
    for k in range(sets):
        columns = slice(4 * k, 4 * k + 4)
        attributes[f"JOINTS_{k}"] = written.whole(chosen[:, columns], "VEC4", _UNSIGNED_SHORT)
        attributes[f"WEIGHTS_{k}"] = written.accessor(values[:, columns], "VEC4")
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": written.whole(faces.reshape(-1), "SCALAR", _UNSIGNED_INT),
    }
    mesh: dict[str, Any] = {"name": "body", "primitives": [primitive]}
    basis = np.asarray(body.shape_basis, np.float64)
    if basis.shape[-1]:
        primitive["targets"] = [
            {"POSITION": written.accessor(basis[..., k], "VEC3", bounds=True)}
            for k in range(basis.shape[-1])
        ]
        mesh["weights"] = [0.0] * basis.shape[-1]
        mesh["extras"] = {"targetNames": [f"shape {k}" for k in range(basis.shape[-1])]}
    return mesh


def _normals(vertices, faces) -> Float[np.ndarray, "V 3"]:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 1.0, 0.0])


def _animation(
    written: Written, poses, moves: np.ndarray | None, rate: float, name: str
) -> dict[str, Any]:
    times = written.accessor(np.arange(len(poses)) / rate, "SCALAR", bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def channel(node: int, path: str, output: int) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})

    for joint in range(poses.shape[1]):
        turn = Rotation.from_rotvec(poses[:, joint]).as_quat()
        flips = np.cumsum(np.sum(turn[1:] * turn[:-1], axis=1) < 0) % 2 == 1
        turn[1:][flips] *= -1
        channel(joint, "rotation", written.accessor(turn, "VEC4"))
    if moves is not None:
        channel(0, "translation", written.accessor(moves, "VEC3"))
    return {"name": name, "samplers": samplers, "channels": channels}
