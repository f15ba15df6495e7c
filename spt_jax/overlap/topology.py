"""Edges of a triangle surface, and what is connected through them; NumPy only."""

import numpy as np
from jaxtyping import Int


class Edges:
    """The undirected edges of a surface and the half-edges (face, corner) that run along them.

    Attributes:
        ends: (E, 2) vertices of each edge, the lower first.
        faces: how many faces it has.
        imbalance: how many more of them run from the lower end to the higher than back.
        edge, face: of each half-edge, sorted by edge.
    """

    def __init__(self, surface: Int[np.ndarray, "F 3"]):
        self._surface = surface
        tail, head = surface.ravel(), np.roll(surface, -1, axis=1).ravel()
        low, high = np.minimum(tail, head), np.maximum(tail, head)
        width = int(surface.max(initial=0)) + 1
        _, first, edge, self.faces = np.unique(
            low * width + high, return_index=True, return_inverse=True, return_counts=True
        )
        self.ends = np.stack([low[first], high[first]], axis=1)
        sense = np.where(tail < head, 1, -1)
        self.imbalance = np.bincount(edge, sense, len(self.faces)).astype(np.int64)
        self._half = np.argsort(edge, kind="stable")
        self.edge, self.face = edge[self._half], self._half // 3
        self._forward = tail[self._half] < head[self._half]
        self._meet = np.flatnonzero(self.edge[1:] == self.edge[:-1])  # with the next half-edge

    def components(self) -> Int[np.ndarray, "F"]:
        """A number for each face, shared by the faces that are connected through edges."""
        meet = self._meet
        return connected(self.face[meet], self.face[meet + 1], len(self._surface))

    def pinched_vertices(self) -> int:
        """How many vertices have faces in more than one fan."""
        # Half-edge k of a face starts at corner k; the corners of two faces at one end of their
        # common edge belong to one fan.
        start = self._half
        end = 3 * self.face + (start + 1) % 3
        low, high = np.where(self._forward, (start, end), (end, start))
        meet = self._meet
        fan = connected(
            np.concatenate([low[meet], high[meet]]),
            np.concatenate([low[meet + 1], high[meet + 1]]),
            self._surface.size,
        )
        vertex = self._surface.ravel()[np.unique(fan)]  # a fan is named by one of its corners
        return int(np.count_nonzero(np.unique(vertex, return_counts=True)[1] > 1))


def connected(
    first: Int[np.ndarray, "L"], second: Int[np.ndarray, "L"], count: int
) -> Int[np.ndarray, "count"]:
    """The lowest member of each item's component, where links join `first` to `second`."""
    label = np.arange(count)
    while True:
        # Every root moves under its lowest neighbor, then every path is shortened to its root.
        a, b = label[first], label[second]
        apart = a != b
        if not apart.any():
            return label
        first, second, a, b = first[apart], second[apart], a[apart], b[apart]
        np.minimum.at(label, np.maximum(a, b), np.minimum(a, b))
        while (label[label] != label).any():
            label = label[label]


def distinct(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "G 3"]:
    """The faces without those that repeat another in the same sense, from any corner on."""
    start = np.argmin(faces, axis=1)[:, None] if len(faces) else np.zeros((0, 1), np.int64)
    turned = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)
    return np.unique(turned, axis=0)


def count_loops(boundary: Int[np.ndarray, "E 2"]) -> int:
    """How many connected loops some edges form; loops that share a vertex are one."""
    vertices, ends = np.unique(boundary, return_inverse=True)
    ends = ends.reshape(-1, 2)
    return len(np.unique(connected(ends[:, 0], ends[:, 1], len(vertices))))
