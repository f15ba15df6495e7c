"""glTF's animations: keys and how they are joined, sampled at any times."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.document import Document, checked_index

_KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3", "weights": "SCALAR"}
_WAYS = ("STEP", "LINEAR", "CUBICSPLINE")

# Keys that lie at least so near to each other say themselves how fast a motion goes.
_SLOWEST, _FASTEST, _USUAL = 20.0, 250.0, 30.0


class Channel(NamedTuple):
    """What one property of one node does over time.

    Attributes:
        node: which.
        path: "translation", "rotation", "scale" or "weights".
        times: of the keys, in seconds, rising.
        values: of each key; of splines with the tangents before and after.
        way: how keys are joined: "STEP", "LINEAR" or "CUBICSPLINE".
    """

    node: int
    path: str
    times: Float[np.ndarray, "K"]
    values: Float[np.ndarray, "K N"]
    way: str

    def at(self, times: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T N"]:
        """Values at some times; before the first key and after the last those of that key."""
        keys, values = self.times, self.values
        count = len(keys)
        if self.way == "CUBICSPLINE":
            incoming, values, outgoing = values[0::3], values[1::3], values[2::3]
        left = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, max(count - 2, 0))
        if count == 1:
            found = np.repeat(values, len(times), axis=0)
        elif self.way == "STEP":
            # The last key holds from its own time on.
            found = values[np.where(times >= keys[-1], count - 1, left)]
        elif self.way == "CUBICSPLINE":
            span = keys[left + 1] - keys[left]
            t = np.clip((times - keys[left]) / np.where(span > 0, span, 1), 0, 1)[:, None]
            b, c = span[:, None] * outgoing[left], span[:, None] * incoming[left + 1]
            found = (2 * t**3 - 3 * t**2 + 1) * values[left] + (t**3 - 2 * t**2 + t) * b
            found += (-2 * t**3 + 3 * t**2) * values[left + 1] + (t**3 - t**2) * c
        elif self.path == "rotation":
            found = Slerp(keys, Rotation.from_quat(values))(np.clip(times, keys[0], keys[-1]))
            return found.as_quat()
        else:
            span = keys[left + 1] - keys[left]
            t = np.clip((times - keys[left]) / np.where(span > 0, span, 1), 0, 1)[:, None]
            found = (1 - t) * values[left] + t * values[left + 1]
        if self.path == "rotation":
            found = found / np.linalg.norm(found, axis=1, keepdims=True)
        return found


class Animation(NamedTuple):
    """An animation: a name, its number in the file, and its channels."""

    name: str
    number: int
    channels: tuple[Channel, ...]

    def times(self, rate: float | None) -> tuple[Float[np.ndarray, "T"], float]:
        """When it is sampled, and how often a second.

        Args:
            rate: frames a second; where None that of the keys, or 30 where they lie far apart.
        """
        keys = np.unique(np.concatenate([channel.times for channel in self.channels]))
        first, last = float(keys[0]), float(keys[-1])
        if rate is None:
            gaps = np.diff(keys)
            gaps = gaps[gaps > 0.5 / _FASTEST]
            step = float(gaps.min()) if len(gaps) else 1 / _USUAL
            # Whole frames of the program that wrote it, or keys at any time.
            even = np.abs(np.diff(keys) / step - np.rint(np.diff(keys) / step)).max(initial=0)
            rate = 1 / step if even < 0.05 and 1 / step >= _SLOWEST else _USUAL
            rate = round(rate) if abs(rate - round(rate)) < 0.02 else rate
        count = int(np.floor((last - first) * rate + 1e-3)) + 1
        return first + np.arange(count) / rate, float(rate)


def read_animations(document: Document, nodes: int, targets: dict[int, int], notes: list[str]):
    """All animations of a file.

    Args:
        document: the file.
        nodes: how many nodes it has.
        targets: of each node with morph targets, how many.
        notes: what is left out is appended.

    Raises:
        UnreadableError: a channel or sampler is damaged.
    """
    found = []
    for number, animation in enumerate(document.items("animations")):
        name = str(animation.get("name") or f"animation {number}")
        where = f"animation {number} ({name!r})"
        samplers = animation.get("samplers", [])
        channels = []
        for k, channel in enumerate(animation.get("channels", ())):
            target, of = channel.get("target", {}), f"channel {k} of {where}"
            if target.get("path") == "pointer" or "node" not in target:
                notes.append(f"{of} moves no node, and is left out")
                continue
            node = checked_index(target["node"], nodes, f"the node of {of} must be a node")
            path = target.get("path")
            if path not in _KINDS:
                raise UnreadableError(f"the path of {of} must be one of {', '.join(_KINDS)}")
            rule = f"the sampler of {of} must be one of the animation's"
            sampler = samplers[checked_index(channel.get("sampler"), len(samplers), rule)]
            channels.append(_channel(document, sampler, node, path, targets.get(node, 0), of))
        if channels:
            found.append(Animation(name, number, tuple(channels)))
    return found


def _channel(document, sampler: dict[str, Any], node: int, path: str, targets: int, of: str):
    way = sampler.get("interpolation", "LINEAR")
    if way not in _WAYS:
        raise UnreadableError(f"the interpolation of {of} must be one of {', '.join(_WAYS)}")
    times = document.array(sampler.get("input"), "SCALAR", f"the input of {of}").astype(float)
    values = document.array(sampler.get("output"), _KINDS[path], f"the output of {of}")
    if not len(times) or (np.diff(times) <= 0).any():
        raise UnreadableError(f"the input of {of} must be times that rise")
    if path == "weights":
        values = values.reshape(-1, targets) if targets and not values.size % targets else values
    rows = len(times) * (3 if way == "CUBICSPLINE" else 1)
    if values.ndim != 2 or len(values) != rows:
        raise UnreadableError(
            f"the output of {of} must have {rows} rows, for {len(times)} times: got {len(values)}"
        )
    if path == "rotation":
        turn = values[1::3] if way == "CUBICSPLINE" else values
        if (np.linalg.norm(turn, axis=1) < 0.1).any():
            raise UnreadableError(f"the output of {of} must be quaternions of length 1: got 0")
    return Channel(node, path, times, values.astype(float), way)
