"""A character's primitives and joints as one rigged body."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from spt_jax.body.rig import RigModel
from spt_jax.files.limits import check_bytes
from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.animations import Animation
from spt_jax.io.rigs.characters import Character, Part, Skin
from spt_jax.io.rigs.document import WHAT, Document
from spt_jax.io.rigs.joints import Joints, place_joints
from spt_jax.io.rigs.nodes import Nodes
from spt_jax.io.rigs.primitives import read_primitives, target_names
from spt_jax.io.rigs.welding import Mesh, welded

# Bones of one joint that were bound within this part of the character's size are one.
_SAME = 1e-6
# Files of float32 that were bound in one pose agree about it to this.
_AGREED = 1e-4


@dataclass(frozen=True, eq=False)
class Built:
    """A character as a body, and what leads back to the file.

    Attributes:
        body: the rig.
        joints: how its joints stand in the file's nodes.
        targets: of each node with morph targets, the place of its first coefficient.
        rows: of each vertex of the file's primitives, one after the other, that of the body; -1
            where no triangle has it.
        scale: what the file's lengths were multiplied by.
    """

    body: RigModel
    joints: Joints
    targets: dict[int, int]
    rows: Int[np.ndarray, "R"]
    scale: float


def build(
    document: Document,
    nodes: Nodes,
    skins: list[Skin],
    character: Character,
    animations: list[Animation],
    dtype: Any,
    scale: float | None,
    notes: list[str],
) -> Built:
    """One character as a body.

    Raises:
        UnreadableError: a part of it is damaged.
        TooLargeError: its weights or morph targets take more than the limit.
    """
    joints = place_joints(nodes, skins, character, animations)
    raw, targets, names = _assemble(document, nodes, skins, character, joints, notes)
    mesh = welded(raw, notes)
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    factor = _unit(extent, scale, notes)
    before = joints.before.copy()
    # The world is scaled: what lies below the root keeps the file's own lengths.
    before[0, :3] *= factor
    template, bound = mesh.vertices * factor, mesh.inverse_bind.copy()
    bound[:, :3, :3] /= factor
    names += [f"{joints.names[j]} translation {axis}" for j in joints.shifting for axis in "xyz"]
    names += [f"{joints.names[j]} scale {axis}" for j in joints.scaling for axis in "xyz"]
    body = RigModel(
        template=jnp.asarray(template, dtype),
        shape_basis=jnp.asarray(mesh.targets * factor, dtype),
        bone_weights=jnp.asarray(mesh.weights, dtype),
        inverse_bind=jnp.asarray(bound[:, :3], dtype),
        before=jnp.asarray(before[:, :3], dtype),
        joint_translation=jnp.asarray(joints.translation, dtype),
        joint_stretch=jnp.asarray(joints.stretch, dtype),
        bind_rotation=jnp.asarray(joints.bind_rotation, dtype),
        bind_frame=jnp.asarray(joints.bind_frame, dtype),
        faces=jnp.asarray(mesh.faces, jnp.int32),
        bones=mesh.bones,
        parents=joints.parents,
        joint_names=joints.names,
        shape_names=tuple(names),
        shifting=joints.shifting,
        scaling=joints.scaling,
    )
    return Built(body, joints, targets, mesh.rows, factor)


def _unit(extent: float, scale: float | None, notes: list[str]) -> float:
    """What lengths are multiplied by, so that they are metres."""
    if scale is not None:
        return scale
    if not 0 < extent < np.inf or 0.1 <= extent <= 10:
        return 1.0
    factor = 10.0 ** -round(np.log10(extent / 1.5))
    notes.append(
        f"the character is {extent:.4g} long, and glTF's unit is the metre: it is scaled by "
        f"{factor:g} to {extent * factor:.2f} m (scale= says otherwise)"
    )
    return factor


def _assemble(document, nodes, skins, character: Character, joints: Joints, notes):
    """All primitives in one mesh, in the space of the bind pose."""
    parts = [(part, _bones(nodes, skins, joints, part)) for part in character.parts]
    names, targets = [], {}
    for part, _ in parts:
        own = target_names(document.item("meshes", part.mesh, "mesh"))
        if own:
            targets[part.node] = len(names)
            names += own
    names = _distinct(names)
    found, bones, columns = [], [], []
    for part, (owners, matrices) in parts:
        found.append([])
        to_world = None
        count = None if part.skin is None else len(owners)
        for primitive in read_primitives(document, part.mesh, count, notes):
            if to_world is None:
                to_world = _bound_where(primitive, owners, matrices, joints)
                columns.append(_columns(bones, owners, matrices @ np.linalg.inv(to_world), joints))
            found[-1].append((primitive, to_world))
        if to_world is None:
            columns.append([])
    vertices = sum(len(p.vertices) for own in found for p, _ in own)
    size = 8 * vertices * (len(bones) + 3 * len(names))
    check_bytes(f"the weights and morph targets of {WHAT}", document.path, size, document.max_bytes)
    mesh = Mesh.empty(vertices, len(bones), len(names))
    start, faces = 0, []
    for (part, _), own, places in zip(parts, found, columns, strict=True):
        for primitive, to_world in own:
            rows = slice(start, start + len(primitive.vertices))
            linear = to_world[:3, :3]
            mesh.vertices[rows] = primitive.vertices @ linear.T + to_world[:3, 3]
            across = np.array(places)[primitive.joints]
            vertex = np.arange(start, rows.stop)
            for k in range(across.shape[1]):  # a vertex may name a joint twice
                mesh.weights[vertex, across[:, k]] += primitive.weights[:, k]
            first = targets.get(part.node, 0)
            for k, moved in enumerate(primitive.targets):
                mesh.targets[rows, :, first + k] = moved @ linear.T
            # A mirrored character's triangles turn the other way.
            order = [0, 2, 1] if np.linalg.det(linear) < 0 else [0, 1, 2]
            faces.append(primitive.faces[:, order] + start)
            start = rows.stop
    if not faces or not sum(map(len, faces)):
        raise UnreadableError(f"character {character.name!r} must have triangles: got none")
    used = tuple(owner for owner, _ in bones)
    bound = np.stack([matrix for _, matrix in bones])
    return (
        mesh._replace(faces=np.concatenate(faces), bones=used, inverse_bind=bound),
        targets,
        names,
    )


def _distinct(names: list[str]) -> list[str]:
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name} {seen[name]}")
    return found


def _bones(nodes: Nodes, skins: list[Skin], joints: Joints, part: Part):
    """Of a part, the joint of each of its bones, and what takes vertices into that one's space."""
    if part.skin is not None:
        skin = skins[part.skin]
        return [joints.place[node] for node in skin.joints], skin.inverse_bind
    holder = next(node for node in nodes.up(part.node) if node in joints.place)
    inside = np.eye(4)
    if holder != part.node:
        inside = nodes.between(holder, part.node) @ nodes.locals[part.node].matrix()
    return [joints.place[holder]], inside[None]


def _bound_where(primitive, owners, matrices, joints: Joints) -> Float[np.ndarray, "4 4"]:
    """What takes a part's vertices to where they are in the zero pose.

    All bones agree about that where the skin was bound in it; otherwise those say so that agree
    with each other and together weigh most.
    """
    total = np.zeros(len(owners))
    np.add.at(total, primitive.joints, primitive.weights)
    found = joints.world[np.array(owners)] @ matrices
    size = np.linalg.norm(found[:, :3, :3], axis=(1, 2))
    far = np.abs(primitive.vertices).max(initial=1e-12)
    votes = np.zeros(len(owners))
    for bone in np.flatnonzero(total > 0):
        apart = np.abs(found - found[bone])
        off = apart[:, :3, :3].max(axis=(1, 2)) + apart[:, :3, 3].max(axis=1) / far
        votes[bone] = total[off < _AGREED * size[bone]].sum()
    for bone in np.argsort(-votes, kind="stable"):
        if np.linalg.cond(found[bone, :3, :3]) < 1e6:
            return found[bone]
    return np.eye(4)


def _columns(bones: list, owners, matrices, joints: Joints) -> list[int]:
    """The column of weights of each bone; one joint has one, unless it was bound differently."""
    size = max(float(np.abs(joints.world[:, :3, 3]).max()), 1e-12)
    known: dict[int, list[int]] = {}
    for k, (owner, _) in enumerate(bones):
        known.setdefault(owner, []).append(k)
    places = []
    for owner, matrix in zip(owners, matrices, strict=True):
        unit = np.linalg.norm(matrix[:3, :3]) + np.linalg.norm(matrix[:3, 3]) / size
        for k in known.get(owner, ()):
            apart = np.abs(bones[k][1] - matrix)
            if apart[:, :3].max() + apart[:, 3].max() / size < _SAME * unit:
                places.append(k)
                break
        else:
            known.setdefault(owner, []).append(len(bones))
            places.append(len(bones))
            bones.append((owner, matrix))
    return places
