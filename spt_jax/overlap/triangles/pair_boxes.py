"""Pairs of triangles whose boxes meet, by clusters of neighbors: the broad phase of `pairs.py`.

Three levels of boxes, each around the eight below it:

    group       [                                               ]    8 clusters
    cluster     [     ][     ][     ][     ][     ][    ][      ]    8 triangles
    triangle    ........ ........ ........ ........ ........ ...

Groups are sorted along the longest axis and swept (`meeting_boxes`). Of two groups that meet, the
clusters that reach the other group's box are compared with all clusters of it, and the same again
for triangles. Of a posed body's 300 million pairs of triangles, 210,000 are compared one by one.
Which triangles make a cluster is kept in `pair_layout.py`; the boxes are fitted to the triangles at
every call. How boxes are compared is in `box_words.py`.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.pieces import parts, parts_of_size, pieces
from spt_jax.overlap.arrays.ranges import spread
from spt_jax.overlap.triangles.box_words import (
    GUARDS,
    SHORT_SIGNS,
    STEPS,
    Boxes,
    Shape,
    Short,
    Slots,
    around,
    boxes_meet,
    joined,
    shape_of,
    short_words,
    slots_of,
    word,
)
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared

# A place among eight takes so many bits.
_LEVEL = CLUSTER.bit_length() - 1
# Rows of eight bytes: which members of a group come after each one, and at last all of them.
_AFTER = np.ones((CLUSTER + 1, CLUSTER), np.uint8)
_AFTER[:-1] = np.triu(_AFTER[:-1], 1)
_AFTER = _AFTER.view(np.uint64).ravel()
Pairs = list[tuple[np.ndarray, np.ndarray]]


def _face_boxes(points, faces):
    corner = points[:, faces]
    return np.concatenate([corner.min(axis=2), corner.max(axis=2)]).T


_Placed = TypeVar("_Placed", bound=Slots)


def boxes_of(points, layout: Layout) -> tuple[Shape, Boxes, Boxes]:
    """The triangles in a layout, their clusters and the groups of these."""
    return _boxes_of(shape_of, points, layout)


def _boxes_of(
    placed: Callable[..., _Placed], points, layout: Layout
) -> tuple[_Placed, Boxes, Boxes]:
    shape = placed(points, layout)
    groups = joined(*around(*around(shape.low, shape.high)))
    return shape, joined(*around(shape.low, shape.high), groups), groups


def near_groups(mesh: Prepared, points) -> tuple[Layout, Shape, Boxes, Pairs]:
    """A layout, the triangles and clusters in it, and the pairs of groups that meet."""
    return _near_groups(shape_of, mesh, points)


def near_boxes(mesh: Prepared, points) -> tuple[Layout, Slots, Boxes, Pairs]:
    """The same without normals, which take a third of the time."""
    return _near_groups(slots_of, mesh, points)


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
    short = short_words(shape, clusters) if wanted is None else None
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
        kept = np.flatnonzero(boxes_meet(low.take(a), high.take(a), low.take(b), high.take(b)))
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
            meet = boxes_meet(
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
    layout: Layout, shape: Slots, boxes: Boxes, short: "Short | None", a, b, row
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


def _meeting_across(layout: Layout, shape: Slots, boxes: Boxes, short: "Short | None", a, b, row):
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
            meet = boxes_meet(own_low, own_high, low.take(u, axis=0), high.take(u, axis=0))
        else:
            gap = own_high - low.take(u, axis=0)
            gap |= high.take(u, axis=0) - own_low
            gap &= SHORT_SIGNS
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


def _reaching(members: Slots | Boxes, boxes: Boxes | None, a, b):
    """The members of box a that meet box b: number of the pair, and member."""
    if boxes is None:
        raise ValueError("boxes must have boxes around them: got none.")
    # Whole rows by take, never by index: five times as fast.
    low = members.low_word.reshape(-1, CLUSTER).take(a, axis=0)
    high = members.high_word.reshape(-1, CLUSTER).take(a, axis=0)
    found = np.flatnonzero(
        boxes_meet(low, high, boxes.low_word.take(b)[:, None], boxes.high_word.take(b)[:, None])
    )
    pair = found >> _LEVEL
    return pair, found + CLUSTER * (a.take(pair) - pair)


def kept_meeting(shape: Slots, t, u):
    """The pairs of slots whose boxes meet."""
    low, high = shape.low_word, shape.high_word
    kept = np.flatnonzero(boxes_meet(low.take(t), high.take(t), low.take(u), high.take(u)))
    return t.take(kept), u.take(kept)


def _sharing_none(layout: Layout, t, u):
    p, q = layout.corners_32.take(t, axis=1), layout.corners_32.take(u, axis=1)
    shared = p[0] == q[0]
    for i, j in ((0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)):
        shared |= p[i] == q[j]
    kept = np.flatnonzero(~shared)
    return t.take(kept), u.take(kept)
