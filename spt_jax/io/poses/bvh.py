"""BVH: a skeleton with its rest pose, and Euler angles in degrees for each of its joints.

The format is that of Biovision as Jeff Lander wrote it down ("Working with Motion Capture File
Formats", Game Developer, January 1998). What the bones are called and how the skeleton stands at
rest is every program's own: names are looked up in two lists, and a rest pose that is not SMPL's
T is turned into it where the difference is one of directions alone.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.io.poses.rotations import euler
from spt_jax.io.poses.source import Block, Source
from spt_jax.io.poses.track import Track

_MOST_DEPTH = 1000
# The longest a skeleton in metres is; those in centimetres or inches are longer.
_TALLEST = 4.0
# Beyond this the bones do not say how a joint is turned about its own bone.
_MOST_DEGREES = 75.0

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
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
# Towards which joint a bone runs, and its direction in SMPL's T pose: y up, x to the left.
_TOWARDS: dict[str, tuple[str, tuple[float, float, float]]] = {
    **{
        f"{side}_{joint}": (f"{side}_{child}", (sign * along, down, 0.0))
        for side, sign in (("left", 1.0), ("right", -1.0))
        for joint, child, along, down in (
            ("hip", "knee", 0.0, -1.0),
            ("knee", "ankle", 0.0, -1.0),
            ("shoulder", "elbow", 1.0, 0.0),
            ("elbow", "wrist", 1.0, 0.0),
        )
    },
}


class Joint(NamedTuple):
    """A joint of the file: its name, parent, offset, and the columns of its channels by name."""

    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...]
    column: int


def parse_bvh(content: bytes, path: Path) -> dict[str, Any]:
    """The tree of a BVH file: `header` (text), `joints`, `frame_time` and `motion`, a row a frame.

    Raises:
        ValueError: it is none, or is cut.
    """
    text = content.decode("utf-8-sig", "replace")
    head, found, rest = text.partition("MOTION")
    counts = re.match(r"\s*Frames:\s*(\S+)\s+Frame Time:\s*(\S+)[ \t]*\r?\n?", rest)
    if not found or counts is None:
        raise ValueError(
            f"pose file must have MOTION, Frames and Frame Time after its skeleton: got "
            f"{str(path)!r} without; it is cut."
        )
    joints = _joints(head.split(), path)
    width = sum(len(joint.channels) for joint in joints)
    numbers = rest[counts.end() :].split()
    try:
        frames, time = int(counts[1]), float(counts[2])
        motion = np.array(numbers, np.float64)
    except ValueError as error:
        raise ValueError(
            f"MOTION must hold numbers: got {str(path)!r} with {str(error)[:80]}; it is damaged."
        ) from None
    if frames < 1 or not width or len(motion) != frames * width:
        raise ValueError(
            f"MOTION must hold {counts[1]} frames of {width} numbers: got {len(motion)} numbers in "
            f"{str(path)!r}; it is cut or damaged."
        )
    return {
        "header": head,
        "joints": joints,
        "frame_time": time,
        "motion": motion.reshape(frames, width),
    }


def _joints(words: list[str], path: Path) -> list[Joint]:
    joints: list[Joint] = []
    stack: list[int] = []
    column, k = 0, 1

    def wrong(what: str) -> ValueError:
        return ValueError(
            f"HIERARCHY must be a tree of ROOT, JOINT and End Site: got {str(path)!r} with {what}; "
            "it is cut or damaged."
        )

    try:
        while k < len(words):
            word = words[k]
            if word in ("ROOT", "JOINT", "End"):
                end = words.index("{", k)
                name = " ".join(words[k + 1 : end])
                if words[end + 1] != "OFFSET" or len(stack) > _MOST_DEPTH:
                    raise wrong(f"{name[:40]!r} without OFFSET")
                offset = tuple(float(x) for x in words[end + 2 : end + 5])
                if not np.isfinite(offset).all():
                    raise wrong(f"an offset of {offset} at {name[:40]!r}")
                parent = stack[-1] if stack else -1
                channels: tuple[str, ...] = ()
                k = end + 5
                if word != "End":
                    if words[k] != "CHANNELS":
                        raise wrong(f"{name[:40]!r} without CHANNELS")
                    count = int(words[k + 1])
                    channels = tuple(words[k + 2 : k + 2 + count])
                    if not all(_CHANNEL.fullmatch(channel) for channel in channels):
                        raise wrong(f"the channels {' '.join(channels)[:60]}")
                    k += 2 + count
                stack.append(len(joints))
                joints.append(Joint(name, parent, offset, channels, column))  # pyright: ignore
                column += len(channels)
            elif word == "}":
                stack.pop()
                k += 1
            else:
                raise wrong(repr(word[:40]))
    except (IndexError, ValueError) as error:
        if "HIERARCHY" in str(error):
            raise
        raise wrong(" ".join(str(error).split())[:80]) from None
    if stack or not joints:
        raise wrong("brackets that are not closed" if stack else "nothing")
    return joints


def as_bvh(tree: dict[str, Any]) -> bytes:
    """The file of such a tree."""
    motion = tree["motion"]
    lines = [
        tree["header"].rstrip() + "\nMOTION",
        f"Frames: {len(motion)}",
        f"Frame Time: {tree['frame_time']!r}",
        *(" ".join(map(repr, row)) for row in motion.tolist()),
    ]
    return ("\n".join(lines) + "\n").encode()


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
            f"the skeleton must have bones called as SMPL's, Mixamo's or CMU's: got "
            f"{source.file!r} without {', '.join(missing)}, and with {bones[:200]}; rename them"
        )
    count = next(n for n in (22, 24, 52) if all(name in SMPL_LAYOUTS[n] for name in found))
    layout = SMPL_LAYOUTS[count]
    rest = _rest_turns(source, joints, found)
    by_joint = {k: name for name, k in found.items()}
    pose, blocks = np.zeros((len(motion), count, 3)), []
    for k, joint in enumerate(joints):
        turns = [c for c in joint.channels if c.lower().endswith("rotation")]
        if k not in by_joint:
            columns = [joint.column + joint.channels.index(c) for c in turns]
            if turns and motion[:, columns].any():
                source.note(f"bones that SMPL does not have are left out, such as {joint.name}")
            continue
        if len(turns) != 3 or len({c[0] for c in turns}) != 3:
            raise ValueError(
                f"CHANNELS of {joint.name} must hold three rotations: got {' '.join(turns)} in "
                f"{source.file!r}"
            )
        order = "".join(c[0].upper() for c in turns)
        index = (slice(None), [joint.column + joint.channels.index(c) for c in turns])
        row = layout.index(by_joint[k])
        parent = _turn_of_parent(joints, k, rest)
        block = Block(("motion",), index, euler(order, parent.T, rest.get(k, np.eye(3))), (row,))
        pose[:, row] = block.form.decode(motion[index])
        blocks.append(block)
    time = source.tree["frame_time"]
    source.used |= {("header",), ("joints",), ("frame_time",)}
    rate = 1 / time if np.isfinite(time) and time > 1e-6 else None
    track = Track(source.stem, pose, frame_rate=rate, blocks=tuple(blocks))
    return [_placed(source, track, joints[found["pelvis"]], motion, _height(joints))]


def _turn_of_parent(joints: list[Joint], k: int, rest: dict[int, np.ndarray]) -> np.ndarray:
    """How the rest pose of the nearest known joint above differs."""
    parent = joints[k].parent
    while parent >= 0 and parent not in rest:
        parent = joints[parent].parent
    return rest.get(parent, np.eye(3))


def _rest_turns(
    source: Source, joints: list[Joint], found: dict[str, int]
) -> dict[int, np.ndarray]:
    """For each known joint, what turns SMPL's rest pose into the file's there.

    Raises:
        ValueError: they are too far apart for the bones' directions to tell.
    """
    turns: dict[int, np.ndarray] = {k: np.eye(3) for k in found.values()}
    largest = 0.0
    for name, (child, direction) in _TOWARDS.items():
        if name not in found or child not in found:
            continue
        offset, k = np.zeros(3), found[child]
        while k != found[name] and k >= 0:
            offset, k = offset + joints[k].offset, joints[k].parent
        length = np.linalg.norm(offset)
        if k < 0 or not length > 0:
            continue
        bone = offset / length
        cosine = float(np.clip(bone @ direction, -1, 1))
        angle = np.degrees(np.arccos(cosine))
        if angle > _MOST_DEGREES:
            raise ValueError(
                f"the skeleton must rest in a T or A pose, y up and x to its left: got "
                f"{joints[found[name]].name} {angle:.0f} degrees off in {source.file!r}; set the "
                "T pose as its rest pose in the program that wrote it, such as Blender"
            )
        axis = np.cross(direction, bone)
        size = np.linalg.norm(axis)
        if angle > 15.0 and size > 0:  # an A pose; less is the anatomy of the skeleton
            largest = max(largest, angle)
            turns[found[name]] = Rotation.from_rotvec(axis / size * np.radians(angle)).as_matrix()
    if largest:
        source.note(f"the skeleton's rest pose is turned into SMPL's T, by {largest:.0f} degrees")
    return turns


def _height(joints: list[Joint]) -> float:
    """From the lowest to the highest point of the skeleton at rest."""
    places = np.zeros((len(joints), 3))
    for k, joint in enumerate(joints):
        above = places[joint.parent] if joint.parent >= 0 else np.zeros(3)
        places[k] = above + joint.offset
    return float(np.ptp(places, axis=0).max())


def _placed(source: Source, track: Track, root: Joint, motion: np.ndarray, height: float) -> Track:
    """The track with positions in metres, where its root moves."""
    moves = [c for c in root.channels if c.lower().endswith("position")]
    if sorted(c[0].upper() for c in moves) != ["X", "Y", "Z"]:
        return track
    columns = [root.column + root.channels.index(c) for c in sorted(moves, key=str.upper)]
    unit = 1.0 if height <= _TALLEST else 0.0254 if height <= 110 and height > 50 else 0.01
    if unit != 1.0:
        name = "centimetres" if unit == 0.01 else "inches"
        source.note(f"positions are taken for {name}: the skeleton is {height:.0f} of them long")
    shift = (motion[:, columns] - np.array(root.offset)) * unit
    return replace(track, translation=shift)
