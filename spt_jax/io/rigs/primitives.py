"""The primitives of a character: positions, triangles, joints, weights and morph targets."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.files.limits import check_bytes
from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.document import WHAT, Document

# Eight weights of one byte each add up to 1 within this; what is farther off is no rounding.
_MOST_ROUNDING = 0.02
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


class Primitive(NamedTuple):
    """One primitive of a mesh, on a node.

    Attributes:
        vertices: as the file has them.
        faces: indices into them.
        joints, weights: of each vertex, places in the skin's list and how much they weigh; the
            weights sum to 1.
        targets: what each morph target adds.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    joints: Int[np.ndarray, "V N"]
    weights: Float[np.ndarray, "V N"]
    targets: Float[np.ndarray, "M V 3"]


def target_names(mesh: dict[str, Any]) -> list[str]:
    """What the morph targets of a mesh are called."""
    extras = mesh.get("extras")
    given = extras.get("targetNames", []) if isinstance(extras, dict) else []
    count = max((len(p.get("targets", ())) for p in mesh.get("primitives", ())), default=0)
    named = given if isinstance(given, list) else []
    return [str(named[k]) if k < len(named) else f"target {k}" for k in range(count)]


def default_weights(document: Document) -> dict[int, np.ndarray]:
    """Of each node with morph targets, the coefficients that the file gives them.

    Raises:
        UnreadableError: one is not finite.
    """
    found = {}
    for number, node in enumerate(document.items("nodes")):
        if "mesh" not in node:
            continue
        mesh = document.item("meshes", node["mesh"], f"the mesh of node {number}")
        count = len(target_names(mesh))
        given = node.get("weights", mesh.get("weights", []))
        if count:
            values = np.zeros(count)
            values[: len(given)] = np.asarray(given, np.float64)[:count]
            if not np.isfinite(values).all():
                raise UnreadableError(f"the weights of node {number} must be finite")
            found[number] = values
    return found


def read_primitives(
    document: Document, mesh: int, bones: int | None, notes: list[str]
) -> Iterator[Primitive]:
    """The triangles of a mesh.

    Args:
        document: the file.
        mesh: which of its meshes.
        bones: how many joints the skin has; None for a mesh that moves with one joint as a whole.
        notes: what had to be left out is appended.

    Raises:
        UnreadableError: a primitive is damaged; the message names it and the field.
    """
    tree = document.item("meshes", mesh, "mesh")
    name = f"mesh {mesh} ({str(tree.get('name', ''))!r})"
    number_of_targets = len(target_names(tree))
    for number, primitive in enumerate(tree.get("primitives", ())):
        where = f"primitive {number} of {name}"
        if primitive.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
            notes.append(f"{where} is of points or lines, and left out")
            continue
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            raise UnreadableError(f"{where} is packed by Draco; export it without")
        attributes = primitive.get("attributes", {})
        vertices = document.array(attributes.get("POSITION"), "VEC3", f"POSITION of {where}")
        faces = _faces(document, primitive, len(vertices), where)
        if bones is None:
            joints = np.zeros((len(vertices), 1), np.int64)
            weights = np.ones((len(vertices), 1))
        else:
            joints, weights = _skin(document, attributes, len(vertices), bones, where, notes)
        targets = primitive.get("targets", [])
        size = 8 * 3 * number_of_targets * len(vertices)
        check_bytes(f"the morph targets of {WHAT}", document.path, size, document.max_bytes)
        moved = np.zeros((number_of_targets, len(vertices), 3))
        for k, target in enumerate(targets):
            if "POSITION" in target:
                field = f"POSITION of target {k} of {where}"
                moved[k] = _one_each(
                    document.array(target["POSITION"], "VEC3", field), len(vertices), field
                )
        yield Primitive(vertices, faces, joints, weights, moved)


def _faces(document: Document, primitive: dict[str, Any], count: int, where: str):
    if "indices" in primitive:
        corners = document.array(primitive["indices"], "SCALAR", f"indices of {where}")
        if corners.dtype.kind != "i":
            raise UnreadableError(f"indices of {where} must be whole numbers")
    else:
        corners = np.arange(count)
    if len(corners) and not 0 <= corners.min() <= corners.max() < count:
        raise UnreadableError(
            f"indices of {where} must be from 0 to {count - 1}, its vertices: got "
            f"{corners.max()}; the file is damaged, export it again"
        )
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        first = np.full(len(corners) - 2, corners[0])
        return np.stack([corners[1:-1], corners[2:], first], axis=1)
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    faces[1::2] = faces[1::2, [0, 2, 1]]
    return faces


def _skin(document, attributes, count: int, bones: int, where: str, notes: list[str]):
    joints, weights, number = [], [], 0
    while f"JOINTS_{number}" in attributes or f"WEIGHTS_{number}" in attributes:
        for kind, found in (("JOINTS", joints), ("WEIGHTS", weights)):
            field = f"{kind}_{number} of {where}"
            if f"{kind}_{number}" not in attributes:
                raise UnreadableError(f"{field} is missing; export the skin again")
            values = document.array(attributes[f"{kind}_{number}"], "VEC4", field)
            found.append(_one_each(values, count, field))
        number += 1
    if not joints:
        raise UnreadableError(f"{where} has a skin and no JOINTS_0; export the skin again")
    if any(one.dtype.kind != "i" for one in joints):
        raise UnreadableError(f"JOINTS of {where} must be whole numbers")
    joint, weight = np.concatenate(joints, axis=1), np.concatenate(weights, axis=1).astype(float)
    used = weight != 0
    wrong = used & ((joint < 0) | (joint >= bones))
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        raise UnreadableError(
            f"JOINTS_{column // 4} of {where} must be from 0 to {bones - 1}, the skin's joints: "
            f"got {joint[row, column]} for vertex {row}; export the skin again"
        )
    if weight.min(initial=0.0) < 0:
        row, column = np.argwhere(weight < 0)[0]
        raise UnreadableError(
            f"WEIGHTS_{column // 4} of {where} must not be negative: got "
            f"{weight[row, column]:.4g} for vertex {row}; export the skin again"
        )
    total = weight.sum(axis=1)
    if len(total):
        worst = int(np.abs(total - 1).argmax())
        if abs(total[worst] - 1) > _MOST_ROUNDING:
            raise UnreadableError(
                f"WEIGHTS of {where} must sum to 1 for each vertex: got {total[worst]:.4f} for "
                f"vertex {worst}; normalize them where the skin was painted (Blender: Weights > "
                "Normalize All), and export it again"
            )
        if abs(total[worst] - 1) > 1e-4:
            notes.append(f"weights of {where} sum to {total[worst]:.4f}, and are divided by that")
    return np.where(used, joint, 0), weight / total[:, None]


def _one_each(values: np.ndarray, count: int, field: str) -> np.ndarray:
    if len(values) != count:
        raise UnreadableError(
            f"{field} must have one element for each of {count} vertices: got {len(values)}"
        )
    return values
