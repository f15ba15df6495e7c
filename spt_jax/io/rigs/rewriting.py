"""A motion put back into the file that its character came from, as one more animation."""

import copy
import mimetypes
from dataclasses import replace
from typing import Any

import numpy as np

from spt_jax.io.rigs.animations import Animation
from spt_jax.io.rigs.building import Built
from spt_jax.io.rigs.clips import Clip, quaternions_of_pose
from spt_jax.io.rigs.document import DTYPES, Document

# Of what turns less than this, in radians, the file's own channel stays.
_STILL = 1e-6
_FLOAT = 5126


def with_animation(
    document: Document,
    built: Built,
    clip: Clip,
    before: Clip,
    source: Animation | None,
    name: str,
) -> Document:
    """The document with one more animation.

    Args:
        document: the file.
        built: the character.
        clip: its motion.
        before: the same before it was changed.
        source: the animation that it was sampled from.
        name: of the new one.

    Raises:
        ValueError: a joint that turns has a matrix that shears.
    """
    tree = copy.deepcopy(document.tree)
    changed = np.flatnonzero(_turned(built, clip, before))
    nodes = [built.joints.nodes[joint] for joint in changed]
    for joint, node in zip(changed, nodes, strict=True):
        _take_apart(tree, built, int(joint), node)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    if source is not None:
        given = tree["animations"][source.number]
        samplers = copy.deepcopy(given["samplers"])
        channels = [
            channel
            for channel in copy.deepcopy(given["channels"])
            if channel["target"].get("node") not in nodes or channel["target"]["path"] != "rotation"
        ]
    written = Written(tree, document)
    if len(changed) or not channels:
        times = written.accessor(clip.times.astype(np.float32), "SCALAR", bounds=True)
        turns = quaternions_of_pose(built, clip.pose)
        # An animation needs a channel: where nothing turns the root's says so.
        for joint in changed if len(changed) else [_first(built)]:
            values = turns[:, joint].astype(np.float32)
            values /= np.linalg.norm(values, axis=1, keepdims=True)
            samplers.append(
                {
                    "input": times,
                    "output": written.accessor(values, "VEC4"),
                    "interpolation": "LINEAR",
                }
            )
            node = built.joints.nodes[joint]
            channels.append(
                {
                    "sampler": len(samplers) - 1,
                    "target": {"node": int(node), "path": "rotation"},
                }
            )
    used = sorted({channel["sampler"] for channel in channels})
    place = {old: new for new, old in enumerate(used)}
    for channel in channels:
        channel["sampler"] = place[channel["sampler"]]
    animation = {"name": name, "samplers": [samplers[k] for k in used], "channels": channels}
    tree.setdefault("animations", []).append(animation)
    return written.document()


def _first(built: Built) -> int:
    return next(k for k, node in enumerate(built.joints.nodes) if node >= 0)


def _turned(built: Built, clip: Clip, before: Clip) -> np.ndarray:
    one, other = quaternions_of_pose(built, clip.pose), quaternions_of_pose(built, before.pose)
    if one.shape != other.shape or not np.allclose(clip.times, before.times):
        return np.array([node >= 0 for node in built.joints.nodes])
    # The angle between two rotations, without the cosine's rounding near none.
    apart = np.minimum(np.abs(one - other).max(axis=2), np.abs(one + other).max(axis=2))
    return (apart.max(axis=0) > _STILL) & (np.array(built.joints.nodes) >= 0)


def _take_apart(tree: dict[str, Any], built: Built, joint: int, node: int) -> None:
    """Translation, rotation and scale in place of a matrix, which an animation may not turn."""
    if "matrix" not in tree["nodes"][node]:
        return
    local = built.joints.locals[joint]
    scale = np.diag(local.stretch)
    if np.abs(local.stretch - np.diag(scale)).max() > 1e-5 * np.abs(scale).max():
        raise ValueError(
            f"node {node} ({built.joints.names[joint]!r}) must have translation, rotation and "
            "scale for an animation to turn it: got a matrix that shears; apply its scale in the "
            "program that made it, and export it again."
        )
    del tree["nodes"][node]["matrix"]
    quaternion = quaternions_of_matrix(local.rotation)
    tree["nodes"][node] |= {
        "translation": local.translation.tolist(),
        "rotation": quaternion,
        "scale": scale.tolist(),
    }


def quaternions_of_matrix(rotation: np.ndarray) -> list[float]:
    """The quaternion of one rotation, as JSON has it."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat().tolist()


class Written:
    """Arrays appended to a document's first buffer, into which all others go, too.

    Args:
        tree: the JSON to change.
        document: what it is from.
    """

    def __init__(self, tree: dict[str, Any], document: Document):
        self.tree, self._source = tree, document
        self._data = bytearray()
        starts = [self._append(buffer) for buffer in document.buffers]
        if len(document.buffers) > 1:
            for view in tree.get("bufferViews", ()):
                view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
                view["buffer"] = 0
        self._embed_images()

    def _append(self, content: bytes) -> int:
        self._data += b"\0" * (-len(self._data) % 4)
        start = len(self._data)
        self._data += content
        return start

    def _view(self, content: bytes) -> int:
        start = self._append(content)
        views = self.tree.setdefault("bufferViews", [])
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content)})
        return len(views) - 1

    def accessor(self, values: np.ndarray, kind: str, *, bounds: bool = False) -> int:
        """The number of a new accessor of float32, with its least and largest values if asked."""
        return self._accessor(np.ascontiguousarray(values, "<f4"), kind, _FLOAT, bounds)

    def whole(self, values: np.ndarray, kind: str, component: int) -> int:
        """The number of a new accessor of whole numbers, of a component type of glTF's."""
        array = np.ascontiguousarray(values, DTYPES[component])
        return self._accessor(array, kind, component, False)

    def _accessor(self, array: np.ndarray, kind: str, component: int, bounds: bool) -> int:
        accessor: dict[str, Any] = {
            "bufferView": self._view(array.tobytes()),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        accessors = self.tree.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1

    def _embed_images(self) -> None:
        """Images that lie beside the file come into it, where they are found."""
        folder = self._source.path.parent.resolve()
        for image in self.tree.get("images", ()):
            uri = image.get("uri") if isinstance(image, dict) else None
            if not isinstance(uri, str) or uri.startswith("data:") or "://" in uri:
                continue
            file = (folder / uri).resolve()
            kind = mimetypes.guess_type(file.name)[0]
            if file.is_relative_to(folder) and file.is_file() and kind in _IMAGES:
                del image["uri"]
                image |= {"bufferView": self._view(file.read_bytes()), "mimeType": kind}

    def document(self) -> Document:
        """The document with what was appended."""
        self.tree["buffers"] = [{"byteLength": len(self._data)}]
        return replace(self._source, tree=self.tree, buffers=(bytes(self._data),))


_IMAGES = ("image/png", "image/jpeg")
