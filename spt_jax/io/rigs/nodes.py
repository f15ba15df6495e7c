"""The tree of a glTF's nodes: where each stands, and what turns it."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.io.meshes.raw import UnreadableError
from spt_jax.io.rigs.document import Document, checked_index

# Deeper trees are no characters; the arrays of transforms follow them level by level.
_DEEPEST = 1000


class Local(NamedTuple):
    """A node's own transform: translation, rotation, and what is applied before both.

    Attributes:
        translation: in the parent's units.
        rotation: orthonormal.
        stretch: scale, on its diagonal; of a node with a matrix whatever the rotation leaves.
        is_matrix: whether the file has a matrix, which no animation may turn.
    """

    translation: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    stretch: Float[np.ndarray, "3 3"]
    is_matrix: bool

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The same in one matrix."""
        return affine(self.rotation @ self.stretch, self.translation)


class Nodes(NamedTuple):
    """All nodes.

    Attributes:
        names: "node 3" where the file has none.
        parents: -1 for roots.
        locals: the transform of each.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    locals: tuple[Local, ...]

    def up(self, node: int) -> list[int]:
        """A node and all above it."""
        found = []
        while node >= 0:
            found.append(node)
            node = self.parents[node]
        return found

    def between(self, above: int, node: int) -> Float[np.ndarray, "4 4"]:
        """What the nodes strictly between do together; `above` may be -1, for the world."""
        product = np.eye(4)
        for one in self.up(node)[1:]:
            if one == above:
                return product
            product = self.locals[one].matrix() @ product
        return product

    def common(self, nodes: Iterable[int]) -> int:
        """The lowest node that is at or above all of them; -1 where there is none."""
        chains = [self.up(node)[::-1] for node in nodes]
        found = -1
        for level in zip(*chains, strict=False):
            if len(set(level)) > 1:
                break
            found = level[0]
        return found


def read_nodes(document: Document) -> Nodes:
    """The nodes of a file.

    Raises:
        UnreadableError: they are no tree, or a transform is none.
    """
    items = document.items("nodes")
    parents = [-1] * len(items)
    for number, node in enumerate(items):
        for child in _list(node.get("children", []), f"the children of node {number}"):
            rule = f"the children of node {number} must be nodes"
            child = checked_index(child, len(items), rule)
            if parents[child] >= 0 or child == number:
                raise UnreadableError(
                    f"nodes must be a tree: node {child} is a child of node {parents[child]} and "
                    f"of node {number}; the file is damaged, export it again"
                )
            parents[child] = number
    _check_tree(parents)
    names = tuple(str(node.get("name") or f"node {k}") for k, node in enumerate(items))
    found = tuple(_local(node, f"node {k} ({names[k]!r})") for k, node in enumerate(items))
    return Nodes(names, tuple(parents), found)


def _check_tree(parents: Sequence[int]) -> None:
    for start in range(len(parents)):
        node, steps = start, 0
        while node >= 0:
            node, steps = parents[node], steps + 1
            if steps > min(len(parents), _DEEPEST):
                raise UnreadableError(
                    f"nodes must be a tree of at most {_DEEPEST} levels: node {start} stands in a "
                    "circle, or deeper; the file is damaged, export it again"
                )


def _local(node: dict[str, Any], where: str) -> Local:
    if "matrix" in node:
        matrix = _numbers(node["matrix"], 16, f"the matrix of {where}").reshape(4, 4).T
        rotation = nearest_rotation(matrix[:3, :3])
        return Local(matrix[:3, 3], rotation, rotation.T @ matrix[:3, :3], True)
    translation = _numbers(node.get("translation", [0, 0, 0]), 3, f"the translation of {where}")
    scale = _numbers(node.get("scale", [1, 1, 1]), 3, f"the scale of {where}")
    turn = _numbers(node.get("rotation", [0, 0, 0, 1]), 4, f"the rotation of {where}")
    length = np.linalg.norm(turn)
    if not abs(length - 1) < 0.1:
        raise UnreadableError(
            f"the rotation of {where} must be a quaternion of length 1: got length {length:.3g}"
        )
    return Local(translation, matrices_of_quaternions(turn), np.diag(scale), False)


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise UnreadableError(f"{what} must be a list: got {value!r}")
    return value


def _numbers(value: Any, count: int, what: str) -> Float[np.ndarray, "N"]:
    numbers = [one for one in _list(value, what) if isinstance(one, int | float)]
    try:
        array = np.array(numbers, np.float64)
    except OverflowError:
        array = np.array([np.inf])
    if len(numbers) != len(value) or array.shape != (count,) or not np.isfinite(array).all():
        raise UnreadableError(f"{what} must be {count} finite numbers: got {str(value)[:80]}")
    return array


def affine(linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> np.ndarray:
    """A 4 x 4 matrix of a linear map and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def nearest_rotation(linear: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a linear map; none at all where it has no volume."""
    if not np.linalg.cond(linear) < 1e8:
        return np.eye(3)
    left, _, right = np.linalg.svd(linear)
    left[:, -1] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    return left @ right


def nearest_frame(linear: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The same, mirrored where the map mirrors."""
    return nearest_rotation(linear) if np.linalg.det(linear) > 0 else -nearest_rotation(-linear)


def matrices_of_quaternions(turn: Float[np.ndarray, "*N 4"]) -> Float[np.ndarray, "*N 3 3"]:
    """Rotation matrices of quaternions (x, y, z, w), of any length but zero."""
    x, y, z, w = np.moveaxis(turn / np.linalg.norm(turn, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
