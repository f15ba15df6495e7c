"""Which nodes of a glTF are one character: skins that share joints, and what hangs on them."""

import heapq
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.document import Document, checked_index
from spt_jax.io.rigs.nodes import Nodes


class Skin(NamedTuple):
    """A skin: its joints, and what takes vertices of its meshes into each joint's own space."""

    name: str
    joints: tuple[int, ...]
    inverse_bind: Float[np.ndarray, "K 4 4"]


class Part(NamedTuple):
    """A mesh on a node: skinned, or hung on one joint.

    Attributes:
        node, mesh: numbers of the file.
        skin: which skin moves it; None where it moves with its node.
    """

    node: int
    mesh: int
    skin: int | None


class Character(NamedTuple):
    """One character.

    Attributes:
        name: of the node that holds it, or of its first mesh.
        skins: numbers of the file.
        parts: its meshes, in the file's order.
        joints: nodes that move it, parents first, the root in front; -1 for a root that stands for
            the world, where the file has no node above all joints.
    """

    name: str
    skins: tuple[int, ...]
    parts: tuple[Part, ...]
    joints: tuple[int, ...]


def read_skins(document: Document, nodes: Nodes) -> list[Skin]:
    """All skins.

    Raises:
        UnreadableError: a joint is no node or there twice, or a matrix is none of a joint.
    """
    found = []
    for number, skin in enumerate(document.items("skins")):
        where = f"skin {number} ({str(skin.get('name', ''))!r})"
        given = skin.get("joints")
        if not isinstance(given, list) or not given:
            raise UnreadableError(f"the joints of {where} must be a list of nodes")
        rule = f"the joints of {where} must be nodes"
        joints = tuple(checked_index(joint, len(nodes.names), rule) for joint in given)
        if len(set(joints)) < len(joints):
            raise UnreadableError(f"the joints of {where} must be different nodes")
        matrices = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            field = f"inverseBindMatrices of {where}"
            rows = document.array(skin["inverseBindMatrices"], "MAT4", field)
            if len(rows) < len(joints):
                raise UnreadableError(
                    f"{field} must have one for each of {len(joints)} joints: got {len(rows)}"
                )
            # Column by column, as glTF has them.
            matrices = rows[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
            bottom = matrices[:, 3]
            if not np.allclose(bottom, [0, 0, 0, 1], atol=1e-3):
                row = int(np.abs(bottom - [0, 0, 0, 1]).max(axis=1).argmax())
                raise UnreadableError(
                    f"{field} must end in the row 0 0 0 1: got {bottom[row].tolist()} for joint "
                    f"{row}; export the skin again"
                )
        found.append(Skin(str(skin.get("name", "")), joints, np.array(matrices)))
    return found


def find_characters(
    document: Document, nodes: Nodes, skins: list[Skin], animated: set[int], notes: list[str]
) -> list[Character]:
    """The characters of a file, in the order of their first meshes.

    Skins that share a joint, or of which one hangs on another's joint, are one character. Meshes
    without a skin belong to it where they hang on a joint of it; others are left out.

    Args:
        document, nodes, skins: the file's.
        animated: nodes that an animation moves.
        notes: what is left out is appended.
    """
    parts = []
    for number, node in enumerate(document.items("nodes")):
        if "mesh" not in node:
            continue
        of = f"node {number}"
        mesh = checked_index(
            node["mesh"], len(document.items("meshes")), f"the mesh of {of} must be a mesh"
        )
        skin = node.get("skin")
        if skin is not None:
            skin = checked_index(skin, len(skins), f"the skin of {of} must be a skin")
        parts.append(Part(number, mesh, skin))
    groups = _groups(nodes, skins, sorted({part.skin for part in parts if part.skin is not None}))
    characters, taken = [], set()
    for group in groups:
        own = set().union(*(skins[k].joints for k in group))
        hung = [p for p in parts if p.skin is None and own & set(nodes.up(p.node))]
        chosen = [p for p in parts if p.skin in group or p in hung]
        taken |= set(chosen)
        listed = list(dict.fromkeys(joint for k in group for joint in skins[k].joints))
        joints = _joints(nodes, listed, animated)
        first = next(part for part in chosen if part.skin is not None)
        holder = nodes.parents[first.node]
        name = nodes.names[holder if holder >= 0 else first.node]
        characters.append(Character(name, tuple(group), tuple(chosen), joints))
    alone = [part for part in parts if part not in taken]
    if characters and alone:
        names = ", ".join(repr(nodes.names[part.node]) for part in alone[:4])
        more = ", ..." if len(alone) > 4 else ""
        notes.append(f"meshes that no skin moves are left out: {names}{more}")
    return characters


def _groups(nodes: Nodes, skins: list[Skin], used: list[int]) -> list[list[int]]:
    """Skins by character."""
    owner: dict[int, int] = {}  # of each joint, one skin
    group = {skin: skin for skin in used}

    def first(skin: int) -> int:
        while group[skin] != skin:
            skin = group[skin]
        return skin

    for skin in used:
        for joint in skins[skin].joints:
            group[first(owner.setdefault(joint, skin))] = first(skin)
    for joint, skin in owner.items():
        for above in nodes.up(joint)[1:]:
            if above in owner:
                group[first(skin)] = first(owner[above])
                break
    found: dict[int, list[int]] = {}
    for skin in used:
        found.setdefault(first(skin), []).append(skin)
    return list(found.values())


def _joints(nodes: Nodes, listed: list[int], animated: set[int]) -> tuple[int, ...]:
    """The joints that move a character, parents first, otherwise in the order of the skins.

    They are those of its skins and all above them that an animation moves. Where several of these
    have none above, the lowest node above all comes in as the root.
    """
    above = {node for joint in listed for node in nodes.up(joint)}
    chosen = set(listed) | (above & animated)
    tops = [node for node in chosen if not chosen & set(nodes.up(node)[1:])]
    root = tops[0] if len(tops) == 1 else nodes.common(tops)
    chosen |= {root}
    place = {node: k for k, node in enumerate([*listed, *sorted(chosen - set(listed))])}
    below: dict[int, list[int]] = {}
    for node in chosen - {root}:
        holder = next((up for up in nodes.up(node)[1:] if up in chosen), root)
        below.setdefault(holder, []).append(node)
    ordered, ready = [], [(place[root], root)]
    while ready:
        _, node = heapq.heappop(ready)
        ordered.append(node)
        for child in below.get(node, ()):
            heapq.heappush(ready, (place[child], child))
    return tuple(ordered)
