"""Pairs of triangles whose boxes meet, by clusters of neighbours: the broad phase of `pairs.py`.

The boxes of all clusters and of groups of them are refitted to the triangles at every call; which
triangles make a cluster is kept in `pair_layout.py`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared

# Candidates handled at once: bounds the memory for any mesh. A posed body's pairs take 5.0 ms with
# this many, 5.5 with 50,000 and 9 with 2^14; with 2^17, whose arrays of 1 MiB the allocator may
# give back to the system each time, up to 9.8.
_CHUNK = 96 << 10
# A coordinate of a box takes 20 bits and a guard bit, three to a word: two subtractions of words
# do the six comparisons of two boxes, and a pair gathers four numbers instead of twelve.
_FIELD = 21
_STEPS = (1 << (_FIELD - 1)) - 3  # one more for what is rounded up, and one for empty slots
_GUARDS = sum(1 << (_FIELD * k + _FIELD - 1) for k in range(3))
_BEFORE = np.triu(np.ones((CLUSTER, CLUSTER), bool), 1)
_Pairs = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class _Boxes:
    """Boxes as whole numbers (3, C), and as words."""

    low: Int[np.ndarray, "3 C"]
    high: Int[np.ndarray, "3 C"]
    low_word: Int[np.ndarray, "C"]
    high_word: Int[np.ndarray, "C"]


@dataclass(frozen=True)
class Shape:
    """The triangles in their slots: corners, area normals, boxes as whole numbers and as words."""

    corner: Float[np.ndarray, "3 3 S"]  # axis, corner, slot
    normal: Float[np.ndarray, "3 S"]
    length: Float[np.ndarray, "S"]  # of the normal
    extent: Float[np.ndarray, "S"]
    low: Int[np.ndarray, "3 S"]
    high: Int[np.ndarray, "3 S"]
    low_word: Int[np.ndarray, "S"]
    high_word: Int[np.ndarray, "S"]
    span: float  # the longest side of the box around all


def _face_boxes(points, faces):
    corner = points[:, faces]
    return np.concatenate([corner.min(axis=2), corner.max(axis=2)]).T


def _shape(points, layout: Layout) -> Shape:
    corner = points.take(layout.corners, axis=1)
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    normal = cross(b - a, c - a)
    normal *= layout.sense
    normal[:, layout.empty] = 0.0
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    extent = (high - low).sum(axis=0)
    base = low.min(axis=1, keepdims=True)
    span = float((high - base).max())
    scale = _STEPS / span if span > 0 else 0.0
    # Rounding down keeps the order of any two coordinates, so boxes that meet still do; one more
    # step, and so do boxes that are apart by rounding.
    low = ((low - base) * scale).astype(np.int64)
    high = ((high - base) * scale).astype(np.int64) + 1
    low[:, layout.empty] = _STEPS + 2  # above every other, also one that spans the mesh
    high[:, layout.empty] = 0
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    words = _word(low), _word(high) | _GUARDS
    return Shape(corner, normal, length, extent, low, high, *words, span)


def near_groups(mesh: Prepared, points):
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


def near_pairs(layout: Layout, shape: Shape, clusters: _Boxes, groups: _Pairs, touching):
    """Pairs of slots that share no vertex and whose boxes meet, in parts of bounded size."""
    waiting, size = [], 0
    slots = None if touching is None else touching[layout.face]
    marked = None if slots is None else slots.reshape(-1, CLUSTER).any(axis=1)
    for t, u in _all_near_pairs(layout, shape, clusters, groups, marked):
        if slots is not None:
            kept = slots[t] | slots[u]
            t, u = t[kept], u[kept]
        waiting.append((t, u))
        size += len(t)
        if size > _CHUNK:
            yield concatenate(waiting)
            waiting, size = [], 0
    if waiting:
        yield concatenate(waiting)


def _all_near_pairs(layout: Layout, shape: Shape, clusters: _Boxes, groups: _Pairs, marked):
    for part in pieces(layout.apart.shape[1], 1):
        yield _kept_meeting(shape, *layout.apart[:, part])
    for a, b in groups:
        for c, d, row in _meeting_members(layout, clusters, a, b):
            if marked is not None:
                kept = marked[c] | marked[d]
                c, d, row = c[kept], d[kept], row[kept]
            yield from _meeting_triangles(layout, shape, clusters, c, d, row)


def _meeting_boxes(boxes: _Boxes):
    """Pairs of boxes that meet, the lower first, each with itself too, in parts of bounded size."""
    axis = int(np.argmax(np.ptp(boxes.low, axis=1)))
    order = np.argsort(boxes.low[axis])
    first = boxes.low[axis][order]
    low, high = boxes.low_word[order], boxes.high_word[order]
    here = np.arange(len(order))
    stop = np.searchsorted(first, boxes.high[axis][order], side="right")
    count = np.maximum(stop - here, 1)
    for part in parts(count):
        b, at = spread(here[part], count[part])
        a = at + part.start
        kept = np.flatnonzero(_meet(low.take(a), high.take(a), low.take(b), high.take(b)))
        a, b = order[a[kept]], order[b[kept]]
        yield np.minimum(a, b), np.maximum(a, b)


def _meeting_members(layout: Layout, clusters: _Boxes, a, b):
    """Pairs of clusters of the groups a and b that meet, a before b where these are the same.

    Yields:
        The clusters, and the row of each pair in the layout's `sharing.apart`.
    """
    low, high = (word.reshape(-1, CLUSTER) for word in (clusters.low_word, clusters.high_word))
    rows = layout.sharing.rows_of(a, b)
    for part in pieces(len(a), CLUSTER * CLUSTER):
        p, q = a[part], b[part]
        meet = _meet(
            low.take(p, axis=0)[:, :, None],
            high.take(p, axis=0)[:, :, None],
            low.take(q, axis=0)[:, None, :],
            high.take(q, axis=0)[:, None, :],
        )
        meet[p == q] &= _BEFORE
        found = np.flatnonzero(meet)
        pair, place = found // CLUSTER**2, found % CLUSTER**2
        row = layout.sharing.row.take(rows[part].take(pair) * CLUSTER**2 + place)
        p, q = CLUSTER * p.take(pair), CLUSTER * q.take(pair)
        yield p + place // CLUSTER, q + place % CLUSTER, row


def _meeting_triangles(layout: Layout, shape: Shape, boxes: _Boxes, a, b, row):
    """Pairs of slots that share no vertex and whose boxes meet, of pairs of clusters that do."""
    low, high = (word.reshape(-1, CLUSTER) for word in (shape.low_word, shape.high_word))
    masks = layout.sharing.apart.reshape(-1, CLUSTER)
    for part in pieces(len(a), 3 * CLUSTER):
        pair, t = _reaching(shape, boxes, a[part], b[part])
        # Against all of the other cluster at once: only those that reach back are fewer, but to
        # look each of them up takes a third longer.
        other, mask = b[part].take(pair), row[part].take(pair) * CLUSTER + t % CLUSTER
        for piece in pieces(len(t), CLUSTER):
            u, first = other[piece], t[piece]
            low_t, high_t = shape.low_word.take(first), shape.high_word.take(first)
            meet = _meet(low_t[:, None], high_t[:, None], low.take(u, axis=0), high.take(u, axis=0))
            meet &= masks.take(mask[piece], axis=0)
            found = np.flatnonzero(meet)
            at = found // CLUSTER
            second = CLUSTER * u.take(at) + found % CLUSTER
            yield _sharing_none(layout, first.take(at), second)


def _reaching(shape: Shape, boxes: _Boxes, a, b):
    """The triangles of cluster a whose boxes meet the box of b: number of the pair, and slot."""
    # Whole rows by take, never by index: five times as fast.
    low = shape.low_word.reshape(-1, CLUSTER).take(a, axis=0)
    high = shape.high_word.reshape(-1, CLUSTER).take(a, axis=0)
    found = np.flatnonzero(
        _meet(low, high, boxes.low_word.take(b)[:, None], boxes.high_word.take(b)[:, None])
    )
    pair = found // CLUSTER
    return pair, found + CLUSTER * (a.take(pair) - pair)


def _kept_meeting(shape: Shape, t, u):
    low, high = shape.low_word, shape.high_word
    kept = np.flatnonzero(_meet(low.take(t), high.take(t), low.take(u), high.take(u)))
    return t.take(kept), u.take(kept)


def _sharing_none(layout: Layout, t, u):
    p, q = layout.corners_32.take(t, axis=1), layout.corners_32.take(u, axis=1)
    shared = p[0] == q[0]
    for i, j in ((0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)):
        shared |= p[i] == q[j]
    kept = np.flatnonzero(~shared)
    return t.take(kept), u.take(kept)


def _joined(low, high) -> _Boxes:
    """The boxes around every `CLUSTER` boxes."""
    count = low.shape[1] // CLUSTER
    while low.shape[1] > count:
        low = np.minimum(low[:, ::2], low[:, 1::2])
        high = np.maximum(high[:, ::2], high[:, 1::2])
    return _Boxes(low, high, _word(low), _word(high) | _GUARDS)


def _word(field):
    return (((field[0] << _FIELD) | field[1]) << _FIELD) | field[2]


def _meet(low, high, other_low, other_high):
    """Whether boxes meet: a guard bit survives where the high end is not below the low one."""
    first = high - other_low
    first &= other_high - low
    first &= _GUARDS
    return first == _GUARDS


def concatenate(pairs):
    """Join many tuples of arrays into one."""
    return tuple(np.concatenate(part) for part in zip(*pairs, strict=True))


def cross(x, y):
    """Cross products of the columns; np.cross takes three times as long."""
    out = np.empty_like(x)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k] = x[i] * y[j]
        out[k] -= x[j] * y[i]
    return out


def spread(first, count):
    """first[i], first[i] + 1, ... (count[i] of them) for each i in turn; and the i of each."""
    at = np.repeat(np.arange(len(count)), count)
    return np.arange(len(at)) + (first - np.cumsum(count) + count).take(at), at


def pieces(count: int, size: int) -> Iterator[slice]:
    """Slices of `count` items, each of which counts `size` times, of about `_CHUNK` in all."""
    step = max(_CHUNK // size, 1)
    for begin in range(0, count, step):
        yield slice(begin, min(begin + step, count))


def parts(count) -> Iterator[slice]:
    """Slices of the items, such that each slice's counts add up to about `_CHUNK` at most."""
    total = np.cumsum(count)
    begin, done = 0, 0
    while begin < len(total):
        end = max(begin + 1, int(np.searchsorted(total, done + _CHUNK, side="right")))
        yield slice(begin, end)
        begin, done = end, int(total[end - 1])
