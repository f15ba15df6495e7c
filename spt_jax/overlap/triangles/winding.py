r"""The winding number just outside the surface, everywhere along it, from one place of each part.

The winding number w of a place is how many solids it lies in, one that is inside out taking one
away. Walk along the surface just outside it: w changes only where the surface passes through
itself. An edge that enters another solid gains one, an edge that leaves it loses one.

        0   +-----------+
            | A         |  0        Down the right side of A, w is 0 as far as the x, where the
            |      +----x------+    edge enters B, and 1 below it. Then left along the lower side,
            |      | 1  | 1    |    w is 1 as far as the other x, where the edge leaves B, and 0
            +------x----+      |    beyond it. B is decided by the same two places.
                   |         B |
                   +-----------+

So all is known once w is known at one vertex of each connected part:

1. Edges through which nothing passes join vertices to patches of one w (`Blocks.patches`).
2. Every other edge links the patches of its ends; its step is the sum of its jumps.
3. Each part has a root, its vertex farthest along x, where w is known (`part_roots.py`).
4. From the roots w spreads along the links. A link that joins two known patches is a check: the
   steps around every loop must cancel (`Ends.fits`).

Every sign is exact, and of one surface in general position, so they do cancel, unless the surface
is not closed.

At a cusp, a vertex two of whose own triangles intersect, w differs from edge to edge. The triangles
around it, cut by a small sphere, make a closed curve that crosses itself:

          _____
         /     \      Going round the vertex from corner to corner, w steps where the segment of
         \      \     two such triangles starts within a corner. So each edge has a node of its
      ____\__    |    own there, and corners are links as well.
     /     \ \__/
     \______\         (`_around_cusps`)

Pairs of parts may be excluded: an edge of a part that enters another one makes no
step where the pair is excluded, and the ray does not see such a part. Several choices, called
layers, are worked out together. `tests/helpers_reference.py` has all of this in forty slow lines.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.ranges import spread
from spt_jax.overlap.triangles.contacts import Contacts
from spt_jax.overlap.triangles.contours import Contours
from spt_jax.overlap.triangles.manifold import Manifold
from spt_jax.overlap.triangles.pair_layout import Topology
from spt_jax.overlap.triangles.pairs import EdgeIntersections
from spt_jax.overlap.triangles.part_roots import roots_of
from spt_jax.overlap.triangles.predicates import Predicates


@dataclass(frozen=True)
class Ends:
    """The winding number at edges' ends, on any number of layers.

    Around most vertices it is the same on all edges. At a cusp, a vertex two of whose triangles
    pass through each other, each edge has its own.

    Attributes:
        node: of each vertex; at a cusp that of one of its edges.
        cusp: marks cusps.
        at_cusp: for each row and end (2 row + end) at a cusp its node; -1 elsewhere.
        winding: (N, L), of each node.
        fits: whether no two ways along the surface contradict each other.
    """

    node: Int[np.ndarray, "V"]
    cusp: Bool[np.ndarray, "V"]
    at_cusp: Int[np.ndarray, "R2"]
    winding: Int[np.ndarray, "N L"]
    fits: bool

    def of_vertices(self) -> Int[np.ndarray, "V L"]:
        """At each vertex; at a cusp, on one of its edges."""
        return self.winding.take(self.node, axis=0)

    def of_ends(
        self, topology: Topology, row: Int[np.ndarray, "M"], end: Int[np.ndarray, "M"]
    ) -> Int[np.ndarray, "M L"]:
        """At ends of edges: 0 for the lower vertex, 1 for the higher."""
        node = self.at_cusp[2 * row + end]
        node = np.where(node >= 0, node, self.node[topology.ends[row, end]])
        return self.winding.take(node, axis=0)


def winding_numbers(
    topology: Topology,
    manifold: Manifold,
    predicates: Predicates,
    intersections: EdgeIntersections,
    contours: Contours,
    counts: Bool[np.ndarray, "K L"],
    layers,
    times: Int[np.ndarray, "P"] | None = None,
) -> Ends:
    """The winding number just outside the surface at all edges' ends.

    Args:
        topology: of the mesh.
        manifold: its parts.
        predicates: the signs.
        intersections: every edge that passes through a triangle.
        contours: of these.
        counts: which intersections count, on each layer.
        layers: function of two arrays of parts: whether the second counts for the first, (M, L).
        times: how often each part is there, all copies in one place; once if not given.

    Returns:
        The numbers just outside of all copies.
    """
    if times is None:
        times = np.ones(manifold.num_parts, np.int64)
    of_face = times[manifold.part[topology.faces[:, 0]]]
    jumps = intersections.jump * of_face[intersections.face]
    cusp = np.zeros(len(topology.used), bool)
    cusp[contours.cusp[contours.cusp >= 0]] = True
    cut, of = np.unique(intersections.row, return_inverse=True)
    jump = np.stack(
        [np.bincount(of, jumps * on, len(cut)).astype(np.int64) for on in np.asarray(counts).T],
        axis=1,
    )
    alone = np.flatnonzero(cusp)
    patch = topology.blocks.patches(cut, alone)

    # The nodes: patches, and the ends of edges at cusps.
    node, at_cusp = patch.copy(), np.full(2 * len(topology.ends), -1)
    size = int(patch.max(initial=-1)) + 1
    links, steps = [], []
    rows = cut
    if len(alone):
        corner, at = spread(topology.fan_start[alone], np.diff(topology.fan_start)[alone])
        corner, vertex = topology.fan[corner], alone[at]
        face, turn = np.divmod(corner, 3)
        starting, ending = (topology.row[3 * face + (turn + k) % 3] for k in (2, 1))
        sides = np.stack([starting, ending])
        which = (topology.ends[sides, 1] == vertex).astype(np.int64)
        names, number = np.unique(2 * sides + which, return_inverse=True)
        at_cusp[names] = size + np.arange(len(names))
        number = number.reshape(2, -1)
        node[vertex] = size + number[0]
        links.append(size + number)
        steps.append(_around_cusps(topology, contours, counts, of_face, corner))
        rows = np.union1d(cut, names // 2)
        size += len(names)
    total = np.zeros((len(rows), jump.shape[1]), np.int64)
    total[np.searchsorted(rows, cut)] = jump
    ends = np.stack(
        [
            np.where(there >= 0, there, node[topology.ends[rows, end]])
            for end in (0, 1)
            for there in [at_cusp[2 * rows + end]]
        ]
    )
    links.append(ends)
    steps.append(total)
    first, second = np.concatenate(links, axis=1)
    step = np.concatenate(steps)

    root, value = roots_of(topology, manifold, predicates, layers, times)
    where = at_cusp[2 * root.row + root.end]
    where = np.where(where >= 0, where, node[topology.ends[root.row, root.end]])
    winding = _spread_from(where, value, first, second, step, size)
    fits = bool((winding[first] + step == winding[second]).all())
    return Ends(node, cusp, at_cusp, winding, fits)


def _around_cusps(topology, contours: Contours, counts, times, corner):
    """By how much the number rises within each corner, from the side that starts there."""
    at = np.flatnonzero(contours.cusp >= 0)
    total = np.zeros((topology.faces.size, counts.shape[1]), np.int64)
    passing = contours.end[at].max(axis=1)
    on = counts[passing]
    for k, sign in ((0, 1), (1, -1)):
        face = contours.pair[at, k]
        turn = np.argmax(topology.faces[face] == contours.cusp[at, None], axis=1)
        # On the first triangle the left of the segment has one more, on the second one less; and
        # the segment may end in the corner instead of starting there.
        outwards = np.where(contours.end[at, 0] < 0, 1, -1)
        rise = sign * outwards * times[contours.pair[at, 1 - k]]
        np.add.at(total, 3 * face + turn, rise[:, None] * on)
    return total[corner]


def _spread_from(root, value, first, second, step, size: int):
    """The number at every node, from those at some and the steps along links."""
    winding = np.zeros((size, value.shape[1]), np.int64)
    known = np.zeros(size, bool)
    winding[root], known[root] = value, True
    while True:
        before = np.count_nonzero(known)
        for a, b, sign in ((first, second, 1), (second, first, -1)):
            onward = np.flatnonzero(known[a] & ~known[b])
            winding[b[onward]] = winding[a[onward]] + sign * step[onward]
            known[b[onward]] = True
        if np.count_nonzero(known) == before:
            return winding


def labels_of(
    topology: Topology,
    ends: Ends,
    layer: int,
    contacts: Contacts,
    side: Int[np.ndarray, "T"],
    counts: Bool[np.ndarray, "T"],
    part: Int[np.ndarray, "V"],
) -> Int[np.ndarray, "V"]:
    """The winding number just outside the surface around each vertex, one for each.

    Contact is no overlap: a vertex that lies on another sheet of the surface is on either side of
    it, whichever brings the number nearer to zero. At a cusp the number on most edges is taken.

    Args:
        contacts: vertices that lie on triangles.
        side: +1 where the vertex counts as in front of the triangle, -1 where as behind it.
        counts: which of these contacts count on the layer.
        part: of each vertex.
    """
    winding = ends.of_vertices()[:, layer].copy()
    vertex = np.flatnonzero(ends.cusp)
    if len(vertex):
        corner, at = spread(topology.fan_start[vertex], np.diff(topology.fan_start)[vertex])
        face, turn = np.divmod(topology.fan[corner], 3)
        row = topology.row[3 * face + (turn + 2) % 3]
        end = (topology.ends[row, 1] == vertex[at]).astype(np.int64)
        value = ends.of_ends(topology, row, end)[:, layer]
        # The number on most of its edges, and of equally many the one nearest to zero.
        names, often = np.unique(np.stack([at, value]), axis=1, return_counts=True)
        order = np.lexsort((np.abs(names[1]), -often, names[0]))
        first = np.flatnonzero(np.concatenate([[True], np.diff(names[0, order]) != 0]))
        winding[vertex[names[0, order[first]]]] = names[1, order[first]]
    if counts.any():
        touching = contacts.only(counts)
        side = side[counts]
        # One sheet for each part that is touched, however many of its triangles meet there.
        other = part[topology.faces[touching.face, 0]]
        key, of = np.unique(
            touching.vertex * (int(part.max(initial=0)) + 1) + other, return_inverse=True
        )
        side = np.sign(np.bincount(of, side))
        vertex = key // (int(part.max(initial=0)) + 1)
        inside, outside = (
            np.bincount(vertex[side * sign > 0], minlength=len(winding)) for sign in (-1, 1)
        )
        winding = np.clip(0, winding - inside, winding + outside)
    return winding
