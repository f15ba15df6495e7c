"""What was apart in an earlier shape of a mesh, and is so until it has moved by more than its gap.

A search asks for meshes that moved by a millimetre. So once a mesh comes that has moved little
since the last one, three things are kept of it: pairs of triangles near each other and how far they
are apart at least, of all others that they are apart by more than a certain growth of their boxes,
and of each corner how far its triangle may move and still face the direction that all around its
vertex face (`fans.py`).

The next shape is compared with that one: by how much the vertices of each group of clusters moved,
as a box, and so by how much two groups moved against each other at most. Where that is less than
the gap, the two triangles are still apart, and nobody looks at them: of 35,000 pairs kept, and as
many corners, a few hundred are left after a step of a millimetre. Where two groups moved by more
than boxes were grown, they are searched anew.

Kept pairs never decide anything: what is proved apart does not intersect, by signs that are exact,
and whatever is left is worked out from the coordinates of each call. So the results are those of a
first call to the bit, whatever was seen before. What is kept is replaced as a whole, never written
to, for any number of threads.
"""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from spt_jax.overlap.arrays.pieces import concatenate
from spt_jax.overlap.arrays.ranges import unique
from spt_jax.overlap.triangles.box_words import GUARDS, STEPS, Boxes, Shape, around, joined, word
from spt_jax.overlap.triangles.fans import facing
from spt_jax.overlap.triangles.gaps import gaps
from spt_jax.overlap.triangles.pair_boxes import across_groups, meeting_boxes, within_clusters
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared, Topology

_GROUP = CLUSTER**2
# Boxes grow on each side by this part of a usual cluster's extent: 0.6 mm on the embedded body.
_GROWTH = 40
# Of pairs farther apart than this part of the growth nobody asks how far.
_ENOUGH = 0.3
# Where vertices moved against each other by more than so many growths, the mesh is another one; and
# groups whose boxes are apart by more are not compared at all.
_FAR = 16
# Where more of the groups than this part have moved too far, all are searched.
_FEW = 0.4
# Larger meshes are searched every time, and so are those of which so many pairs a triangle would be
# kept. Where more than this part of the pairs meet, above a number that does not matter, solids may
# touch: by rank they are known to be apart (`near_triangles.py`), by what is kept they would be
# looked at.
_MOST_GROUPS, _MOST_PAIRS_EACH = 2048, 8
_MANY, _MOST_MEETING = 1024, 0.1
# One of every so many vertices is compared first, to see that a mesh is another one.
_SOME = 64
# So many shapes of a mesh are kept, for those that are asked for in turn: a batch's, frames' of a
# motion. To keep what is apart takes as long as another call, and each call after it takes half as
# long as before. So where many more shapes were kept than were of use, the next one has to be near
# the last twice as often before more than its points are kept, but at most so often.
_SHAPES, _MOST_PATIENCE = 16, 31
# Beyond the growth, boxes are rounded by a step or two in either shape.
_ROUNDED = 4
# What rounding may add to how far something moved.
_UP = 1 + 1e-12


@dataclass(frozen=True)
class Apart:
    """What is apart in a shape.

    Attributes:
        start, vertex: group g has the vertices vertex[start[g] : start[g + 1]].
        groups: (2, M), pairs of groups that are near each other, each with itself too.
        growth: how far two groups may move against each other along an axis before pairs of
            triangles meet that are not kept.
        pairs: the slots of pairs that are.
        of: of each pair the pair of groups.
        gap: how far they are apart at least.
        turns: for each corner how far the vertices of its triangle may move against each other.
    """

    start: Int[np.ndarray, "G1"]
    vertex: Int[np.ndarray, "N"]
    groups: Int[np.ndarray, "2 M"]
    growth: float
    pairs: Int32[np.ndarray, "2 P"]
    of: Int32[np.ndarray, "P"]
    gap: Float32[np.ndarray, "P"]
    turns: Float32[np.ndarray, "3 S"]


@dataclass(frozen=True)
class Kept:
    """What is kept of a shape.

    Attributes:
        layout: of the triangles.
        scale: what coordinates had been multiplied by.
        points: the vertices.
        growth: by how much two boxes together are grown.
        some: a few of the vertices.
        calm: how many calls before were near this shape, or near one that was, and so on.
        apart: what is apart; None where only the points are kept.
    """

    layout: Layout
    scale: float
    points: Float[np.ndarray, "3 V"]
    growth: float
    some: Float[np.ndarray, "3 N"]
    calm: int = 0
    apart: Apart | None = None


@dataclass(frozen=True)
class Left:
    """What has to be looked at.

    Attributes:
        layout: of the triangles.
        pairs: slots of pairs of triangles.
        vertex: vertices around which triangles may meet.
        groups: pairs of groups whose pairs of triangles are not known.
    """

    layout: Layout
    pairs: Int[np.ndarray, "2 P"]
    vertex: Int[np.ndarray, "U"]
    groups: Int[np.ndarray, "2 G"]


def left_of(mesh: Prepared, near: Kept | None, points: Float[np.ndarray, "3 V"]) -> Left | None:
    """What is left to look at of a shape; None if nothing is known of one near it.

    Args:
        mesh: what is known of the mesh.
        near: what is kept of a shape near it.
        points: the vertices.
    """
    if near is None or near.apart is None:
        return None
    found = _left_of(near, near.apart, points)
    if found is None:
        mesh.kept = _without(mesh, near)
    else:
        mesh.waste = max(mesh.waste - 1, 0)
        if mesh.kept[0] is not near:
            mesh.kept = (near, *_without(mesh, near))
    return found


def _left_of(kept: Kept, apart: Apart, points: Float[np.ndarray, "3 V"]) -> Left | None:
    layout = kept.layout
    moved = (points - kept.points).take(apart.vertex, axis=1)
    least = np.minimum.reduceat(moved, apart.start[:-1], axis=1)
    most = np.maximum.reduceat(moved, apart.start[:-1], axis=1)
    a, b = apart.groups
    farthest, square = np.zeros(len(a)), np.zeros(len(a))
    for low, high in zip(least, most, strict=True):
        along = np.maximum(high.take(a) - low.take(b), high.take(b) - low.take(a))
        np.maximum(farthest, along, out=farthest)
        square += along * along
    far = ~(farthest <= apart.growth)
    if far.mean() > _FEW:
        return None
    looked_at = apart.gap <= (_UP * np.sqrt(square)).take(apart.of)
    if far.any():
        looked_at &= ~far.take(apart.of)
    pairs = apart.pairs.take(np.flatnonzero(looked_at), axis=1).astype(np.int64)
    own = _UP * np.sqrt(((most - least) ** 2).sum(axis=0))
    turned = apart.turns.reshape(3, -1, _GROUP) <= own[:, None]
    marked = np.zeros(points.shape[1], bool)
    marked[layout.corners[turned.reshape(3, -1)]] = True
    return Left(layout, pairs, np.flatnonzero(marked), apart.groups[:, far])


def nearest(mesh: Prepared, points: Float[np.ndarray, "3 V"], scale: float) -> Kept | None:
    """Of what is kept the first that is so near that groups are worth a look."""
    known = [one for one in mesh.kept if one.layout is mesh.layout and one.scale == scale]
    if not known:
        return None
    # A few vertices rule out nearly all that are not.
    moved = points[:, ::_SOME] - np.stack([one.some for one in known])
    for k, most in enumerate(np.ptp(moved, axis=2).max(axis=1).tolist()):
        limit = _FAR * known[k].growth
        if most <= limit and np.ptp(points - known[k].points, axis=1).max() <= limit:
            return known[k]
    return None


def _without(mesh: Prepared, kept: Kept) -> tuple[Kept, ...]:
    return tuple(one for one in mesh.kept if one is not kept)


def keep(
    mesh: Prepared, before: Kept | None, points: Float[np.ndarray, "3 V"], scale: float, boxes
) -> Left | None:
    """Keep of a shape what is apart in it if ones near it were seen before, else its points alone.

    Args:
        mesh: keeps it.
        before: what is kept of a shape near it.
        points: the vertices.
        scale: what their coordinates were multiplied by.
        boxes: the layout, triangles and clusters, as `near_groups` gives them.

    Returns:
        What is left to look at of this shape; None where nothing but points is kept.
    """
    layout, shape, clusters = boxes
    if clusters.low.shape[1] // CLUSTER > _MOST_GROUPS:
        return None
    growth = (2 * _growth(clusters) - _ROUNDED) * shape.span / STEPS
    calm = 0 if before is None or before.apart is not None else before.calm + 1
    kept = Kept(layout, scale, points, growth, points[:, ::_SOME].copy(), calm)
    if calm > min(2 ** max(mesh.waste - _SHAPES, 0) - 1, _MOST_PATIENCE):
        apart = _apart(mesh.topology, kept, shape, clusters)
        mesh.waste = mesh.waste + 1 if apart is not None else _SHAPES + _MOST_PATIENCE
        kept = replace(kept, calm=0, apart=apart)
    others = [one for one in mesh.kept if one is not before and one.layout is mesh.layout]
    mesh.kept = (kept, *others[: _SHAPES - 1])
    if kept.apart is None:
        return None
    marked = np.zeros(points.shape[1], bool)
    marked[layout.corners[kept.apart.turns <= 0]] = True
    met = np.flatnonzero(kept.apart.gap <= 0)
    pairs = kept.apart.pairs.take(met, axis=1).astype(np.int64)
    return Left(layout, pairs, np.flatnonzero(marked), np.zeros((2, 0), np.int64))


def _apart(topology: Topology, kept: Kept, shape: Shape, clusters: Boxes) -> Apart | None:
    layout, count = kept.layout, clusters.low.shape[1] // CLUSTER
    filled = np.ones(len(layout.face), bool)
    filled[layout.empty] = False
    size = kept.points.shape[1]
    slot = np.flatnonzero(filled)
    number = unique((slot // _GROUP * size + layout.corners[:, slot]).ravel())
    group, vertex = np.divmod(number, size)
    start = np.searchsorted(group, np.arange(count + 1))
    groups = _near_groups(clusters)
    if (np.diff(start) == 0).any() or groups is None:
        return None
    pairs = _near_pairs(kept, shape, clusters)
    if pairs is None:
        return None
    gap = gaps(shape, pairs[0], pairs[1], _ENOUGH * kept.growth)
    if np.count_nonzero(gap <= 0) > _MANY + _MOST_MEETING * len(gap):
        return None
    key = groups[0] * count + groups[1]
    of_pairs = pairs // _GROUP
    of = np.searchsorted(key, of_pairs.min(axis=0) * count + of_pairs.max(axis=0))
    return Apart(
        start=start,
        vertex=vertex,
        groups=groups,
        growth=kept.growth,
        pairs=pairs.astype(np.int32),
        of=of.astype(np.int32),
        gap=gap.astype(np.float32),
        turns=_turns(topology, layout, shape),
    )


def _near_groups(clusters: Boxes) -> Int[np.ndarray, "2 M"] | None:
    """Pairs of groups whose boxes are not farther apart than the distance that is far, sorted."""
    boxes = clusters.around
    if boxes is None:
        return None
    far = _FAR * _growth(clusters)
    low, high = np.maximum(boxes.low - far, 0), np.minimum(boxes.high + far, STEPS + 1)
    found = np.stack(concatenate(list(meeting_boxes(joined(low, high)))))
    return found[:, np.lexsort(found[::-1])]


def _near_pairs(kept: Kept, shape: Shape, clusters: Boxes) -> Int[np.ndarray, "2 P"] | None:
    """Pairs of triangles whose grown boxes meet; None if too many."""
    grown = _grown(shape, _growth(clusters))
    around_groups = joined(*around(*around(grown.low, grown.high)))
    larger = joined(*around(grown.low, grown.high), around_groups)
    found, size, most = [], 0, _MOST_PAIRS_EACH * len(kept.layout.slot)
    across = across_groups(kept.layout, grown, larger, list(meeting_boxes(around_groups)))
    for t, u in chain(within_clusters(kept.layout, grown), across):
        size += len(t)
        if size > most:
            return None
        found.append(np.stack([t, u]))
    return np.concatenate([np.zeros((2, 0), np.int64), *found], axis=1)


def _turns(topology: Topology, layout: Layout, shape: Shape) -> Float32[np.ndarray, "3 S"]:
    """How far the vertices of each triangle may move against each other, for each of its corners.

    Of a normal u x v with a = |u| + |v|, moves of r change it by r (a + r) at most: by less than
    its part c along the direction that it has to face, if r is less than c / (a + c / a).
    """
    sure, faces, length = facing(topology, layout, shape)
    sides = [shape.corner[:, (k + 1) % 3] - shape.corner[:, k] for k in range(3)]
    long = np.sqrt([x[0] ** 2 + x[1] ** 2 + x[2] ** 2 for x in sides])
    a = long.sum(axis=0) - long.max(axis=0)
    a = np.where(a > 0, a, np.inf)
    size = length.take(layout.corners)
    c = faces / np.where(size > 0, size, np.inf)
    found = c / (a + c / a) * (1 - 1e-6) - 1e-12
    found[~sure.take(layout.corners)] = -1.0
    found[:, layout.empty] = np.inf
    return found.astype(np.float32)


def _growth(clusters: Boxes) -> int:
    extent = (clusters.high - clusters.low).max(axis=0)
    return int(np.median(extent[extent >= 0])) // _GROWTH if (extent >= 0).any() else 0


def _grown(shape: Shape, growth: int) -> Shape:
    """The triangles' boxes larger on every side, but for empty ones."""
    low = np.where(shape.low > STEPS + 1, shape.low, np.maximum(shape.low - growth, 0))
    high = np.where(shape.high > 0, np.minimum(shape.high + growth, STEPS + 1), 0)
    return replace(shape, low=low, high=high, low_word=word(low), high_word=word(high) | GUARDS)
