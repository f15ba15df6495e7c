"""Which triangles of clusters that lie side by side share a vertex.

Nearly all triangles whose boxes meet are neighbors on the surface. Which of them share a vertex
follows from the faces alone, so the broad phase masks them before it lists what meets, instead of
comparing the vertices of a hundred thousand pairs at every call.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.ranges import unique

# A vertex of more clusters than this, the center of a large fan, is left to the comparison of
# vertices: its pairs of clusters would grow with the square of its triangles.
_MOST_CLUSTERS = 16
_PAIRS_AT_ONCE = 1 << 14


@dataclass(frozen=True)
class Sharing:
    """Pairs of triangles that may be of interest: those that are not known to share a vertex.

    Attributes:
        groups: how many groups of clusters there are.
        key: of the pairs of groups that have such clusters, first * groups + second, ascending;
            the first is the lower one, or both are the same.
        row: for each of these and last for all other pairs of groups, by the places of two clusters
            in them, a row of `apart`.
        apart: for a pair of clusters, by the places of two triangles in them, whether the two are
            not known to share a vertex. In the last row, for all other pairs, none is.
        whole: whether all that share one are known.
    """

    groups: int
    key: Int[np.ndarray, "G"]
    row: Int[np.ndarray, "G1 CC"]
    apart: Bool[np.ndarray, "R1 C C"]
    whole: bool

    def rows_of(self, first: Int[np.ndarray, "N"], second: Int[np.ndarray, "N"]):
        """The rows of `row` for pairs of groups, the first of which is the lower one."""
        wanted = first * self.groups + second
        at = np.searchsorted(self.key, wanted)
        known = np.flatnonzero(at < len(self.key))
        known = known[self.key[at[known]] == wanted[known]]
        found = np.full(len(wanted), len(self.key))
        found[known] = at[known]
        return found


def sharing(corners: Int[np.ndarray, "3 S"], filled: Bool[np.ndarray, "S"], size: int) -> Sharing:
    """What is known of triangles in slots, `size` to a cluster and as many clusters to a group.

    Args:
        corners: the vertices of each slot's triangle.
        filled: whether the slot has one.
        size: slots to a cluster.
    """
    clusters, groups = corners.shape[1] // size, corners.shape[1] // size**2
    slot = np.flatnonzero(filled)
    vertex, cluster = np.divmod(
        unique((corners[:, slot] * clusters + slot // size).ravel()), max(clusters, 1)
    )
    # Each cluster at a vertex with those that come after it there.
    new = np.flatnonzero(np.concatenate([[True], np.diff(vertex) != 0])[: len(vertex)])
    count = np.diff(np.append(new, len(vertex)))
    stop = np.repeat(new + count, count)
    few = np.repeat(count <= _MOST_CLUSTERS, count)
    here = np.arange(len(vertex))
    pairs = [
        cluster[kept] * clusters + cluster[kept + step]
        for step in range(1, min(int(count.max(initial=0)), _MOST_CLUSTERS))
        for kept in [np.flatnonzero(few & (here + step < stop))]
    ]
    found = unique(np.concatenate([np.zeros(0, np.int64), *pairs]))
    first, second = np.divmod(found, max(clusters, 1))
    apart = np.ones((len(found) + 1, size, size), bool)
    by_cluster = corners.reshape(3, -1, size)
    for begin in range(0, len(found), _PAIRS_AT_ONCE):
        part = slice(begin, min(begin + _PAIRS_AT_ONCE, len(found)))
        for i in range(3):
            for j in range(3):
                own, other = by_cluster[i][first[part]], by_cluster[j][second[part]]
                apart[part] &= own[:, :, None] != other[:, None, :]
    of_groups = first // size * groups + second // size
    key, at = np.unique(of_groups, return_inverse=True)
    row = np.full((len(key) + 1, size * size), len(found), np.int32)
    row[at, first % size * size + second % size] = np.arange(len(found))
    return Sharing(groups, key, row, apart, bool(few.all()))
