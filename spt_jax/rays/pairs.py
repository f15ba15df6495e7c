"""Which edges of a mesh pass through which of its triangles: every place where it cuts itself.

Triangles are gathered into clusters of neighbours; clusters whose boxes meet give pairs of
triangles whose boxes meet, and of those the few whose planes part each other's corners are
decided by signed volumes.
"""

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

_CLUSTER = 16
# Candidates handled at once: bounds the memory at some tens of megabytes for any mesh.
_CHUNK = 1 << 18


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
    """Every edge that passes through a triangle with which it shares no vertex."""
    if len(faces) == 0 or not np.isfinite(vertices).all():
        return _crossings_of(
            vertices,
            np.zeros((0, 2), np.int64),
            np.zeros((0, 2), np.int64),
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
        )
    topology = _topology_of(faces)
    _, exponent = np.frexp(np.abs(vertices[faces]).max())
    points = np.ldexp(vertices.astype(np.float64), -int(exponent))
    corner = points[faces]
    low, high = corner.min(axis=1), corner.max(axis=1)
    order = _along_curve(low + high)
    start = np.arange(0, len(faces), _CLUSTER)
    size = np.diff(np.append(start, len(faces)))
    box_low = np.minimum.reduceat(low[order], start)
    box_high = np.maximum.reduceat(high[order], start)
    marked = None if among is None else np.logical_or.reduceat(among[order], start)
    found_edge, found_face, found_part = [], [], []
    for a, b in _meeting(box_low, box_high):
        if marked is not None:
            kept = marked[a] | marked[b]
            a, b = a[kept], b[kept]
        for k in range(0, len(a), _CHUNK // _CLUSTER):
            t, u = _triangle_pairs(
                a[k : k + _CHUNK // _CLUSTER],
                b[k : k + _CHUNK // _CLUSTER],
                order,
                start,
                size,
                low,
                high,
                box_low,
                box_high,
            )
            if among is not None:
                kept = among[t] | among[u]
                t, u = t[kept], u[kept]
            edge, face, part = _decide(points, faces, topology, t, u)
            found_edge.append(edge)
            found_face.append(face)
            found_part.append(part)
    edge, face, part = map(np.concatenate, (found_edge, found_face, found_part))
    order = np.lexsort((face, edge))
    edge, face, part = edge[order], face[order], part[order]
    ends = topology.ends[edge]
    p, q = vertices[ends[:, 0]], vertices[ends[:, 1]]
    return EdgeCrossings(ends, topology.edge_faces[edge], face, p + part[:, None] * (q - p))


def face_pairs(crossings: EdgeCrossings) -> Int[np.ndarray, "P 2"]:
    """Unique pairs of triangles (the lower first) that cross along some segment."""
    of_edge = crossings.edge_faces.ravel()
    through = np.repeat(crossings.face, 2)
    kept = of_edge >= 0
    pair = np.stack([of_edge[kept], through[kept]], axis=1)
    return np.unique(np.sort(pair, axis=1), axis=0)


def _crossings_of(vertices, ends, edge_faces, face, point):
    return EdgeCrossings(ends, edge_faces, face, point)


@dataclass(frozen=True)
class _Topology:
    ends: np.ndarray
    edge_faces: np.ndarray
    owned: np.ndarray  # (F, 3): edge at corners k, k + 1 that this face answers for, or -1


_kept: OrderedDict = OrderedDict()
_lock = threading.Lock()


def _topology_of(faces) -> _Topology:
    faces = np.ascontiguousarray(faces)
    key = (faces.shape, faces.dtype.str, hashlib.blake2b(faces, digest_size=16).digest())
    with _lock:
        found = _kept.get(key)
        if found is not None:
            _kept.move_to_end(key)
            return found
    found = _build(faces.astype(np.int64))
    with _lock:
        _kept[key] = found
        while len(_kept) > 4:
            _kept.popitem(last=False)
    return found


def _build(faces) -> _Topology:
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    half = np.lexsort((high, low))
    low, high = low[half], high[half]
    new = np.append(True, (low[1:] != low[:-1]) | (high[1:] != high[:-1]))
    rank = np.arange(len(half)) - np.maximum.accumulate(np.where(new, np.arange(len(half)), 0))
    first = np.flatnonzero(rank % 2 == 0)
    ends = np.stack([low[first], high[first]], axis=1)
    second = np.minimum(first + 1, len(half) - 1)
    has_second = (rank[second] % 2 == 1) & (first + 1 < len(half))
    edge_faces = np.stack([half[first] // 3, np.where(has_second, half[second] // 3, -1)], axis=1)
    owned = np.full(faces.size, -1)
    owned[half[first]] = np.arange(len(first))
    return _Topology(ends, edge_faces, owned.reshape(faces.shape))


def _along_curve(center):
    center = center - center.min(axis=0)
    extent = center.max()
    cell = (center * (1023 / extent if extent > 0 else 0.0)).astype(np.int64)
    for shift in (16, 8, 4, 2):
        mask = {16: 0x30000FF, 8: 0x300F00F, 4: 0x30C30C3, 2: 0x9249249}[shift]
        cell = (cell | (cell << shift)) & mask
    return np.argsort(cell[:, 0] | (cell[:, 1] << 1) | (cell[:, 2] << 2), kind="stable")


def _meeting(low, high):
    """Pairs a <= b (in some order) of boxes that meet, each with itself too, in chunks."""
    axis = int(np.argmax(np.ptp(low + high, axis=0)))
    order = np.argsort(low[:, axis])
    first = low[order, axis]
    stop = np.searchsorted(first, high[order, axis], side="right")
    count = stop - np.arange(len(order))
    total = np.cumsum(count)
    begin = 0
    while begin < len(order):
        done = total[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(total, done + 4 * _CHUNK)))
        a = np.repeat(np.arange(begin, end), count[begin:end])
        b = a + np.arange(len(a)) - (total[begin:end] - count[begin:end] - done)[a - begin]
        a, b = order[a], order[b]
        for k in range(3):
            if k != axis:
                kept = (low[a, k] <= high[b, k]) & (low[b, k] <= high[a, k])
                a, b = a[kept], b[kept]
        yield a, b
        begin = end


def _triangle_pairs(a, b, order, start, size, low, high, box_low, box_high):
    def reach(mine, other):
        pair = np.repeat(np.arange(len(mine)), size[mine])
        step = np.arange(len(pair)) - (np.cumsum(size[mine]) - size[mine])[pair]
        t = order[start[mine][pair] + step]
        o = other[pair]
        kept = ((low[t] <= box_high[o]) & (box_low[o] <= high[t])).all(axis=1)
        return pair[kept], t[kept]

    pair_t, t = reach(a, b)
    pair_u, u = reach(b, a)
    count = np.bincount(pair_u, minlength=len(a))
    first = np.cumsum(count) - count
    each = np.repeat(np.arange(len(t)), count[pair_t])
    step = np.arange(len(each)) - (np.cumsum(count[pair_t]) - count[pair_t])[each]
    t, u = t[each], u[first[pair_t][each] + step]
    own = (a == b)[pair_t[each]]
    kept = ((low[t] <= high[u]) & (low[u] <= high[t])).all(axis=1) & (~own | (t < u))
    return t[kept], u[kept]


def _decide(points, faces, topology, t, u):
    edge = np.concatenate([topology.owned[t], topology.owned[u]]).ravel()
    face = np.repeat(np.concatenate([u, t]), 3)
    kept = edge >= 0
    edge, face = edge[kept], face[kept]
    ends = topology.ends[edge]
    corner = np.sort(faces[face], axis=1)
    kept = (ends[:, :, None] != corner[:, None, :]).all(axis=(1, 2))
    edge, face, ends, corner = edge[kept], face[kept], ends[kept], corner[kept]
    p, q = points[ends[:, 0]], points[ends[:, 1]]
    a, b, c = points[corner[:, 0]], points[corner[:, 1]], points[corner[:, 2]]
    normal = np.cross(b - a, c - a)
    of_p = np.einsum("ij,ij->i", normal, p - a)
    of_q = np.einsum("ij,ij->i", normal, q - a)
    kept = (of_p >= 0) != (of_q >= 0)
    edge, face, p, q, a, b, c = (x[kept] for x in (edge, face, p, q, a, b, c))
    of_p, of_q = of_p[kept], of_q[kept]
    side = [_side(p, q, x, y) for x, y in ((a, b), (b, c), (a, c))]
    kept = (side[0] == side[1]) & (side[0] != side[2])
    return edge[kept], face[kept], (of_p / (of_p - of_q))[kept]


def _side(p, q, a, b):
    """Whether line a-b passes line p-q on its one side; both in their canonical direction."""
    return np.einsum("ij,ij->i", np.cross(q - p, a - p), b - p) >= 0
