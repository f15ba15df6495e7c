"""Which edges of a mesh pass through which of its triangles: every place where it cuts itself.

Triangles that share a vertex are told apart by that vertex: if the triangles around it, seen
along some direction, lie side by side, none of them meets another. That holds nearly everywhere,
and is proved for all vertices at once; only where it is not are these pairs examined. Triangles
that share no vertex are found by boxes: of clusters of neighbours, then of the triangles in them.
What is left is decided by signed volumes.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.rays.pair_layout import CLUSTER, Layout, Prepared, Topology, prepared

# Candidates handled at once: bounds the memory at some tens of megabytes for any mesh.
_CHUNK = 1 << 16
# A coordinate of a box takes 20 bits and a guard bit: three to a word, six tests to two words.
_FIELD = 21
_STEPS = (1 << (_FIELD - 1)) - 1
_GUARDS = sum(1 << (_FIELD * k + _FIELD - 1) for k in range(3))
_Pairs = list[tuple[np.ndarray, np.ndarray]]
_BEFORE = np.triu(np.ones((CLUSTER, CLUSTER), bool), 1)
# Relative to the size of what is multiplied, far above float64's rounding.
_ROUNDING = 1e-14


@dataclass(frozen=True)
class EdgeCrossings:
    """Edges that pass through triangles, sorted by edge and then by triangle.

    Attributes:
        edge: vertices of the edge, the lower first.
        edge_faces: the two triangles of the edge; -1 where it has one only. An edge of more than
            two triangles is listed once for every two of them.
        face: the triangle that the edge passes through.
        point: where it does.
    """

    edge: Int[np.ndarray, "K 2"]
    edge_faces: Int[np.ndarray, "K 2"]
    face: Int[np.ndarray, "K"]
    point: Float[np.ndarray, "K 3"]


def edge_crossings(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    among: Bool[np.ndarray, "F"] | None = None,
) -> EdgeCrossings:
    """Every edge that passes through a triangle with which it shares no vertex.

    Edge pq passes through triangle abc where the tetrahedra pabc and qabc have opposite signed
    volumes and pqab, pqbc and pqca have one sign. A volume of exactly zero counts as positive,
    in an order of the vertices that does not depend on the triangle; so an edge that touches
    the common edge of two triangles of a surface passes through one of them or through neither
    in agreement with its two sides, and triangles without area are passed through by none.

    Args:
        vertices: positions, in any unit.
        faces: indices of each triangle's corners. Any triangles will do: open, closed, several
            to an edge, repeated. What follows from them alone is kept for the next call, for the
            last few meshes; how fast a call is, but not what it returns, depends on the shapes
            in which the mesh has been seen.
        among: faces of interest: only crossings of an edge that belongs to one of them, or that
            pass through one of them, are returned.

    Returns:
        The crossings, sorted; none where any vertex is not finite.

    Raises:
        IndexError: a face does not index into the vertices.

    Example:
        >>> import numpy as np
        >>> from spt_jax.rays.pairs import edge_crossings
        >>> flat = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> upright = [[1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
        >>> found = edge_crossings(np.array(flat + upright), np.array([[0, 1, 2], [3, 4, 5]]))
        >>> print(found.edge.tolist(), found.face, found.point.tolist())
        [[3, 4], [3, 5]] [0 0] [[1.0, 1.0, 0.0], [1.5, 1.0, 0.0]]
    """
    nothing = np.zeros(0, np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        pairs = np.zeros((0, 2), np.int64)
        return EdgeCrossings(pairs, pairs, nothing, np.zeros((0, 3)))
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise IndexError(
            f"faces must index into vertices: got indices {faces.min()} to {faces.max()} for "
            f"{len(vertices)} vertices; indices are 0-based."
        )
    mesh = prepared(faces, len(vertices))
    topology = mesh.topology
    # A power of two, so that nothing is rounded: products of three lengths stay in range.
    _, exponent = np.frexp(np.abs(vertices).max())
    points = np.ldexp(vertices.T.astype(np.float64, order="C"), -int(exponent))
    touching = None if among is None else _touching(topology, among)
    layout, shape, clusters, groups = _near_groups(mesh, points)
    found = list(_around_vertices(points, topology, layout, shape))
    for t, u in _near_pairs(layout, shape, clusters, groups, touching):
        found.append(_edges_of_pairs(topology, layout, shape, t, u))
    row, slot = _concatenate(found) if found else (nothing, nothing)
    row, face, part = _decide(points, topology, layout, row, slot)
    if among is not None:
        kept = _edges_of(topology, among)[topology.edge_id[row]] | among[face]
        row, face, part = row[kept], face[kept], part[kept]
    order = np.lexsort((face, row))
    row, face, part = row[order], face[order], part[order]
    ends = topology.ends[row]
    p, q = np.float64(vertices[ends[:, 0]]), np.float64(vertices[ends[:, 1]])
    return EdgeCrossings(ends, topology.edge_faces[row], face, p + part[:, None] * (q - p))


def face_pairs(crossings: EdgeCrossings) -> Int[np.ndarray, "P 2"]:
    """Unique pairs of triangles (the lower first) that cross along some segment.

    Args:
        crossings: what `edge_crossings` found.

    Returns:
        The triangles of each edge, where it has them, with the triangle that it passes through.

    Example:
        >>> import numpy as np
        >>> from spt_jax.rays.pairs import edge_crossings, face_pairs
        >>> flat = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> upright = [[1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
        >>> found = edge_crossings(np.array(flat + upright), np.array([[0, 1, 2], [3, 4, 5]]))
        >>> print(face_pairs(found))
        [[0 1]]
    """
    of_edge = crossings.edge_faces.ravel()
    through = np.repeat(crossings.face, 2)
    kept = of_edge >= 0
    pair = np.stack([of_edge[kept], through[kept]], axis=1)
    return np.unique(np.sort(pair, axis=1), axis=0)


def _edges_of(topology: Topology, among):
    """Which edges belong to a marked face, by their numbers."""
    first, second = topology.edge_faces.T
    marked = among[first] | ((second >= 0) & among[second])
    return np.bincount(topology.edge_id, marked) > 0


def _touching(topology: Topology, among):
    """The marked faces and those that share an edge with one."""
    marked = _edges_of(topology, among)[topology.edge_id]
    touching = among.copy()
    for side in topology.edge_faces.T:
        touching[side[marked & (side >= 0)]] = True
    return touching


@dataclass(frozen=True)
class _Boxes:
    """Boxes as whole numbers (3, C), and as words."""

    low: Int[np.ndarray, "3 C"]
    high: Int[np.ndarray, "3 C"]
    low_word: Int[np.ndarray, "C"]
    high_word: Int[np.ndarray, "C"]


@dataclass(frozen=True)
class _Shape:
    """The triangles in their slots: corners, area normals, boxes as whole numbers and as words."""

    corner: Float[np.ndarray, "3 3 S"]  # axis, corner, slot
    normal: Float[np.ndarray, "3 S"]
    extent: Float[np.ndarray, "S"]
    low: Int[np.ndarray, "3 S"]
    high: Int[np.ndarray, "3 S"]
    low_word: Int[np.ndarray, "S"]
    high_word: Int[np.ndarray, "S"]


def _face_boxes(points, faces):
    corner = points[:, faces]
    return np.concatenate([corner.min(axis=2), corner.max(axis=2)]).T


def _shape(points, layout: Layout) -> _Shape:
    corner = points.take(layout.corners, axis=1)
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    normal = _cross(b - a, c - a)
    normal *= layout.sense
    normal[:, layout.empty] = 0.0
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    extent = (high - low).sum(axis=0)
    base = low.min(axis=1, keepdims=True)
    span = float((high - base).max())
    scale = _STEPS / span if span > 0 else 0.0
    # Rounding down keeps the order of any two coordinates, so boxes that meet still do.
    low = ((low - base) * scale).astype(np.int64)
    high = ((high - base) * scale).astype(np.int64)
    low[:, layout.empty] = _STEPS
    high[:, layout.empty] = 0
    return _Shape(corner, normal, extent, low, high, _word(low), _word(high) | _GUARDS)


def _word(field):
    return (((field[0] << _FIELD) | field[1]) << _FIELD) | field[2]


def _meet(low, high, other_low, other_high):
    """Whether boxes meet: a guard bit survives where the high end is not below the low one."""
    first = high - other_low
    first &= other_high - low
    first &= _GUARDS
    return first == _GUARDS


def _around_vertices(points, topology: Topology, layout: Layout, shape: _Shape):
    """Candidates (row, slot) whose triangles share the one vertex that is not on the edge."""
    vertex = _uncertain(points, topology, layout, shape)
    corner, at = _spread(topology.fan_start[vertex], np.diff(topology.fan_start)[vertex])
    corner, vertex = topology.fan[corner], vertex[at]
    row = topology.opposite.ravel()[corner]
    kept = np.flatnonzero(row >= 0)
    row, vertex = row[kept], vertex[kept]
    first, count = topology.fan_start[vertex], np.diff(topology.fan_start)[vertex]
    for part in _parts(count):
        other, at = _spread(first[part], count[part])
        edge, face = row[part][at], topology.fan[other] // 3
        kept = np.flatnonzero(_apart(topology, edge, face))
        edge, slot = edge[kept], layout.slot[face[kept]]
        ends = np.stack([points.take(x, axis=1) for x in topology.ends[edge].T], axis=1)
        extent = np.abs(ends[:, 1] - ends[:, 0]).sum(axis=0)
        kept = np.flatnonzero(_straddles(shape, ends, extent, slot))
        yield edge[kept], slot[kept]


def _apart(topology: Topology, row, face):
    ends, corner = topology.ends[row], topology.faces[face]
    return (ends[:, :, None] != corner[:, None, :]).all(axis=(1, 2))


def _uncertain(points, topology: Topology, layout: Layout, shape: _Shape):
    """Vertices around which triangles have not been shown to lie side by side.

    Let the triangles around a vertex all face a direction d with d_k = 0. Seen along d they turn
    around the vertex in one sense, once for every two of them that lie across the plane of
    constant x_k: once in all exactly if the vertex is the median of x_k in two of its triangles.
    Then they do not overlap. Ties of x_k are broken by vertex number, as if moved by nothing.
    """
    count = points.shape[1]
    d = np.stack([layout.at_vertices @ n for n in shape.normal])
    axis = np.abs(d).argmin(axis=0)
    every = np.arange(count)
    d[axis, every] = 0.0
    length = np.abs(d).sum(axis=0)
    d /= np.where(length > 0, length, 1.0)
    at = d.take(layout.corners, axis=1)
    facing = at[0] * shape.normal[0]
    facing += at[1] * shape.normal[1]
    facing += at[2] * shape.normal[2]
    away = facing <= _ROUNDING * shape.extent * shape.extent
    away[:, layout.empty] = False
    medians = np.stack([_medians(x, layout, count) for x in shape.corner])
    sure = topology.closed & (medians[axis, every] == 2)
    sure[layout.corners[away]] = False
    return np.flatnonzero(~sure)


def _medians(x, layout: Layout, count):
    """In how many of its triangles each vertex has the coordinate between the two others."""
    # Corners are sorted by number, so this is what breaks ties.
    first, second, third = x[0] <= x[1], x[1] <= x[2], x[2] < x[0]
    a, b, c = layout.corners
    median = np.where(first == second, b, np.where(second == third, c, a))
    median[layout.empty] = count
    return np.bincount(median, minlength=count + 1)[:-1]


def _near_pairs(layout: Layout, shape: _Shape, clusters: _Boxes, groups: _Pairs, touching):
    """Pairs of slots that share no vertex and whose boxes meet, in parts of bounded size."""
    waiting, size = [], 0
    for t, u in _all_near_pairs(layout, shape, clusters, groups):
        if touching is not None:
            kept = touching[layout.face[t]] | touching[layout.face[u]]
            t, u = t[kept], u[kept]
        waiting.append((t, u))
        size += len(t)
        if size > _CHUNK:
            yield _concatenate(waiting)
            waiting, size = [], 0
    if waiting:
        yield _concatenate(waiting)


def _concatenate(pairs):
    return tuple(np.concatenate(part) for part in zip(*pairs, strict=True))


def _all_near_pairs(layout: Layout, shape: _Shape, clusters: _Boxes, groups: _Pairs):
    for part in _parts(np.ones(layout.apart.shape[1], np.int64)):
        yield _kept_meeting(shape, *layout.apart[:, part])
    for a, b in groups:
        for c, d in _meeting_members(clusters.low_word, clusters.high_word, a, b):
            yield from _meeting_triangles(layout, shape, clusters, c, d)


def _near_groups(mesh: Prepared, points):
    """A layout, the triangles and clusters in it, and the pairs of groups that meet."""
    layout = mesh.layout
    fresh = layout is None
    while True:
        if layout is None:
            layout = mesh.arrange(_face_boxes(points, mesh.topology.faces))
        shape = _shape(points, layout)
        clusters = _joined(shape.low, shape.high)
        groups = _joined(clusters.low, clusters.high)
        # Clusters that were compact once may be strewn all over another shape.
        limit = 2 * mesh.usual_pairs + len(groups.low_word)
        pairs, count = [], 0
        for a, b in _meeting_boxes(groups):
            pairs.append((a, b))
            count += len(a)
            if count > limit and not fresh:
                break
        else:
            if fresh:
                mesh.usual_pairs = count
            return layout, shape, clusters, pairs
        layout, fresh = None, True


def _joined(low, high) -> _Boxes:
    """The boxes around every `CLUSTER` boxes."""
    count = low.shape[1] // CLUSTER
    while low.shape[1] > count:
        low = np.minimum(low[:, ::2], low[:, 1::2])
        high = np.maximum(high[:, ::2], high[:, 1::2])
    return _Boxes(low, high, _word(low), _word(high) | _GUARDS)


def _meeting_boxes(boxes: _Boxes):
    """Pairs of boxes that meet, each with itself too, in parts of bounded size."""
    axis = int(np.argmax(np.ptp(boxes.low, axis=1)))
    order = np.argsort(boxes.low[axis])
    first = boxes.low[axis][order]
    low, high = boxes.low_word[order], boxes.high_word[order]
    here = np.arange(len(order))
    stop = np.searchsorted(first, boxes.high[axis][order], side="right")
    count = np.maximum(stop - here, 1)
    for part in _parts(count):
        b, at = _spread(here[part], count[part])
        a = at + part.start
        kept = np.flatnonzero(_meet(low[a], high[a], low[b], high[b]))
        yield order[a[kept]], order[b[kept]]


def _meeting_members(low, high, a, b):
    """Pairs of the members of a and b that meet, a before b where these are the same."""
    low, high = low.reshape(-1, CLUSTER), high.reshape(-1, CLUSTER)
    for part in _parts(np.full(len(a), CLUSTER * CLUSTER)):
        p, q = a[part], b[part]
        meet = _meet(
            low.take(p, axis=0)[:, :, None],
            high.take(p, axis=0)[:, :, None],
            low.take(q, axis=0)[:, None, :],
            high.take(q, axis=0)[:, None, :],
        )
        meet[p == q] &= _BEFORE
        found = np.flatnonzero(meet)
        pair = found // CLUSTER**2
        p, q = CLUSTER * p[pair], CLUSTER * q[pair]
        yield p + found // CLUSTER % CLUSTER, q + found % CLUSTER


def _meeting_triangles(layout: Layout, shape: _Shape, boxes: _Boxes, a, b):
    """Pairs of slots that share no vertex and whose boxes meet, of pairs of clusters that do."""
    for part in _parts(np.full(len(a), 3 * CLUSTER)):
        pair_t, t = _reaching(shape, boxes, a[part], b[part])
        pair_u, u = _reaching(shape, boxes, b[part], a[part])
        count = np.bincount(pair_u, minlength=len(a[part]))
        first = (np.cumsum(count) - count)[pair_t]
        count = count[pair_t]
        low_t, high_t = shape.low_word[t], shape.high_word[t]
        low_u, high_u = shape.low_word[u], shape.high_word[u]
        for piece in _parts(count):
            second, at = _spread(first[piece], count[piece])
            at += piece.start
            kept = np.flatnonzero(_meet(low_t[at], high_t[at], low_u[second], high_u[second]))
            yield _sharing_none(layout, t[at[kept]], u[second[kept]])


def _sharing_none(layout: Layout, t, u):
    p, q = layout.corners_32.take(t, axis=1), layout.corners_32.take(u, axis=1)
    shared = p[0] == q[0]
    for i, j in ((0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)):
        shared |= p[i] == q[j]
    kept = np.flatnonzero(~shared)
    return t[kept], u[kept]


def _kept_meeting(shape: _Shape, t, u):
    low, high = shape.low_word, shape.high_word
    kept = np.flatnonzero(_meet(low[t], high[t], low[u], high[u]))
    return t[kept], u[kept]


def _reaching(shape: _Shape, boxes: _Boxes, a, b):
    """The triangles of cluster a whose boxes meet the box of b: number of the pair, and slot."""
    # Whole rows by take, never by index: five times as fast.
    low = shape.low_word.reshape(-1, CLUSTER).take(a, axis=0)
    high = shape.high_word.reshape(-1, CLUSTER).take(a, axis=0)
    found = np.flatnonzero(
        _meet(low, high, boxes.low_word[b][:, None], boxes.high_word[b][:, None])
    )
    pair = found // CLUSTER
    return pair, found + CLUSTER * (a[pair] - pair)


def _edges_of_pairs(topology: Topology, layout: Layout, shape: _Shape, t, u):
    """Candidates (row, slot) of pairs of triangles that neither's plane keeps apart."""
    for turn in (0, 1):
        x, y = (t, u) if turn else (u, t)
        kept = np.flatnonzero(_straddles(shape, shape.corner.take(x, axis=2), shape.extent[x], y))
        t, u = t[kept], u[kept]
    row = topology.opposite.take(layout.face[np.concatenate([t, u])], axis=0).ravel()
    slot = np.repeat(np.concatenate([u, t]), 3)
    kept = np.flatnonzero(row >= 0)
    return row[kept], slot[kept]


def _straddles(shape: _Shape, points, extent, slot):
    """Whether points (3, N, M) lie on both sides of the planes of M triangles, or may."""
    normal, corner = shape.normal.take(slot, axis=1), shape.corner[:, 0].take(slot, axis=1)
    height = normal[0] * (points[0] - corner[0])
    height += normal[1] * (points[1] - corner[1])
    height += normal[2] * (points[2] - corner[2])
    own = shape.extent[slot]
    margin = _ROUNDING * own * own * (own + extent)
    return (height.min(axis=0) <= margin) & (height.max(axis=0) >= -margin)


def _decide(points, topology: Topology, layout: Layout, row, slot):
    """The candidates that cross, and what part of the edge lies before the crossing.

    Every sign is computed from the same numbers in the same order for all who ask for it: on
    which side of a triangle a vertex lies, and on which side of each other two edges pass. So an
    edge that leaves one triangle for the next across their common edge passes through exactly
    one of them, whatever the rounding; touching counts as lying on the positive side.
    """
    corner = layout.corners.take(slot, axis=1)
    ends = topology.ends.take(row, axis=0).T
    a, b, c = (points.take(x, axis=1) for x in corner)
    p, q = (points.take(x, axis=1) for x in ends)
    normal = _cross(b - a, c - a)
    of_p, of_q = _dot(normal, p - a), _dot(normal, q - a)
    kept = np.flatnonzero((of_p >= 0) != (of_q >= 0))
    row, slot, of_p, of_q = row[kept], slot[kept], of_p[kept], of_q[kept]
    a, b, c, p, q = (x.take(kept, axis=1) for x in (a, b, c, p, q))
    along, to_a, to_b, to_c = q - p, a - p, b - p, c - p
    of_a, of_b = _cross(along, to_a), _cross(along, to_b)
    first, second, third = _dot(of_a, to_b) >= 0, _dot(of_b, to_c) >= 0, _dot(of_a, to_c) >= 0
    kept = np.flatnonzero((first == second) & (first != third))
    of_p, of_q = of_p[kept], of_q[kept]
    return row[kept], layout.face[slot[kept]], of_p / (of_p - of_q)


def _cross(x, y):
    out = np.empty_like(x)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k] = x[i] * y[j]
        out[k] -= x[j] * y[i]
    return out


def _dot(x, y):
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _spread(first, count):
    """first[i], first[i] + 1, ... (count[i] of them) for each i in turn; and the i of each."""
    at = np.repeat(np.arange(len(count)), count)
    return np.arange(len(at)) + (first - np.cumsum(count) + count)[at], at


def _parts(count) -> Iterator[slice]:
    """Slices of the items, such that each slice's counts add up to about `_CHUNK` at most."""
    total = np.cumsum(count)
    begin, done = 0, 0
    while begin < len(total):
        end = max(begin + 1, int(np.searchsorted(total, done + _CHUNK, side="right")))
        yield slice(begin, end)
        begin, done = end, int(total[end - 1])
