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
3. Each part has a root, its vertex farthest along x. No triangle of the part lies beyond, so w is
   0 there, or -1 where the part is inside out, as the edges there show; and every other solid
   in which it lies adds one, as a ray along x shows, which meets only other parts.
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
from spt_jax.overlap.triangles.predicates import Predicates

# Pairs of a ray and a triangle that are worked on together.
_AT_ONCE = 1 << 20
# For so few rays triangles are not sorted.
_FEW_RAYS = 16


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


@dataclass(frozen=True)
class _Root:
    """The end of an edge in each part, where nothing of the part lies beyond along x."""

    part: Int[np.ndarray, "C"]
    row: Int[np.ndarray, "C"]
    end: Int[np.ndarray, "C"]


def enclosing_parts(
    topology: Topology, manifold: Manifold, predicates: Predicates
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"]]:
    """Parts whose vertex farthest along x lies in other parts, and those others."""
    names, extreme = _extremes(topology, manifold, predicates)
    of_face = manifold.part[topology.faces[:, 0]]
    seen, at, sign = _rays(predicates, topology.faces, extreme, names, of_face)
    key, of = np.unique(names[seen] * manifold.num_parts + of_face[at], return_inverse=True)
    within = np.bincount(of, sign, len(key)) != 0
    inner, outer = np.divmod(key[within], manifold.num_parts)
    return inner, outer


def _extremes(topology: Topology, manifold: Manifold, predicates: Predicates):
    """The parts that have triangles, and of each the vertex farthest along x."""
    used = np.flatnonzero(topology.used)
    x = predicates.points[0].take(used)
    if manifold.num_parts == 1 and len(used):
        most = np.flatnonzero(x == x.max())
        if len(most) == 1:
            return np.zeros(1, np.int64), used[most]
    part = manifold.part[used]
    order = np.argsort(part, kind="stable")
    start = np.flatnonzero(np.concatenate([[True], np.diff(part[order]) != 0])[: len(order)])
    names = part[order[start]]
    highest = np.maximum.reduceat(x[order], start) if len(start) else x
    size = np.diff(np.append(start, len(order)))
    most = np.flatnonzero(x[order] == np.repeat(highest, size))
    extreme = used[order[most]]
    if len(extreme) > len(names):
        # Of several that are equally far, the one that is pushed farthest.
        of = np.repeat(np.arange(len(names)), size)[most]
        by_push = np.lexsort((predicates.push[0][extreme], of))
        last = np.flatnonzero(np.concatenate([np.diff(of[by_push]) != 0, [True]]))
        extreme = extreme[by_push[last]]
    return names, extreme


def roots_of(topology: Topology, manifold: Manifold, predicates: Predicates, layers, times):
    """An edge's end in each part that has triangles, and the winding number there."""
    faces = topology.faces
    names, extreme = _extremes(topology, manifold, predicates)
    row, end = _outermost_edges(topology, predicates, extreme)
    one, other = topology.halves[row].T
    across = faces[other // 3, other % 3]
    corners = faces[one // 3]
    # Seen from the edge, the part lies within the wedge of its two triangles: is it solid?
    side, _ = predicates.volume(corners.T, across)
    inverted = side > 0
    root = _Root(names, row, end)
    own = layers(names, names)
    value = np.where(inverted, -times[names], 0)[:, None] * own
    if len(names) > 1:
        seen, at, sign = _rays(predicates, faces, extreme, names, manifold.part[faces[:, 0]])
        other = manifold.part[faces[at, 0]]
        counts = layers(names[seen], other)
        np.add.at(value, seen, (sign * times[other])[:, None] * counts)
    return root, value


def _outermost_edges(topology: Topology, predicates: Predicates, vertex):
    """Of each vertex the edge that turns least from y, seen along z: all others are on one side."""
    first, count = topology.fan_start[vertex], np.diff(topology.fan_start)[vertex]
    corner, of = spread(first, count)
    face, turn = np.divmod(topology.fan[corner], 3)
    half = 3 * face + (turn + 2) % 3  # from the vertex to the next corner
    there = topology.faces[face, (turn + 1) % 3]
    # By the angle from y, to rounding; then the signs decide whether any other turns less.
    seen = predicates.points[:2]
    x, y = seen.take(there, axis=1) - seen.take(vertex[of], axis=1)
    best = np.lexsort((np.arctan2(-x, y), of))[np.cumsum(count) - count]
    for _ in range(int(count.max(initial=0))):
        others = np.flatnonzero(there != there[best[of]])
        own = of[others]
        left = predicates.area(vertex[own], there[best[own]], there[others], (0, 1)) > 0
        if left.all():
            break
        wrong = np.flatnonzero(~left)
        best[own[wrong]] = others[wrong]
    row = topology.row[half[best]]
    return row, (topology.ends[row, 1] == vertex).astype(np.int64)


def _range(places, faces):
    """The least and the greatest of each triangle's corners along an axis."""
    a, b, c = (places.take(corner) for corner in faces.T)
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _rows(point, places, faces):
    """Pairs of ray and triangle that meet in y: every ray against all triangles, in blocks."""
    low, high = _range(places[1], faces)
    found = [np.zeros((2, 0), np.int64)]
    each = max(_AT_ONCE // max(len(faces), 1), 1)
    for begin in range(0, point.shape[1], each):
        y = point[1, begin : begin + each, None]
        ray, face = np.nonzero((low <= y) & (high >= y))
        found.append(np.stack([ray + begin, face]))
    return np.concatenate(found, axis=1)


def _columns(point, places, faces):
    """The same, less most of those that miss in z: a scene of many parts has a ray for each.

    Rays are cut by their order along z into columns, and sorted by their order along y in each. A
    triangle reaches some of the columns, and in each a run of rays.
    """
    count = point.shape[1]
    low, high, rank = [], [], []
    for axis in (1, 2):
        order = np.argsort(point[axis], kind="stable")
        rank.append(np.empty(count, np.int64))
        rank[-1][order] = np.arange(count)
        values = point[axis, order]
        least, most = _range(places[axis], faces)
        low.append(np.searchsorted(values, least, side="left"))
        high.append(np.searchsorted(values, most, side="right"))
    wide = max(int(np.sqrt(count)), 1)
    key = rank[1] // wide * count + rank[0]
    order = np.argsort(key)
    met = np.flatnonzero((low[0] < high[0]) & (low[1] < high[1]))
    first = low[1][met] // wide
    column, of = spread(first, (high[1][met] - 1) // wide - first + 1)
    of = met[of]
    begin = np.searchsorted(key[order], column * count + low[0][of])
    end = np.searchsorted(key[order], column * count + high[0][of])
    at, of_run = spread(begin, end - begin)
    return order[at], of[of_run]


def _rays(predicates: Predicates, faces, vertex, part, part_of_face):
    """Where rays along x from these vertices meet triangles of other parts: ray, triangle, sign.

    The sign is +1 where the ray leaves the triangle's solid: the sum of them is the winding number
    at the vertex.
    """
    # In one place vertices follow their pushes, where that order is known.
    places = vars(predicates).get("ranks", predicates.points)
    point = places.take(vertex, axis=1)
    ray, face = (
        _columns(point, places, faces) if len(vertex) > _FEW_RAYS else _rows(point, places, faces)
    )
    kept = np.flatnonzero(part_of_face[face] != part[ray])
    ray, face = ray[kept], face[kept]
    for axis in (2, 0):
        low, high = _range(places[axis], faces[face])
        beside = high >= point[axis, ray]
        if axis == 2:
            beside &= low <= point[axis, ray]
        kept = np.flatnonzero(beside)
        ray, face = ray[kept], face[kept]
    start, end = faces[face].T.ravel(), faces[face][:, [1, 2, 0]].T.ravel()
    turn = predicates.area(np.tile(vertex[ray], 3), start, end, (1, 2)).reshape(3, -1)
    kept = np.flatnonzero(np.abs(turn.sum(axis=0)) == 3)
    ray, face, turn = ray[kept], face[kept], turn[0, kept]
    side, _ = predicates.volume(faces[face].T, vertex[ray])
    # Counter-clockwise, the triangle faces along the ray: it is ahead of a vertex behind it.
    ahead = np.flatnonzero(side == -turn)
    return ray[ahead], face[ahead], turn[ahead]


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
