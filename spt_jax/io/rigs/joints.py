"""How a character's joints stand: in the file, and where its skin was bound."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.io.rigs.animations import Animation
from spt_jax.io.rigs.characters import Character, Skin
from spt_jax.io.rigs.nodes import Local, Nodes, affine, nearest_frame, nearest_rotation

# What a joint shifts or scales less than, as a part of the whole, is rounding.
_STILL = 1e-6


class Joints(NamedTuple):
    """The joints of a character, as `RigModel` has them, in the file's own lengths.

    Attributes:
        nodes: of each joint its node; -1 for a root that stands for the world.
        place: of each such node its joint.
        names, parents: of the joints.
        locals: the transform that the file gives each.
        before, translation, stretch, bind_rotation, bind_frame: as in `RigModel`, the first 4 x 4.
        world: where each stands in the zero pose.
        shifting, scaling: joints but the root that an animation shifts, and any that it scales.
    """

    nodes: tuple[int, ...]
    place: dict[int, int]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    locals: tuple[Local, ...]
    before: Float[np.ndarray, "J 4 4"]
    translation: Float[np.ndarray, "J 3"]
    stretch: Float[np.ndarray, "J 3 3"]
    bind_rotation: Float[np.ndarray, "J 3 3"]
    bind_frame: Float[np.ndarray, "J 3 3"]
    world: Float[np.ndarray, "J 4 4"]
    shifting: tuple[int, ...]
    scaling: tuple[int, ...]


_NOTHING = Local(np.zeros(3), np.eye(3), np.eye(3), False)


def place_joints(
    nodes: Nodes, skins: list[Skin], character: Character, animations: list[Animation]
) -> Joints:
    """The joints of a character, parents first."""
    order = character.joints
    place = {node: k for k, node in enumerate(order) if node >= 0}
    names = _names([nodes.names[node] if node >= 0 else "world" for node in order])
    own = tuple(nodes.locals[node] if node >= 0 else _NOTHING for node in order)
    parents, before = [-1], [nodes.between(-1, order[0]) if order[0] >= 0 else np.eye(4)]
    for node in order[1:]:
        above = next((up for up in nodes.up(node)[1:] if up in place), -1)
        parents.append(place.get(above, 0))
        before.append(nodes.between(above, node))
    binds = [_binds(skins[k], place) for k in character.skins]
    turns, frames, world = [], [], []
    for joint, local in enumerate(own):
        up = world[parents[joint]] if joint else np.eye(4)
        turn = _bind_rotation(joint, parents, before, own, turns, binds)
        stands = up @ before[joint]
        frames.append(nearest_frame(stands[:3, :3]))
        turns.append(turn)
        world.append(stands @ affine(turn @ local.stretch, local.translation))
    shifting, scaling = _moving(place, own, animations, np.stack(world))
    return Joints(
        tuple(order),
        place,
        names,
        tuple(parents),
        own,
        np.stack(before),
        np.stack([local.translation for local in own]),
        np.stack([local.stretch for local in own]),
        np.stack(turns),
        np.stack(frames),
        np.stack(world),
        shifting,
        scaling,
    )


def _names(names: list[str]) -> tuple[str, ...]:
    """Unique names: nodes of the same name get a number."""
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name} {seen[name]}")
    return tuple(found)


def _binds(skin: Skin, place: dict[int, int]) -> dict[int, np.ndarray]:
    """Where the joints of a skin stood when it was bound, in its meshes' space."""
    return {
        place[node]: np.linalg.inv(matrix)
        for node, matrix in zip(skin.joints, skin.inverse_bind, strict=True)
        if np.linalg.cond(matrix[:3, :3]) < 1e8
    }


def _bind_rotation(joint: int, parents, before, own, turns, binds) -> np.ndarray:
    """The rotation of a joint when the skin was bound: from its place and that of one above.

    Where neither is known, the root's included, the file's own rotation stands for it.
    """
    for bind in binds:
        if joint not in bind:
            continue
        chain, above = before[joint], parents[joint]
        while above >= 0 and above not in bind:
            local = affine(turns[above] @ own[above].stretch, own[above].translation)
            chain, above = before[above] @ local @ chain, parents[above]
        if above < 0 or not np.linalg.cond(chain[:3, :3]) < 1e8:
            continue
        local = np.linalg.inv(chain) @ np.linalg.inv(bind[above]) @ bind[joint]
        # R S is nearest to it for the rotation nearest to it times S's transpose.
        product = local[:3, :3] @ own[joint].stretch.T
        if np.linalg.det(product) > 0 and np.linalg.cond(product) < 1e8:
            return nearest_rotation(product)
    return own[joint].rotation


def _moving(place, own, animations: list[Animation], world) -> tuple[tuple[int, ...], ...]:
    """Joints that an animation shifts against their parent, and those that it scales."""
    found: dict[str, set[int]] = {"translation": set(), "scale": set()}
    for channel in (channel for one in animations for channel in one.channels):
        joint = place.get(channel.node)
        if joint is None or channel.path not in found:
            continue
        local = own[joint]
        given = local.translation if channel.path == "translation" else np.diag(local.stretch)
        values = channel.values
        if channel.way == "CUBICSPLINE":
            values = np.concatenate([values[1::3] - given, values[0::3], values[2::3]]) + given
        unit = 1.0
        if channel.path == "translation":
            above = max(np.linalg.norm(world[joint][:3, :3], 2), 1e-12)
            unit = float(np.ptp(world[:, :3, 3], axis=0).max() or 1.0) / above
        if np.abs(values - given).max() > _STILL * unit:
            found[channel.path].add(joint)
    return tuple(sorted(found["translation"] - {0})), tuple(sorted(found["scale"]))
