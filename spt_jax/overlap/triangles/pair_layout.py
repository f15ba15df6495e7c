"""What the search for intersecting triangles keeps about a list of faces from one call to the next.

The topology follows from the faces alone. The layout puts triangles that lie near each other into
slots side by side, eight to a cluster and eight clusters to a group, so that whatever is done with
a cluster is done with one row of an array. It halves the faces along the longest side of the box
around their centers, again and again:

    faces    0 ....................................................... F
             |           whole groups           |  the rest, a group in part
             |        left       |     right    |
             |  64   |  64   |   |  64   |      |                 until groups are left, then
             |8|8|8|8|8|8|8|8|                                    until clusters are left

The left half takes half of the groups (then of the clusters), rounded up, so that only the last one
has empty slots. All ranges of one depth are sorted by one `lexsort`. Triangles 64 times as large as
the usual one, or 512 times, are laid out by themselves: one of them would blow up the box of its
cluster. Centers are taken from all the shapes in which the mesh was seen, because neighbors in one
pose may be strewn over another; `pair_boxes.near_groups` asks for another layout where the last one
suits a shape no more. `tests/helpers_reference.py` has the halving as a recursion.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.triangles.blocks import Blocks, blocks_of
from spt_jax.overlap.triangles.faces_cache import FacesCache
from spt_jax.overlap.triangles.manifold import matched_half_edges
from spt_jax.overlap.triangles.pair_sharing import Sharing, sharing

# Triangles to a cluster, and clusters to a group. On the posed body 4 make 33,000 pairs of clusters
# that meet, 16 make 300,000 pairs of triangles in them to look at; 8 make 16,000 and 210,000.
CLUSTER = 8
_KEPT_SHAPES = 4


@dataclass(frozen=True)
class Topology:
    """What follows from the faces alone.

    Attributes:
        faces: the faces.
        ends: vertices of each edge, the lower first.
        edge_faces: the two triangles of each edge, or -1. An edge of more than two triangles has
            a row here and in `ends` for every two of them.
        halves: the half-edges of each row, or -1; 3 face + k is opposite to corner k.
        row: of each half-edge.
        edge_id: a number for each row, the same for the rows of one edge.
        opposite: for each corner of a face, the row of the edge opposite to it if this face is
            the first of that row, else -1: every row is tested once, from its first face.
        closed: vertices whose triangles surround them: each edge there has two triangles,
            which run along it in opposite senses.
        used: vertices of any triangle.
        blocks: the vertices in connected blocks.
        fan_start, fan: the corners (3 face + corner) at each vertex v are
            fan[fan_start[v] : fan_start[v + 1]].
    """

    faces: Int[np.ndarray, "F 3"]
    ends: Int[np.ndarray, "R 2"]
    edge_faces: Int[np.ndarray, "R 2"]
    halves: Int[np.ndarray, "R 2"]
    row: Int[np.ndarray, "F3"]
    edge_id: Int[np.ndarray, "R"]
    opposite: Int[np.ndarray, "F 3"]
    closed: Bool[np.ndarray, "V"]
    used: Bool[np.ndarray, "V"]
    blocks: Blocks
    fan_start: Int[np.ndarray, "V1"]
    fan: Int[np.ndarray, "F3"]


@dataclass(frozen=True)
class Layout:
    """Triangles in clusters of `CLUSTER` neighbors, and as many clusters to a group.

    A cluster has slots for its triangles, some of which may be empty.

    Attributes:
        face: the face in each slot, 0 in empty ones.
        empty: the empty slots.
        corners: the vertices of the face in each slot, by number.
        corners_32: the same in half the bytes, to compare them faster.
        at_vertices: (V, S), adds up at each vertex what belongs to the triangles around it.
        sense: 1 where that is their order in the face, too, as a cycle; else -1.
        apart: pairs of slots of one cluster, where the faces share no vertex.
        sharing: the same for slots of different clusters, as far as it is kept.
    """

    face: Int[np.ndarray, "S"]
    slot: Int[np.ndarray, "F"]
    empty: Int[np.ndarray, "P"]
    corners: Int[np.ndarray, "3 S"]
    corners_32: Int[np.ndarray, "3 S"]
    at_vertices: "scipy.sparse.csr_array"
    sense: Float[np.ndarray, "S"]
    apart: Int[np.ndarray, "2 N"]
    sharing: Sharing


@dataclass
class Prepared:
    """A mesh's topology, and what suits the shapes in which it has been seen."""

    topology: Topology
    layout: Layout | None = None
    shapes: list[Float[np.ndarray, "F 6"]] = field(default_factory=list)
    usual_pairs: int = 0  # of groups whose boxes meet
    kept: tuple[Any, ...] = ()  # `warm_pairs.Kept`, the last one used first
    waste: int = 0  # how many more shapes were kept than were of use
    at_rest: Any = None  # `folds.AtRest`, of the layout
    collided: int = 0  # shapes in a row in which not all intersections were folds

    def arrange(self, box: Float[np.ndarray, "F 6"]) -> Layout:
        """A new layout, for this shape (each face's lowest and highest corner) and earlier ones."""
        self.shapes = [*self.shapes[1 - _KEPT_SHAPES :], box]
        self.layout = _arrange(self.topology, self.shapes)
        return self.layout


def prepared(faces: Int[np.ndarray, "F 3"], count: int) -> Prepared:
    """What is known about these faces of `count` vertices; the last few are kept."""
    return _meshes.of(faces, count)


def _topology(faces: Int[np.ndarray, "F 3"], count: int) -> Topology:
    tail, head = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    first, second, matched = _rows(faces, low, high)
    order = np.lexsort((first, high[first], low[first]))
    first, second, matched = first[order], second[order], matched[order]
    opposite = np.full(faces.size, -1)
    opposite[first] = np.arange(len(first))
    row = opposite.copy()
    row[second[second >= 0]] = np.flatnonzero(second >= 0)

    used = np.bincount(faces.ravel(), minlength=count) > 0
    closed = used.copy()
    ends = np.stack([low[first], high[first]], axis=1)
    new = np.diff(ends, axis=0).any(axis=1)
    edge_id = np.concatenate([[0], np.cumsum(new)])[: len(first)]
    ragged = ~matched | (np.bincount(edge_id)[edge_id] > 1)
    closed[ends[ragged]] = False
    fan = np.argsort(faces.ravel(), kind="stable")
    return Topology(
        faces=faces,
        ends=ends,
        edge_faces=np.stack([first // 3, np.where(second >= 0, second // 3, -1)], axis=1),
        halves=np.stack([first, second], axis=1),
        row=row,
        edge_id=edge_id,
        opposite=opposite.reshape(faces.shape),
        closed=closed,
        used=used,
        blocks=blocks_of(ends, count),
        fan_start=np.append(0, np.cumsum(np.bincount(faces.ravel(), minlength=count))),
        fan=fan,
    )


_meshes = FacesCache(lambda faces, count: Prepared(_topology(faces, count)))


def _rows(faces, low, high):
    """The half-edges of each row, -1 where it has one only, and whether they run against it."""
    pairs, left = matched_half_edges(faces)
    # Two that run in the same sense are put together, too.
    left = left[np.lexsort((left, high[left], low[left]))]
    new = np.concatenate([[True], (np.diff(low[left]) != 0) | (np.diff(high[left]) != 0)])
    place = np.arange(len(left))
    rank = place - np.maximum.accumulate(np.where(new[: len(left)], place, 0))
    lead = np.flatnonzero(rank % 2 == 0)
    mate = np.minimum(lead + 1, max(len(left) - 1, 0))
    mated = (rank[mate] % 2 == 1) & (lead + 1 < len(left))
    first = np.concatenate([pairs.min(axis=0), left[lead]])
    second = np.concatenate([pairs.max(axis=0), np.where(mated, left[mate], -1)])
    return first, second, np.arange(len(first)) < pairs.shape[1]


def _arrange(topology: Topology, boxes: list[Float[np.ndarray, "F 6"]]) -> Layout:
    """Halve the faces, by their places in all the shapes, until clusters are left."""
    faces = topology.faces
    place = np.concatenate([box[:, :3] + box[:, 3:] for box in boxes], axis=1).T
    size = (boxes[-1][:, 3:] - boxes[-1][:, :3]).max(axis=1)
    usual = np.median(size)
    step = np.log(np.maximum(size, 8 * usual)) if usual > 0 else np.zeros(len(size))
    group = np.floor((step - step.min()) / np.log(8)).astype(np.int64)
    order = np.argsort(group, kind="stable")
    start = np.flatnonzero(np.append(True, np.diff(group[order]) != 0))
    while True:
        size = np.diff(np.append(start, len(faces)))
        if (size <= CLUSTER).all():
            break
        segment = np.repeat(np.arange(len(start)), size)
        at = place[:, order]
        spread = np.maximum.reduceat(at, start, axis=1) - np.minimum.reduceat(at, start, axis=1)
        axis = spread.argmax(axis=0)
        order = order[np.lexsort((at[axis[segment], np.arange(len(order))], segment))]
        unit = np.where(size > CLUSTER**2, CLUSTER**2, CLUSTER)
        left = unit * ((-(-size // unit) + 1) // 2)
        start = np.sort(np.concatenate([start, (start + left)[size > CLUSTER]]))

    # Groups are filled to the last slot, too.
    size_class = group[order[start]]
    fresh = np.append(False, size_class[1:] != size_class[:-1])
    number = np.arange(len(start))
    for k in np.flatnonzero(fresh):
        number[k:] += -number[k] % CLUSTER
    total = CLUSTER * (-(-(number[-1] + 1) // CLUSTER))
    slot = np.empty(len(faces), np.int64)
    within = np.arange(len(faces)) - np.repeat(start, size)
    slot[order] = CLUSTER * np.repeat(number, size) + within
    face = np.full(CLUSTER * total, -1)
    face[slot] = np.arange(len(faces))
    filled = face >= 0
    empty = np.flatnonzero(~filled)
    face[empty] = 0
    given = faces[face].T
    corners = np.sort(given, axis=0)
    turns = np.count_nonzero(given < np.roll(given, -1, axis=0), axis=0)
    by_cluster = corners.reshape(3, -1, CLUSTER)
    first, second = np.triu_indices(CLUSTER, 1)
    apart = np.ones((total, len(first)), bool)
    for i in range(3):
        for j in range(3):
            apart &= by_cluster[i][:, first] != by_cluster[j][:, second]
    cluster, pair = np.nonzero(apart)
    return Layout(
        face=face,
        slot=slot,
        empty=empty,
        corners=corners,
        corners_32=corners.astype(np.int32),
        at_vertices=scipy.sparse.csr_array(
            (np.ones(faces.size), slot[topology.fan // 3], topology.fan_start),
            shape=(len(topology.closed), len(face)),
        ),
        sense=np.where(turns == 2, 1.0, -1.0),
        apart=np.stack([CLUSTER * cluster + first[pair], CLUSTER * cluster + second[pair]]),
        sharing=sharing(corners, filled, CLUSTER),
    )
