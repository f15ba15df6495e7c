"""Pairs of triangles whose boxes meet, by clusters of neighbors: the broad phase of `pairs.py`.

Three levels of boxes, each around the eight below it:

    group       [                                               ]    8 clusters
    cluster     [     ][     ][     ][     ][     ][    ][      ]    8 triangles
    triangle    ........ ........ ........ ........ ........ ...

Groups are sorted along the longest axis and swept (`meeting_boxes`). Of two groups that meet, the
clusters that reach the other group's box are compared with all clusters of it, and the same again
for triangles. Of a posed body's 300 million pairs of triangles, 210,000 are compared one by one.
Which triangles make a cluster is kept in `pair_layout.py`; the boxes are fitted to the triangles at
every call.

A box is compared as two words, not as six numbers. Three coordinates of 20 bits, each with a guard
bit above it, make a word of 63 bits:

    | guard | x, 20 bits | guard | y, 20 bits | guard | z, 20 bits |

With the guards of the minuend set, one subtraction compares three coordinates, because a field that
would fall below zero borrows its own guard, and no other field's:

    high 7, other's low 5:  1 0111 - 0101 = 1 0010   the guard stands: high >= low
    high 7, other's low 9:  1 0111 - 1001 = 0 1110   it is gone:       high <  low

Two boxes meet where all six guards stand after two subtractions (`_meet`). Coordinates are rounded
outwards to whole numbers, so boxes that meet are never missed; some that are apart by less than
a step are kept, and fall to the next test.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from spt_jax.overlap.arrays.ranges import spread
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared

# Candidates handled at once: bounds the memory for any mesh. A posed body's pairs take 5.0 ms with
# this many, 5.5 with 50,000 and 9 with 2^14; with 2^17, whose arrays of 1 MiB the allocator may
# give back to the system each time, up to 9.8.
_CHUNK = 96 << 10
# A coordinate of a box takes 20 bits and a guard bit, three to a word: two subtractions of words
# do the six comparisons of two boxes, and a pair gathers four numbers instead of twelve.
_LEVEL = CLUSTER.bit_length() - 1
_FIELD = 21
STEPS = (1 << (_FIELD - 1)) - 3  # one more for what is rounded up, and one for empty slots
GUARDS = sum(1 << (_FIELD * k + _FIELD - 1) for k in range(3))
# Rows of eight bytes: which members of a group come after each one, and at last all of them.
_AFTER = np.ones((CLUSTER + 1, CLUSTER), np.uint8)
_AFTER[:-1] = np.triu(_AFTER[:-1], 1)
_AFTER = _AFTER.view(np.uint64).ravel()
# The same in half the bytes for boxes that are known to be near each other: 9 bits of a coordinate,
# counted round, and a guard bit. The sign of a difference is its highest bit but the guard.
_SHORT_FIELD = 10
_SHORT_MASK = (1 << (_SHORT_FIELD - 1)) - 1
_SHORT_GUARDS = np.uint32(sum(1 << (_SHORT_FIELD * k + _SHORT_FIELD - 1) for k in range(3)))
_SHORT_SIGNS = np.uint32(sum(1 << (_SHORT_FIELD * k + _SHORT_FIELD - 2) for k in range(3)))
# Clusters so many times as large as the usual one are compared in long words.
_LARGE = 5
# So many pairs of boxes are sampled to decide whether most only touch.
_SAMPLE = 256
Pairs = list[tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Boxes:
    """Boxes as whole numbers (3, C), and as words; and those around every `CLUSTER` of them."""

    low: Int[np.ndarray, "3 C"]
    high: Int[np.ndarray, "3 C"]
    low_word: Int[np.ndarray, "C"]
    high_word: Int[np.ndarray, "C"]
    around: "Boxes | None" = None


@dataclass(frozen=True)
class _Short:
    """Boxes in short words, for the triangles of clusters that meet; and clusters too large."""

    low: UInt32[np.ndarray, "S"]
    high: UInt32[np.ndarray, "S"]
    large: Bool[np.ndarray, "C"]


@dataclass(frozen=True)
class Slots:
    """The triangles in their slots: corners, and boxes as whole numbers and as words."""

    corner: Float[np.ndarray, "3 3 S"]  # axis, corner, slot
    extent: Float[np.ndarray, "S"]
    low: Int[np.ndarray, "3 S"]
    high: Int[np.ndarray, "3 S"]
    low_word: Int[np.ndarray, "S"]
    high_word: Int[np.ndarray, "S"]
    span: float  # the longest side of the box around all


@dataclass(frozen=True)
class Shape(Slots):
    """The same with area normals."""

    normal: Float[np.ndarray, "3 S"]
    length: Float[np.ndarray, "S"]  # of the normal


def _face_boxes(points, faces):
    corner = points[:, faces]
    return np.concatenate([corner.min(axis=2), corner.max(axis=2)]).T


def _slots(points, layout: Layout) -> Slots:
    corner = points.take(layout.corners, axis=1)
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    extent = (high - low).sum(axis=0)
    base = low.min(axis=1, keepdims=True)
    span = float((high - base).max())
    scale = STEPS / span if span > 0 else 0.0
    # Rounding down keeps the order of any two coordinates, so boxes that meet still do; one more
    # step, and so do boxes that are apart by rounding.
    low = ((low - base) * scale).astype(np.int64)
    high = ((high - base) * scale).astype(np.int64) + 1
    low[:, layout.empty] = STEPS + 2  # above every other, also one that spans the mesh
    high[:, layout.empty] = 0
    return Slots(corner, extent, low, high, word(low), word(high) | GUARDS, span)


def _shape(points, layout: Layout) -> Shape:
    slots = _slots(points, layout)
    a, b, c = slots.corner[:, 0], slots.corner[:, 1], slots.corner[:, 2]
    normal = cross(b - a, c - a)
    normal *= layout.sense
    normal[:, layout.empty] = 0.0
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return Shape(**vars(slots), normal=normal, length=length)


_Placed = TypeVar("_Placed", bound=Slots)


def boxes_of(points, layout: Layout) -> tuple[Shape, Boxes, Boxes]:
    """The triangles in a layout, their clusters and the groups of these."""
    return _boxes_of(_shape, points, layout)


def _boxes_of(
    placed: Callable[..., _Placed], points, layout: Layout
) -> tuple[_Placed, Boxes, Boxes]:
    shape = placed(points, layout)
    groups = joined(*around(*around(shape.low, shape.high)))
    return shape, joined(*around(shape.low, shape.high), groups), groups


def near_groups(mesh: Prepared, points) -> tuple[Layout, Shape, Boxes, Pairs]:
    """A layout, the triangles and clusters in it, and the pairs of groups that meet."""
    return _near_groups(_shape, mesh, points)


def near_boxes(mesh: Prepared, points) -> tuple[Layout, Slots, Boxes, Pairs]:
    """The same without normals, which take a third of the time."""
    return _near_groups(_slots, mesh, points)


def _near_groups(placed: Callable[..., _Placed], mesh: Prepared, points):
    layout = mesh.layout
    fresh = layout is None
    while True:
        if layout is None:
            layout = mesh.arrange(_face_boxes(points, mesh.topology.faces))
        shape, clusters, groups = _boxes_of(placed, points, layout)
        # Clusters that were compact once may be strewn all over another shape.
        limit = 2 * mesh.usual_pairs + len(groups.low_word)
        pairs, count = [], 0
        for a, b in meeting_boxes(groups):
            pairs.append((a, b))
            count += len(a)
            if count > limit and not fresh:
                break
        else:
            if fresh:
                mesh.usual_pairs = count
            return layout, shape, clusters, pairs
        layout, fresh = None, True


def ranked(shape: Shape, layout: Layout, ranks: Int[np.ndarray, "3 V"]):
    """The same triangles with boxes of ranks, the clusters, and the pairs of groups that meet.

    Args:
        ranks: each vertex's place in the order along each axis, below `STEPS`.
    """
    corner = ranks.take(layout.corners, axis=1)
    low, high = corner.min(axis=1), corner.max(axis=1)
    low[:, layout.empty], high[:, layout.empty] = STEPS + 2, 0
    groups = joined(*around(*around(low, high)))
    clusters = joined(*around(low, high), groups)
    words = {"low_word": word(low), "high_word": word(high) | GUARDS}
    return replace(shape, low=low, high=high, **words), clusters, list(meeting_boxes(groups))


def touching_share(shape: Shape, t, u) -> float:
    """What part of some pairs of triangles have boxes that share no more than a side.

    Args:
        t, u: their slots; some are looked at.
    """
    step = max(len(t) // _SAMPLE, 1)
    some, others = t[::step], u[::step]
    # The high ends are one step above where they are.
    over = shape.high.take(some, axis=1) - shape.low.take(others, axis=1)
    under = shape.high.take(others, axis=1) - shape.low.take(some, axis=1)
    return float((np.minimum(over, under).min(axis=0) == 1).mean())


def near_pairs(layout: Layout, shape: Shape, clusters: Boxes, groups: Pairs, touching):
    """Pairs of slots that share no vertex and whose boxes meet, in parts of bounded size.

    Args:
        layout, shape, clusters, groups: as `near_groups` gives them.
        touching: only pairs with one of these faces are wanted.
    """
    slots = touching[layout.face]
    marked = slots.reshape(-1, CLUSTER).any(axis=1)

    def wanted(c, d):
        return marked[c] | marked[d]

    def found():
        yield from within_clusters(layout, shape)
        yield from across_groups(layout, shape, clusters, groups, wanted)

    for t, u in parts_of_size(found()):
        kept = slots[t] | slots[u]
        yield t[kept], u[kept]


def parts_of_size(found: Iterable[tuple[np.ndarray, np.ndarray]]):
    """The same pairs in fewer parts, of bounded size."""
    waiting, size = [], 0
    for t, u in found:
        waiting.append((t, u))
        size += len(t)
        if size > _CHUNK:
            yield concatenate(waiting)
            waiting, size = [], 0
    if waiting:
        yield concatenate(waiting)


def within_clusters(layout: Layout, shape: Slots, groups: Int[np.ndarray, "G"] | None = None):
    """Such pairs of one cluster, of some groups of clusters if not of all."""
    pairs = layout.apart
    if groups is not None:
        marked = np.zeros(len(layout.face) // CLUSTER**2, bool)
        marked[groups] = True
        pairs = pairs[:, marked[pairs[0] // CLUSTER**2]]
    for part in pieces(pairs.shape[1], 1):
        yield kept_meeting(shape, *pairs[:, part])


def across_groups(
    layout: Layout,
    shape: Slots,
    clusters: Boxes,
    groups: Iterable[tuple[np.ndarray, np.ndarray]],
    wanted: Callable[[np.ndarray, np.ndarray], Bool[np.ndarray, "N"]] | None = None,
):
    """Such pairs of different clusters, of pairs of groups; of clusters that are wanted."""
    # Where few are wanted, to make short words takes longer than they save.
    short = _short_words(shape, clusters) if wanted is None else None
    for a, b in groups:
        for c, d, row in _meeting_members(layout, clusters, a, b):
            if wanted is not None:
                kept = np.flatnonzero(wanted(c, d))
                c, d, row = c.take(kept), d.take(kept), row.take(kept)
            yield from _meeting_triangles(layout, shape, clusters, short, c, d, row)


def meeting_boxes(boxes: Boxes):
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


def _meeting_members(layout: Layout, clusters: Boxes, a, b):
    """Pairs of clusters of the groups a and b that meet, a before b where these are the same.

    Yields:
        The clusters, and the row of each pair in the layout's `sharing.apart`.
    """
    low, high = (word.reshape(-1, CLUSTER) for word in (clusters.low_word, clusters.high_word))
    rows = layout.sharing.rows_of(a, b)
    for part in pieces(len(a), CLUSTER):
        of, c = _reaching(clusters, clusters.around, a[part], b[part])
        row, same = rows[part], a[part] == b[part]
        for piece in pieces(len(c), CLUSTER):
            pair, first = of[piece], c[piece]
            q = b[part].take(pair)
            meet = _meet(
                clusters.low_word.take(first)[:, None],
                clusters.high_word.take(first)[:, None],
                low.take(q, axis=0),
                high.take(q, axis=0),
            )
            within = first & (CLUSTER - 1)
            whole = meet.view(np.uint64).ravel()
            whole &= _AFTER.take(np.where(same.take(pair), within, CLUSTER))
            found = np.flatnonzero(meet)
            at, place = found >> _LEVEL, found & (CLUSTER - 1)
            first = first.take(at)
            of_group = row.take(pair.take(at)) * CLUSTER**2 + within.take(at) * CLUSTER + place
            yield first, CLUSTER * q.take(at) + place, layout.sharing.row.take(of_group)


def _meeting_triangles(
    layout: Layout, shape: Slots, boxes: Boxes, short: "_Short | None", a, b, row
):
    """Pairs of slots that share no vertex and whose boxes meet, of pairs of clusters that do."""
    if short is None:
        chosen = [(None, np.arange(len(a)))]
    else:
        large = short.large.take(a) | short.large.take(b)
        chosen = [(short, np.flatnonzero(~large)), (None, np.flatnonzero(large))]
    for words, some in chosen:
        pairs = a.take(some), b.take(some), row.take(some)
        for part in pieces(len(some), 3 * CLUSTER):
            yield from _meeting_across(layout, shape, boxes, words, *(x[part] for x in pairs))


def _meeting_across(layout: Layout, shape: Slots, boxes: Boxes, short: "_Short | None", a, b, row):
    pair, t = _reaching(shape, boxes, a, b)
    # Against all of the other cluster at once: only those that reach back are fewer, but to look
    # each of them up takes a third longer.
    other, mask = b.take(pair), row.take(pair) * CLUSTER + (t & (CLUSTER - 1))
    whole = layout.sharing.whole
    # A row of eight bytes at a time.
    masks = layout.sharing.apart.view(np.uint64).ravel()
    words = (shape.low_word, shape.high_word) if short is None else (short.low, short.high)
    low, high = (word.reshape(-1, CLUSTER) for word in words)
    for piece in pieces(len(t), CLUSTER):
        u, first = other[piece], t[piece]
        own_low, own_high = (word.take(first)[:, None] for word in words)
        if short is None:
            meet = _meet(own_low, own_high, low.take(u, axis=0), high.take(u, axis=0))
        else:
            gap = own_high - low.take(u, axis=0)
            gap |= high.take(u, axis=0) - own_low
            gap &= _SHORT_SIGNS
            meet = gap == 0
        # By whole rows: nine of ten have none.
        rows = meet.view(np.uint64).ravel()
        rows &= masks.take(mask[piece])
        some = np.flatnonzero(rows != 0)
        found = np.flatnonzero(meet.take(some, axis=0))
        at = some.take(found >> _LEVEL)
        first, second = first.take(at), CLUSTER * u.take(at) + (found & (CLUSTER - 1))
        if short is not None:
            first, second = kept_meeting(shape, first, second)
        yield (first, second) if whole else _sharing_none(layout, first, second)


def _short_words(shape: Slots, clusters: Boxes) -> _Short:
    """The triangles' boxes in short words.

    Two coordinates of triangles in clusters that meet differ by two clusters' extents at most. So
    the sign of their difference is known of any steps of which that is less than 256.
    """
    extent = (clusters.high - clusters.low).max(axis=0)
    usual = np.median(extent[extent >= 0]) if (extent >= 0).any() else 0  # below 0 where empty
    large = extent > _LARGE * usual
    most = int(extent[~large].max(initial=0))
    shift = max((2 * most + 2).bit_length() - (_SHORT_FIELD - 2), 0)
    low, high = (
        _short_word((field.astype(np.uint32) >> np.uint32(shift)) & np.uint32(_SHORT_MASK))
        for field in (shape.low, shape.high)
    )
    return _Short(low, high | _SHORT_GUARDS, large)


def _short_word(field):
    return (field[0] << 2 * _SHORT_FIELD) | (field[1] << _SHORT_FIELD) | field[2]


def _reaching(members: Slots | Boxes, boxes: Boxes | None, a, b):
    """The members of box a that meet box b: number of the pair, and member."""
    if boxes is None:
        raise ValueError("boxes must have boxes around them: got none.")
    # Whole rows by take, never by index: five times as fast.
    low = members.low_word.reshape(-1, CLUSTER).take(a, axis=0)
    high = members.high_word.reshape(-1, CLUSTER).take(a, axis=0)
    found = np.flatnonzero(
        _meet(low, high, boxes.low_word.take(b)[:, None], boxes.high_word.take(b)[:, None])
    )
    pair = found >> _LEVEL
    return pair, found + CLUSTER * (a.take(pair) - pair)


def kept_meeting(shape: Slots, t, u):
    """The pairs of slots whose boxes meet."""
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


def around(low, high):
    """The boxes around every `CLUSTER` boxes."""
    count = low.shape[1] // CLUSTER
    while low.shape[1] > count:
        low = np.minimum(low[:, ::2], low[:, 1::2])
        high = np.maximum(high[:, ::2], high[:, 1::2])
    return low, high


def joined(low, high, around: Boxes | None = None) -> Boxes:
    """Boxes with their words."""
    return Boxes(low, high, word(low), word(high) | GUARDS, around)


def word(field):
    """Three coordinates in one number."""
    return (((field[0] << _FIELD) | field[1]) << _FIELD) | field[2]


def _meet(low, high, other_low, other_high):
    """Whether boxes meet: a guard bit survives where the high end is not below the low one."""
    first = high - other_low
    first &= other_high - low
    first &= GUARDS
    return first == GUARDS


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
