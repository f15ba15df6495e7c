"""A motion as an animated glTF binary, which viewers, engines and Blender play."""

import json
import os
import struct
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from spt_jax.body import BodyModel
from spt_jax.files.outputs import atomic_write

# glTF has four joints a vertex in one set; two sets are what most viewers read.
_SETS = 2

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_VERTEX_DATA, _INDICES = 34962, 34963

_COLORS = ((0.80, 0.45, 0.40), (0.40, 0.62, 0.75), (0.55, 0.70, 0.45), (0.75, 0.65, 0.40))


class Figure(NamedTuple):
    """A person in a motion.

    Attributes:
        name: what it is called in the file.
        pose: axis-angle of each joint in each frame, in radians.
        shape: shape coefficients, the same in all frames.
        translation: of each frame, in metres.
        offset: by how much it is set aside, in metres.
        color: red, green and blue, from 0 to 1.
    """

    name: str
    pose: Float[np.ndarray, "T J 3"]
    shape: Float[np.ndarray, "B"] | None = None
    translation: Float[np.ndarray, "T 3"] | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    color: tuple[float, float, float] = _COLORS[0]


def before_and_after(
    before: Float[np.ndarray, "T *people J 3"],
    after: Float[np.ndarray, "T *people J 3"],
    *,
    shape: Float[np.ndarray, "*T B"] | None = None,
    translation: Float[np.ndarray, "T *people 3"] | None = None,
    aside: tuple[float, float, float] = (1.5, 0.0, 0.0),
) -> list[Figure]:
    """The figures of a motion as it was and as it was freed, set side by side.

    Args:
        before, after: poses of each frame, of one person or several.
        shape: one for all, or one for each person in each frame, of which the first frame's counts.
        translation: in metres.
        aside: how far what was freed stands from what it was, in metres.

    Returns:
        For `write_animation`.

    Example:
        >>> import numpy as np
        >>> from spt_jax.show.animation import before_and_after
        >>> pose = np.zeros((4, 52, 3))
        >>> [figure.name for figure in before_and_after(pose, pose)]
        ['before', 'after']
    """
    found = []
    for when, poses, offset in (("before", before, (0.0, 0.0, 0.0)), ("after", after, aside)):
        people = np.asarray(poses)
        people = people[:, None] if people.ndim == 3 else people
        count, number = people.shape[:2]
        places = None if translation is None else np.asarray(translation).reshape(count, number, 3)
        for k in range(number):
            one = None
            if shape is not None:
                given = np.asarray(shape)
                one = given if given.ndim == 1 else given.reshape(count, -1, given.shape[-1])[0]
                one = one if one.ndim == 1 else one[min(k, len(one) - 1)]
            found.append(
                Figure(
                    when if number == 1 else f"{when} {k}",
                    people[:, k],
                    one,
                    None if places is None else places[:, k],
                    offset,
                    _COLORS[(when == "after") + 2 * (k % 2)],
                )
            )
    return found


def write_animation(
    path: str | os.PathLike[str],
    body: BodyModel,
    figures: list[Figure],
    frames_per_second: float = 30.0,
) -> None:
    """Write moving figures as one .glb: a skeleton and a skin each, turned from frame to frame.

    Between frames, rotations are interpolated. Of a vertex the eight largest skinning weights are
    written; pose blend shapes, which glTF's skins do not have, are left out.

    Args:
        path: of the file, which appears whole or not at all.
        body: that of all figures.
        figures: at least one, all with the same number of frames.
        frames_per_second: the motion's rate.

    Raises:
        ValueError: no figures, or not the same number of frames; a rate that is not positive.
        OSError: it cannot be written.

    Example:
        >>> import numpy as np, tempfile, pathlib
        >>> from spt_jax import load_body
        >>> from spt_jax.show.animation import Figure, write_animation
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "still.glb"
        ...     write_animation(path, load_body(), [Figure("still", np.zeros((2, 52, 3)))])
        ...     path.read_bytes()[:4]
        b'glTF'
    """
    counts = {len(figure.pose) for figure in figures}
    if len(counts) != 1 or not counts.pop():
        raise ValueError(
            f"figures must be at least one, of the same number of frames, at least one: got "
            f"{[len(figure.pose) for figure in figures]}."
        )
    if not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
    made = _File()
    for figure in figures:
        _add(made, body, figure, frames_per_second)
    content = made.content()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


class _File:
    """A glTF file as it is made."""

    def __init__(self):
        self.parts: list[bytes] = []
        self.size = 0
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "spt_jax"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "animations": [{"name": "motion", "samplers": [], "channels": []}],
        }

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        rows = self.json.setdefault(kind, [])
        rows.append(entry)
        return len(rows) - 1

    def accessor(self, array: np.ndarray, kind: str, component: int, target: int | None) -> int:
        data = np.ascontiguousarray(array).tobytes()
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.parts += [data, b"\0" * (-len(data) % 4)]
        self.size += len(data) + (-len(data) % 4)
        entry = {
            "bufferView": self.add("bufferViews", view),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if kind in ("VEC3", "SCALAR") and component == _FLOAT:
            flat = array.reshape(len(array), -1)
            entry |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def content(self) -> bytes:
        self.json["buffers"] = [{"byteLength": self.size}]
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self.parts)
        total = 12 + 8 + len(text) + 8 + len(binary)
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, total),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(binary), b"BIN\0"),
                binary,
            ]
        )


def _add(made: _File, body: BodyModel, figure: Figure, rate: float) -> None:
    shape = np.zeros(body.num_shape) if figure.shape is None else np.asarray(figure.shape)
    rest = np.asarray(body.template + body.shape_basis @ shape, np.float32)
    joints = np.asarray(body.joint_template + body.joint_shape_basis @ shape, np.float32)
    first = len(made.json.setdefault("nodes", []))
    offsets = [joints[k] - (joints[p] if p >= 0 else 0) for k, p in enumerate(body.parents)]
    for k, name in enumerate(body.joint_names):
        node: dict[str, Any] = {"name": f"{name} ({figure.name})"}
        node["translation"] = [float(x) for x in offsets[k]]
        children = [first + j for j, p in enumerate(body.parents) if p == k]
        if children:
            node["children"] = children
        made.add("nodes", node)
    bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    bind[:, 3, :3] = -joints  # columns first
    skin = made.add(
        "skins",
        {
            "joints": list(range(first, first + len(joints))),
            "inverseBindMatrices": made.accessor(bind, "MAT4", _FLOAT, None),
        },
    )
    mesh = {"primitives": [_primitive(made, body, rest, figure)], "name": figure.name}
    skinned = made.add("nodes", {"mesh": made.add("meshes", mesh), "skin": skin})
    aside = [float(x) for x in figure.offset]
    above = {"name": figure.name, "translation": aside, "children": [first]}
    made.json["scenes"][0]["nodes"] += [made.add("nodes", above), skinned]
    _animate(made, figure, first, offsets[0], rate)


def _primitive(made: _File, body: BodyModel, rest, figure: Figure) -> dict[str, Any]:
    weights = np.asarray(body.weights, np.float32)
    most = min(4 * _SETS, weights.shape[1])
    order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
    chosen = np.take_along_axis(weights, order, axis=1)
    chosen = chosen / chosen.sum(axis=1, keepdims=True)
    pad = ((0, 0), (0, 4 * _SETS - most))
    order, chosen = np.pad(order, pad).astype(np.uint16), np.pad(chosen, pad)
    order[chosen == 0] = 0
    faces = np.asarray(body.faces, np.uint32).reshape(-1)
    attributes = {"POSITION": made.accessor(rest, "VEC3", _FLOAT, _VERTEX_DATA)}
    for k in range(_SETS):
        part = slice(4 * k, 4 * k + 4)
        numbers, shares = order[:, part], np.ascontiguousarray(chosen[:, part])
        attributes[f"JOINTS_{k}"] = made.accessor(numbers, "VEC4", _USHORT, _VERTEX_DATA)
        attributes[f"WEIGHTS_{k}"] = made.accessor(shares, "VEC4", _FLOAT, _VERTEX_DATA)
    color = {"baseColorFactor": [*figure.color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    material = made.add("materials", {"pbrMetallicRoughness": color, "name": figure.name})
    indices = made.accessor(faces, "SCALAR", _UINT, _INDICES)
    return {"attributes": attributes, "indices": indices, "material": material}


def _animate(made: _File, figure: Figure, first: int, root, rate: float) -> None:
    animation = made.json["animations"][0]
    time = (np.arange(len(figure.pose)) / rate).astype(np.float32)
    clock = made.accessor(time, "SCALAR", _FLOAT, None)

    def channel(node: int, path: str, values: np.ndarray, kind: str) -> None:
        output = made.accessor(values.astype(np.float32), kind, _FLOAT, None)
        animation["samplers"].append({"input": clock, "output": output})
        sampler = len(animation["samplers"]) - 1
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": sampler, "target": target})

    for joint in range(figure.pose.shape[1]):
        turns = figure.pose[:, joint]
        if joint and not turns.any():
            continue
        quaternion = Rotation.from_rotvec(turns.astype(np.float64)).as_quat()
        # Each the nearer one of the two that mean the same, or players would turn the long way.
        flips = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
        quaternion[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
        channel(first + joint, "rotation", quaternion, "VEC4")
    if figure.translation is not None:
        channel(first, "translation", figure.translation + root, "VEC3")
