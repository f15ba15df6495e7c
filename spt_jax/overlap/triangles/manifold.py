"""A surface as the exact method wants it: closed, and with one sheet at every vertex.

Winding numbers depend on where the triangles are and not on how their corners are named. So any
list of triangles is rewritten, without moving one: edges of more than two triangles are shared by
two at a time, vertices at which several sheets meet become one vertex each, and what is missing
along boundary loops is filled by fans. Two sheets that still have both ends of an edge in common
might pass through each other along it, where no crossing shows: each is given a middle of its own
there. Triangles that list a vertex twice have no area and go.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import summed
from spt_jax.overlap.triangles.faces_cache import FacesCache


@dataclass(frozen=True, eq=False)
class Manifold:
    """The rewritten faces, and where their vertices come from.

    Attributes:
        given: the faces that were rewritten.
        faces: of the new vertices; first those that were given, in their order, then the fans.
        kept: for each of these the number of the face given; -1 in fans.
        beside: the same, but for a fan's triangle the face at the edge that it closes.
        origin: the given vertex at which each new one is; after those come centers.
        loops: of each center the given vertices of which it is the mean: those along a boundary
            loop, which a fan closes, or the two ends of an edge.
        num_fans: how many boundary loops were closed.
        part: the number of each new vertex's connected part.
        num_parts: how many parts there are.
        is_given: whether nothing had to be rewritten.
    """

    given: Int[np.ndarray, "F 3"]
    faces: Int[np.ndarray, "G 3"]
    kept: Int[np.ndarray, "G"]
    beside: Int[np.ndarray, "G"]
    origin: Int[np.ndarray, "W"]
    loops: tuple[Int[np.ndarray, "_"], ...]
    num_fans: int
    part: Int[np.ndarray, "X"]
    num_parts: int
    is_given: bool

    @cached_property
    def _by_part(self) -> tuple[Int[np.ndarray, "X"], Int[np.ndarray, "P1"]]:
        """The vertices part by part, and where each part begins."""
        order = np.argsort(self.part, kind="stable")
        return order, np.append(0, np.cumsum(np.bincount(self.part, minlength=self.num_parts)))

    @cached_property
    def _faces_by_part(self) -> tuple[Int[np.ndarray, "G"], Int[np.ndarray, "P1"]]:
        part = self.part[self.faces[:, 0]]
        order = np.argsort(part, kind="stable")
        return order, np.append(0, np.cumsum(np.bincount(part, minlength=self.num_parts)))

    def copies(
        self, placed: Float[np.ndarray, "X 3"]
    ) -> tuple[Int[np.ndarray, "P"], Int[np.ndarray, "P"]]:
        """For each part the first one that lies where it does, vertex on vertex.

        Returns:
            The parts, and -1 for those that are the other one turned inside out, else 1.
        """
        first, sense = np.arange(self.num_parts), np.ones(self.num_parts, np.int64)
        (vertex, begin), (face, start) = self._by_part, self._faces_by_part
        size = np.stack([np.diff(begin), np.diff(start)], axis=1)
        solid = np.flatnonzero(size[:, 1])
        key = np.concatenate([placed[vertex[begin[solid]]], size[solid]], axis=1)
        order = np.lexsort(key.T)
        alike = (key[order[1:]] == key[order[:-1]]).all(axis=1)
        if not alike.any():
            return first, sense
        run = np.concatenate([[0], np.cumsum(~alike)])
        for group in np.split(solid[order], np.flatnonzero(np.diff(run)) + 1):
            leaders: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
            for part in np.sort(group).tolist() if len(group) > 1 else ():
                own = vertex[begin[part] : begin[part + 1]]
                corners = np.searchsorted(own, self.faces[face[start[part] : start[part + 1]]])
                faces, places = _in_order(corners), placed[own]
                for leader, known, turned, there in leaders:
                    same, inside_out = (np.array_equal(faces, x) for x in (known, turned))
                    if (same or inside_out) and np.array_equal(places, there):
                        first[part], sense[part] = leader, 1 if same else -1
                        break
                else:
                    leaders.append((part, faces, _in_order(corners[:, ::-1]), places))
        return first, sense

    def without(
        self, first: Int[np.ndarray, "P"]
    ) -> tuple["Manifold", Int[np.ndarray, "C"], Int[np.ndarray, "C"]]:
        """The surface without copies, the copies' vertices, and what each is a copy of."""
        kept = np.flatnonzero(first[self.part[self.faces[:, 0]]] == self.part[self.faces[:, 0]])
        vertex, begin = self._by_part
        ranges = [(vertex[begin[p] : begin[p + 1]]) for p in range(self.num_parts)]
        copied = np.flatnonzero(first != np.arange(len(first)))
        copies = np.concatenate([ranges[p] for p in copied])
        originals = np.concatenate([ranges[first[p]] for p in copied])
        fewer = replace(
            self, faces=self.faces[kept], kept=self.kept[kept], beside=self.beside[kept]
        )
        return fewer, copies, originals

    def place(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "X 3"]:
        """The new vertices' positions."""
        if self.is_given:
            return vertices
        centers = [vertices[loop].mean(axis=0) for loop in self.loops]
        return np.concatenate([vertices[self.origin], *(c[None] for c in centers)])

    def gather(self, forces: Float[np.ndarray, "X 3"], count: int) -> Float[np.ndarray, "V 3"]:
        """What forces on the new vertices are on those given, of which there are `count`."""
        if self.is_given:
            return forces
        at, rows = [self.origin], [forces[: len(self.origin)]]
        for loop, force in zip(self.loops, forces[len(self.origin) :], strict=True):
            at.append(loop)
            rows.append(np.repeat(force[None] / len(loop), len(loop), axis=0))
        return summed(np.concatenate(at), np.concatenate(rows), count)


def _in_order(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F 3"]:
    """The same faces, each from its lowest corner on, sorted."""
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    return faces[np.lexsort(faces.T[::-1])]


def manifold_of(faces: Int[np.ndarray, "F 3"], count: int) -> Manifold:
    """The faces of `count` vertices rewritten; the last few are kept."""
    return _manifolds.of(faces, count)


def matched_half_edges(
    faces: Int[np.ndarray, "F 3"],
) -> tuple[Int[np.ndarray, "2 M"], Int[np.ndarray, "U"]]:
    """Half-edges that run along one edge in opposite senses, two by two, and those left over.

    Half-edge 3 face + k is opposite to corner k. Of an edge with more than two triangles the first
    in either sense belong together, then the second, and so on.
    """
    tail, head = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    backward = tail > head
    order = np.lexsort((backward, high, low))
    new = (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)
    edge = np.concatenate([[0], np.cumsum(new)])[: len(order)]
    sense = 2 * edge + backward[order]
    place = np.arange(len(order))
    first = np.concatenate([[True], np.diff(sense) != 0])[: len(order)]
    rank = place - np.maximum.accumulate(np.where(first, place, 0))
    forward = np.bincount(edge[~backward[order]], minlength=int(edge.max(initial=-1)) + 1)
    # The partner of the k-th forward one stands as far behind as there are forward ones.
    partner = np.where(backward[order], -1, place + forward[edge])
    there = np.minimum(np.maximum(partner, 0), max(len(order) - 1, 0))
    found = np.flatnonzero(
        (partner >= 0)
        & (partner < len(order))
        & (sense[there] == sense + 1)
        & (rank[there] == rank)
    )
    pairs = np.stack([order[found], order[partner[found]]])
    left = np.ones(len(order), bool)
    left[pairs] = False
    return pairs, np.flatnonzero(left)


def _rewritten(given, count: int) -> Manifold:
    twice = (given == np.roll(given, 1, axis=1)).any(axis=1)
    kept = np.flatnonzero(~twice)
    faces = given[kept]
    pairs, left = matched_half_edges(faces)
    loops: list[np.ndarray] = []
    beside = kept
    if len(left):
        loops = _loops(faces, left)
        at, turn = np.divmod(left, 3)
        ends = np.stack([faces[at, (turn + 1) % 3], faces[at, (turn + 2) % 3]], axis=1)
        by_edge = dict(zip(map(tuple, ends.tolist()), kept[at], strict=True))
        fans = [
            # A boundary half-edge from a to b wants a triangle that runs from b to a.
            np.stack([np.roll(loop, -1), loop, np.full(len(loop), count + k)], axis=1)
            for k, loop in enumerate(loops)
        ]
        faces = np.concatenate([faces, *fans])
        closing = np.concatenate(fans)[:, 1::-1].tolist()
        beside = np.concatenate([kept, [by_edge[a, b] for a, b in closing]])
        kept = np.concatenate([kept, np.full(len(faces) - len(kept), -1)])
        pairs, left = matched_half_edges(faces)
    total = count + len(loops)
    num_fans = len(loops)
    vertex, origin = _one_sheet_each(faces, pairs, total)
    while True:
        split = _with_middles(vertex, origin, loops, count)
        if split is None:
            break
        vertex, origin, source = split
        kept, beside = kept[source], beside[source]
    is_given = len(vertex) == len(given) and len(origin) == count and not loops
    part, num_parts = _parts(vertex, len(origin))
    # Centers come last, and have one sheet each.
    order = np.argsort(origin >= count, kind="stable")
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    origin = origin[order]
    return Manifold(
        given=given,
        faces=given if is_given else number[vertex],
        kept=kept,
        beside=beside,
        origin=origin[origin < count],
        loops=tuple(loops[k - count] for k in origin[origin >= count]),
        num_fans=num_fans,
        part=part[order],
        num_parts=num_parts,
        is_given=is_given,
    )


_manifolds = FacesCache(_rewritten)


def _with_middles(vertex, origin, loops: list[np.ndarray], count: int):
    """The faces with one triangle each cut at an edge that several sheets share by both ends.

    Returns:
        None where there is no such edge; else the faces, the origin of all vertices and which of
        the last faces each was a part of. The edge's ends are added to `loops`.
    """
    pairs, _ = matched_half_edges(vertex)
    face, turn = np.divmod(pairs, 3)
    ends = np.sort(np.stack([vertex[face[0], (turn[0] + k) % 3] for k in (1, 2)], axis=1), axis=1)
    _, at, often = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(often[at.ravel()] > 1)
    if not len(shared):
        return None
    faces, source = vertex.tolist(), list(range(len(vertex)))
    origin, cut = origin.tolist(), set()
    for row in shared.tolist():
        if not cut.isdisjoint(face[:, row].tolist()):
            continue
        cut.update(face[:, row].tolist())
        middle = len(origin)
        origin.append(count + len(loops))
        loops.append(np.array([origin[end] for end in ends[row].tolist()]))
        for f, k in zip(face[:, row].tolist(), turn[:, row].tolist(), strict=True):
            corner = vertex[f].tolist()
            faces[f] = [corner[k], corner[(k + 1) % 3], middle]
            faces.append([corner[k], middle, corner[(k + 2) % 3]])
            source.append(f)
    return np.array(faces), np.array(origin), np.array(source)


def _loops(faces, left) -> list[np.ndarray]:
    """The half-edges that have no partner, end to end: each loop's vertices."""
    face, corner = np.divmod(left, 3)
    tail, head = faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
    onward: dict[int, list[int]] = {}
    for a, b in zip(tail.tolist()[::-1], head.tolist()[::-1], strict=True):
        onward.setdefault(a, []).append(b)
    loops = []
    for start in tail.tolist():
        while onward.get(start):
            # As many half-edges lead to a vertex as away from it, so a walk ends where it began.
            # Where it comes by a vertex again, what lies between is a loop of its own.
            walk, place = [start], {start: 0}
            while onward.get(walk[-1]):
                there = onward[walk[-1]].pop()
                if there in place:
                    since = place[there]
                    loops.append(np.array(walk[since:]))
                    for vertex in walk[since + 1 :]:
                        del place[vertex]
                    walk = walk[: since + 1]
                else:
                    place[there] = len(walk)
                    walk.append(there)
    return loops


def _one_sheet_each(faces, pairs, count: int):
    """Corners by new vertices, one for each sheet at a vertex, and the old vertex of each."""
    (a, k), (b, m) = np.divmod(pairs[0], 3), np.divmod(pairs[1], 3)
    # The partner runs the other way.
    links = [np.stack([3 * a + (k + turn) % 3, 3 * b + (m + 3 - turn) % 3]) for turn in (1, 2)]
    first, second = np.concatenate(links, axis=1)
    graph = scipy.sparse.coo_array(
        (np.ones(len(first), np.int8), (first, second)), shape=(faces.size, faces.size)
    )
    sheets, sheet = scipy.sparse.csgraph.connected_components(graph, directed=False)
    vertex = np.empty(sheets, np.int64)
    vertex[sheet] = faces.ravel()
    # The first sheet at a vertex keeps its number; vertices without a triangle keep theirs.
    order = np.argsort(vertex, kind="stable")
    fresh = np.concatenate([[True], np.diff(vertex[order]) != 0])[: len(order)]
    number = np.empty(sheets, np.int64)
    number[order[fresh]] = vertex[order[fresh]]
    number[order[~fresh]] = count + np.arange(np.count_nonzero(~fresh))
    origin = np.concatenate([np.arange(count), vertex[order[~fresh]]])
    return number[sheet].reshape(faces.shape), origin


def _parts(faces, count: int) -> tuple[Int[np.ndarray, "V"], int]:
    links = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = scipy.sparse.coo_array((np.ones(len(links), np.int8), tuple(links.T)), (count, count))
    num_parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return part, int(num_parts)
