"""Vertices in connected blocks, so that what joins them is looked at block by block.

Which vertices are joined by edges that pass through nothing has to be known at every call, and
nearly all of a mesh's edges pass through nothing. A block none of whose edges is cut is one node;
only the vertices of the others are nodes of their own.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Int

from spt_jax.overlap.arrays.ranges import spread, unique

# Vertices to a block: of a posed body 20 to 60 blocks are cut.
_SIZE = 32


@dataclass(frozen=True)
class Blocks:
    """Blocks of vertices, each connected by edges of its own.

    Attributes:
        ends: of each edge.
        block: of each vertex.
        count: how many blocks there are.
        part: the connected part of each vertex.
        start, rows: the edges with an end in block b are rows[start[b] : start[b + 1]].
        links: pairs of blocks that an edge joins.
    """

    ends: Int[np.ndarray, "R 2"]
    block: Int[np.ndarray, "V"]
    count: int
    part: Int[np.ndarray, "V"]
    start: Int[np.ndarray, "B1"]
    rows: Int[np.ndarray, "N"]
    links: Int[np.ndarray, "2 L"]

    def patches(self, cut: Int[np.ndarray, "K"], alone: Int[np.ndarray, "A"]):
        """A number for each vertex, the same for those that edges join which are not cut.

        Args:
            cut: edges that join nothing.
            alone: vertices none of whose edges does; what their numbers are means nothing.
        """
        marked = np.zeros(self.count, bool)
        marked[self.block[self.ends[cut]]] = True
        marked[self.block[alone]] = True
        found = np.flatnonzero(marked)
        if not len(found):
            return self.part
        single = np.flatnonzero(marked[self.block])
        node = self.block.copy()
        node[single] = self.count + np.arange(len(single))
        first = self.start[found]
        rows = self.rows[spread(first, self.start[found + 1] - first)[0]]
        joins = np.ones(len(self.ends), bool)
        joins[cut] = False
        ends = self.ends[rows[joins[rows]]]
        if len(alone):
            stands = np.zeros(len(node), bool)
            stands[alone] = True
            ends = ends[~stands[ends].any(axis=1)]
        whole = self.links[:, ~marked[self.links].any(axis=0)]
        first, second = np.concatenate([node[ends.T], whole], axis=1)
        size = self.count + len(single)
        return _components(first, second, size)[node]


def blocks_of(ends: Int[np.ndarray, "R 2"], count: int) -> Blocks:
    """The blocks of `count` vertices that these edges join."""
    low, high = ends.T
    part = _components(low, high, count)
    _, lead = np.unique(part, return_index=True)
    seeds = np.union1d(np.arange(0, count, _SIZE), lead)
    graph = scipy.sparse.csr_array((np.ones(len(low)), (low, high)), shape=(count, count))
    block = np.zeros(0, np.int64)
    if count:
        # The edges on shortest ways to the nearest seed stay within its block and connect it.
        nearest = scipy.sparse.csgraph.dijkstra(
            graph,
            directed=False,
            indices=seeds,
            unweighted=True,
            min_only=True,
            return_predecessors=True,
        )[2]
        block = np.searchsorted(seeds, nearest)
    of_ends = block[ends]
    across = of_ends[:, 0] != of_ends[:, 1]
    number = np.concatenate([np.arange(len(ends)), np.flatnonzero(across)])
    owner = np.concatenate([of_ends[:, 0], of_ends[across, 1]])
    order = np.argsort(owner, kind="stable")
    size = len(seeds)
    links = unique(np.sort(of_ends[across], axis=1) @ [size, 1])
    return Blocks(
        ends=ends,
        block=block,
        count=size,
        part=part,
        start=np.append(0, np.cumsum(np.bincount(owner, minlength=size))),
        rows=number[order],
        links=np.stack(np.divmod(links, max(size, 1))),
    )


def _components(first, second, count: int) -> Int[np.ndarray, "V"]:
    links = scipy.sparse.coo_array(
        (np.ones(len(first), np.int8), (first, second)), shape=(count, count)
    )
    return scipy.sparse.csgraph.connected_components(links, directed=False)[1].astype(np.int64)
