"""BVH: a skeleton with its rest pose, and Euler angles in degrees for each of its joints.

What the bones are called and how the skeleton stands at rest is every program's own: names are
looked up in two lists, and `bvh_rest` finds the stance that is SMPL's T pose.
"""

import re
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.io.poses.bvh_rest import rest_of
from spt_jax.io.poses.bvh_tree import Joint
from spt_jax.io.poses.rotations import euler
from spt_jax.io.poses.source import Block, Source
from spt_jax.io.poses.track import Track

# The longest a skeleton in metres is; those in centimetres or inches are longer.
_TALLEST = 4.0

# What bones are called after `_plain`, in SMPL's order of the first 22 joints: by SMPL itself, and
# by Mixamo, CMU (cgspeed's conversion), LAFAN1 and MotionBuilder.
_OWN = tuple(name.replace("_", "") for name in SMPL_LAYOUTS[24])
_COMMON: dict[str, tuple[str, ...]] = {
    "pelvis": ("hips", "hip", "pelvis", "root"),
    "spine1": ("spine", "lowerback", "abdomen"),
    "spine2": ("spine1", "chest"),
    "spine3": ("spine2", "spine3", "chest2", "upperchest"),
    "neck": ("neck", "neck1"),
    "head": ("head",),
}
_SIDED: dict[str, tuple[str, ...]] = {
    "hip": ("upleg", "thigh", "upperleg"),
    "knee": ("leg", "shin", "lowerleg"),
    "ankle": ("foot",),
    "foot": ("toebase", "toe"),
    "collar": ("shoulder", "clavicle"),
    "shoulder": ("arm", "upperarm"),
    "elbow": ("forearm", "lowerarm"),
    "wrist": ("hand",),
}
_FINGER = re.compile(r"(left|right)(?:hand)?(thumb|index|middle|ring|pinky)([123])")
_NEEDED = ("pelvis", "left_hip", "right_hip", "left_shoulder", "right_shoulder")


def _plain(name: str) -> str:
    """A bone's name without its namespace, side first: of "mixamorig:LeftUpLeg", "thigh.L"."""
    short = re.split(r"[:|]", name)[-1].removeprefix("mixamorig")
    side = ""
    found = re.match(r"(?i)(left|right)[_ .-]?", short) or re.match(r"(?i)([lr])[_ .-]+", short)
    if found is None:
        found = re.match(r"([lr])(?=[A-Z])", short)
    if found is not None:
        side, short = found[1].lower()[0], short[found.end() :]
    elif (found := re.search(r"(?i)[_ .-](left|right|l|r)$", short)) is not None:
        side, short = found[1].lower()[0], short[: found.start()]
    side = {"l": "left", "r": "right", "": ""}[side]
    return side + re.sub(r"[^a-z0-9]", "", short.lower())


def _matched(joints: list[Joint]) -> dict[str, int]:
    """Which joint of the file is which of SMPL's, by name."""
    names = [_plain(joint.name) if joint.channels else "" for joint in joints]
    found: dict[str, int] = {}
    own = sum(name in names for name in ("leftcollar", "lefthip", "leftknee", "leftankle")) >= 3
    if own:
        for name, plain in zip(SMPL_LAYOUTS[24], _OWN, strict=True):
            if plain in names:
                found[name] = names.index(plain)
    else:
        wanted = dict(_COMMON)
        for side in ("left", "right"):
            wanted |= {f"{side}_{j}": tuple(side + n for n in bones) for j, bones in _SIDED.items()}
        for name, bones in wanted.items():
            k = next((names.index(bone) for bone in bones if bone in names), None)
            if k is not None and k not in found.values():
                found[name] = k
    if "pelvis" not in found and joints[0].channels:
        found["pelvis"] = 0
    for k, name in enumerate(names):
        finger = _FINGER.fullmatch(name)
        if finger is not None:
            found.setdefault(f"{finger[1]}_{finger[2]}{finger[3]}", k)
    return found


def read_bvh(source: Source) -> list[Track]:
    """BVH: one skeleton, whose bones are found by name."""
    joints: list[Joint] = source.tree["joints"]
    motion = source.numbers(("motion",), most=1e7)
    found = _matched(joints)
    missing = [name for name in _NEEDED if name not in found]
    if missing:
        bones = ", ".join(joint.name for joint in joints if joint.channels)
        raise ValueError(
            f"the skeleton must have bones called as SMPL's, Mixamo's, CMU's or LAFAN1's: got "
            f"{source.file!r} without {', '.join(missing)}, and with {bones[:200]}; rename them"
        )
    count = next(n for n in (22, 24, 52) if all(name in SMPL_LAYOUTS[n] for name in found))
    layout = SMPL_LAYOUTS[count]
    rest = rest_of(joints, found, lambda: _first_frame(joints, motion), source.file)
    source.note(rest.note)
    by_joint = {k: name for name, k in found.items()}
    pose, blocks = np.zeros((len(motion), count, 3)), []
    for k, joint in enumerate(joints):
        turns = _rotations(joint)
        if k not in by_joint:
            columns = _columns(joint, turns)
            if turns and motion[:, columns].any():
                source.note(f"bones that SMPL does not have are left out, such as {joint.name}")
            continue
        if len(turns) != 3 or len({c[0] for c in turns}) != 3:
            raise ValueError(
                f"CHANNELS of {joint.name} must hold three rotations: got {' '.join(turns)} in "
                f"{source.file!r}"
            )
        order = _order(turns)
        index = (slice(None), _columns(joint, turns))
        row = layout.index(by_joint[k])
        block = Block(("motion",), index, euler(order, rest.above[k], rest.turns[k]), (row,))
        pose[:, row] = block.form.decode(motion[index])
        blocks.append(block)
    time = source.tree["frame_time"]
    source.used |= {("header",), ("joints",), ("frame_time",)}
    rate = 1 / time if np.isfinite(time) and time > 1e-6 else None
    track = Track(source.stem, pose, frame_rate=rate, blocks=tuple(blocks))
    return [_placed(source, track, joints[found["pelvis"]], motion, rest.height)]


def _rotations(joint: Joint) -> list[str]:
    """The joint's channels that are rotations, in their order."""
    return [channel for channel in joint.channels if channel.lower().endswith("rotation")]


def _columns(joint: Joint, channels: list[str]) -> list[int]:
    return [joint.column + joint.channels.index(channel) for channel in channels]


def _order(turns: list[str]) -> str:
    """The axes about which it turns, one after the other."""
    return "".join(channel[0].upper() for channel in turns)


def _first_frame(joints: list[Joint], motion: np.ndarray) -> list[np.ndarray]:
    """Each joint's rotation against its parent in the first frame."""
    found = []
    for joint in joints:
        turns, matrix = _rotations(joint), np.eye(3)
        for axis, column in zip(_order(turns), _columns(joint, turns), strict=True):
            matrix = matrix @ Rotation.from_euler(axis, motion[0, column], degrees=True).as_matrix()
        found.append(matrix)
    return found


def _placed(source: Source, track: Track, root: Joint, motion: np.ndarray, height: float) -> Track:
    """The track with positions in metres, where its root moves."""
    moves = [c for c in root.channels if c.lower().endswith("position")]
    if sorted(c[0].upper() for c in moves) != ["X", "Y", "Z"]:
        return track
    columns = _columns(root, sorted(moves, key=str.upper))
    unit = 1.0 if height <= _TALLEST else 0.0254 if height <= 110 and height > 50 else 0.01
    if unit != 1.0:
        name = "centimetres" if unit == 0.01 else "inches"
        source.note(f"positions are taken for {name}: the skeleton is {height:.0f} of them long")
    shift = (motion[:, columns] - np.array(root.offset)) * unit
    return replace(track, translation=shift)
