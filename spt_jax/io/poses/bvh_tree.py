"""BVH as text: the tree of its joints, and a row of numbers for each frame.

The format is that of Biovision as Jeff Lander wrote it down ("Working with Motion Capture File
Formats", Game Developer, January 1998).
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_MOST_DEPTH = 1000
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)


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
