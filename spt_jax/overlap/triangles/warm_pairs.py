"""Pairs of triangles near each other, of a mesh that may have moved little since it was last seen.

A search asks for meshes that moved by a millimetre. So once a mesh comes that has moved little
since the last one, its boxes are grown, by a small part of a cluster, and the pairs of triangles
whose grown boxes meet are kept: twice as many pairs. While two groups of clusters have moved
against each other by less than their boxes were grown, no pair of theirs meets that is not kept,
and what is kept only has to be compared again; groups that moved farther, one in eight, are
searched anew. How far they moved is told along each axis by the least and the largest displacement
of each group's vertices.

Kept pairs never decide anything: whether they intersect is worked out from the coordinates of each
call, and a pair too many changes nothing. So the results are those of a first call to the bit,
whatever was seen before. What is kept is replaced as a whole, never written to, for any number of
threads.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int32

from spt_jax.overlap.triangles.pair_boxes import (
    GUARDS,
    STEPS,
    Boxes,
    Pairs,
    Shape,
    across_groups,
    around,
    concatenate,
    joined,
    kept_meeting,
    meeting_boxes,
    parts_of_size,
    pieces,
    within_clusters,
    word,
)
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared

_GROUP = CLUSTER**2
# Boxes grow on each side by this part of a usual cluster's extent: 0.3 mm on the embedded body.
_GROWTH = 80
# Where more of the groups that meet than this part have moved too far, all are searched.
_FEW = 0.4
# A table of all pairs of groups is made at each call; larger meshes are searched every time. And so
# are those of which so many pairs a triangle would be kept.
_MOST_GROUPS, _MOST_PAIRS_EACH = 2048, 8
# Where one coordinate of two, of every so many vertices, moved by more than this many growths, the
# mesh is another one, and groups are not looked at.
_SOME, _MUCH = 64, 20.0
# Beyond the growth, boxes are rounded by a step or two in either shape.
_ROUNDED = 4


@dataclass(frozen=True)
class Kept:
    """What is kept of a shape.

    Attributes:
        layout: of the triangles.
        scale: what coordinates had been multiplied by.
        points: the vertices.
        growth: by how much two boxes together had been grown.
        pairs: the slots of the pairs of different clusters whose grown boxes met, and of each the
            two groups as one number; None where only the points are kept.
    """

    layout: Layout
    scale: float
    points: Float[np.ndarray, "3 V"]
    growth: float
    pairs: Int32[np.ndarray, "3 N"] | None = None


def warm_pairs(
    mesh: Prepared,
    points: Float[np.ndarray, "3 V"],
    scale: float,
    layout: Layout,
    shape: Shape,
    clusters: Boxes,
    groups: Pairs,
):
    """As `near_pairs`, with what is kept of an earlier shape of the mesh.

    Args:
        mesh: keeps it.
        points: the vertices.
        scale: what their coordinates were multiplied by.
        layout, shape, clusters, groups: as `near_groups` gives them.
    """
    yield from within_clusters(layout, shape)
    count = clusters.low.shape[1] // CLUSTER
    if count > _MOST_GROUPS:
        yield from parts_of_size(across_groups(layout, shape, clusters, groups))
        return
    kept, a, b = mesh.kept, *concatenate(groups)
    total = (2 * _growth(clusters) - _ROUNDED) * _step(shape)
    far = np.ones(len(a), bool)
    if kept is not None and kept.layout is layout and kept.scale == scale:
        allowed = kept.growth - _ROUNDED * _step(shape)
        moved = points - kept.points
        if np.median(np.abs(moved[:, ::_SOME])) <= _MUCH * allowed:
            far = _moved_far(layout, moved, a, b, allowed)
    if far.mean() > _FEW:
        yield from parts_of_size(across_groups(layout, shape, clusters, groups))
        mesh.kept = Kept(layout, scale, points, total)
    elif kept is None or kept.pairs is None:
        yield from _kept_from(mesh, Kept(layout, scale, points, total), shape, clusters)
    else:
        groups = [(a[far], b[far])] if far.any() else []
        yield from parts_of_size(across_groups(layout, shape, clusters, groups))
        dropped = np.zeros(count * count, bool)
        dropped[a[far] * count + b[far]] = True
        for part in pieces(kept.pairs.shape[1], 1):
            first, second, key = kept.pairs[:, part]
            there = np.flatnonzero(~dropped.take(key))
            yield kept_meeting(shape, first.take(there), second.take(there))


def _kept_from(mesh: Prepared, kept: Kept, shape: Shape, clusters: Boxes):
    """The pairs across clusters, found by grown boxes, which are kept."""
    layout, count = kept.layout, clusters.low.shape[1] // CLUSTER
    grown = _grown(shape, _growth(clusters))
    around_groups = joined(*around(*around(grown.low, grown.high)))
    larger = joined(*around(grown.low, grown.high), around_groups)
    found, size, most = [], 0, _MOST_PAIRS_EACH * len(layout.slot)
    for t, u in across_groups(layout, grown, larger, list(meeting_boxes(around_groups))):
        size += len(t)
        if size <= most:
            found.append((t, u))
        yield kept_meeting(shape, t, u)
    if size > most:
        mesh.kept = None
        return
    first, second = concatenate(found) if found else np.zeros((2, 0), np.int64)
    key = (first // _GROUP) * count + second // _GROUP
    mesh.kept = replace(kept, pairs=np.stack([first, second, key]).astype(np.int32))


def _step(shape: Shape) -> float:
    """How long a step of the boxes' coordinates is."""
    return shape.span / STEPS


def _growth(clusters: Boxes) -> int:
    extent = (clusters.high - clusters.low).max(axis=0)
    return int(np.median(extent[extent >= 0])) // _GROWTH if (extent >= 0).any() else 0


def _grown(shape: Shape, growth: int) -> Shape:
    """The triangles' boxes larger on every side, but for empty ones."""
    low = np.where(shape.low > STEPS + 1, shape.low, np.maximum(shape.low - growth, 0))
    high = np.where(shape.high > 0, np.minimum(shape.high + growth, STEPS + 1), 0)
    return replace(shape, low=low, high=high, low_word=word(low), high_word=word(high) | GUARDS)


def _moved_far(layout: Layout, moved: Float[np.ndarray, "3 V"], a, b, allowed: float):
    """Which pairs of groups have moved against each other by more than is allowed."""
    at = moved.take(layout.corners, axis=1)
    least = at.min(axis=1).reshape(3, -1, _GROUP).min(axis=2)
    most = at.max(axis=1).reshape(3, -1, _GROUP).max(axis=2)
    apart = np.zeros(len(a))
    for low, high in zip(least, most, strict=True):
        np.maximum(apart, high.take(a) - low.take(b), out=apart)
        np.maximum(apart, high.take(b) - low.take(a), out=apart)
    return ~(apart <= allowed)
