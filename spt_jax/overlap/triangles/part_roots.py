"""The winding number at one place of each connected part, from which `winding.py` walks on.

Each part has a root, its vertex farthest along x. No triangle of the part lies beyond, so the
winding number is 0 there, or -1 where the part is inside out, as the edges there show; and every
other solid in which it lies adds one, as a ray along x shows, which meets only other parts.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from spt_jax.overlap.arrays.ranges import spread
from spt_jax.overlap.triangles.manifold import Manifold
from spt_jax.overlap.triangles.pair_layout import Topology
from spt_jax.overlap.triangles.predicates import Predicates

# Pairs of a ray and a triangle that are worked on together.
_AT_ONCE = 1 << 20
# For so few rays triangles are not sorted.
_FEW_RAYS = 16


@dataclass(frozen=True)
class Root:
    """The end of an edge in each part, where nothing of the part lies beyond along x."""

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
    root = Root(row, end)
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
