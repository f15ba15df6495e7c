"""The winding number just outside every vertex: a ray through each vertex against all triangles.

A ray through vertex p meets p's own triangles at p, and others in front of p and behind it. With
+1 where it enters and -1 where it leaves, let F be the sum in front, B the one behind and O that
of p's own triangles. On a closed mesh F + O + B = 0; the winding number is F just before p and
F + O just after. Where O is +1 or -1 the ray goes through the surface at p, whose outer side has
w_out = min(F, F + O). Where O is 0 the ray only touches the surface there, as on a silhouette:
either both of its sides are outside the cone of p's triangles, and w_out = F, or both are within,
and w_out = F - 1. The part of the cone that is nearest to the ray tells which.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.rays.beam import screen_frame

# The rays lean from the direction that is asked for, by these parts of the screen's axes, and the
# screen is turned about them: what is modelled has its faces and edges along the axes, and a face
# seen exactly edge-on is met or missed by rounding.
_LEAN = (0.1381966011250105, 0.0901699437494742)
_TURN = np.arctan((np.sqrt(5.0) - 1.0) / 2.0)

# For vertices that none of the caller's directions decides.
_SPARE = np.array([[0.48, -0.36, -0.8], [-0.64, 0.6, -0.48]])

# A sheet nearer to the vertex than this part of the mesh's size touches it; as in levels.py.
_THINNEST = 1e-7

# Pairs of a vertex and a triangle that are looked at together; each takes about 100 bytes.
_MOST_PAIRS = 1 << 20


def vertex_winding(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    directions: Float[np.ndarray, "D 3"],
) -> Int[np.ndarray, "V"]:
    """The winding number just outside the mesh's own surface at every vertex, whatever the depth.

    Its sign is the vertex's class: 0 on V_0, +1 on V_out, -1 on V_in. The first direction serves
    all vertices. The next ones, and then two of our own, serve those whose ray met a hole (signs
    that do not cancel) or crosses p's own triangles more than once; what no direction decides is
    0, and so is a vertex that no triangle uses. A sheet that touches p counts as in front of
    it or behind it, whichever brings the number nearer to 0: contact is no overlap.
    """
    winding = np.zeros(len(vertices), np.int64)
    if len(faces) == 0:
        return winding
    vertices = vertices.astype(np.float64, copy=False)
    undecided = np.zeros(len(vertices), bool)
    undecided[faces.ravel()] = True
    with np.errstate(all="ignore"):  # not finite or near overflow: comparisons are false
        for direction in (*directions, *_SPARE):
            frame = _generic_frame(direction)
            sample = np.flatnonzero(undecided)
            own, least, most, is_open = _sums(frame @ vertices.T, faces, sample)
            known = np.flatnonzero(~is_open & (np.abs(own) <= 1))
            sample, own, least, most = sample[known], own[known], least[known], most[known]
            drop = np.minimum(own, 0)
            touched = np.flatnonzero(own == 0)
            drop[touched] -= _within_cone(vertices, faces, sample[touched], -frame[2])
            winding[sample] = np.clip(0, least + drop, most + drop)
            undecided[sample] = False
            if not undecided.any():
                break
    return winding


def _generic_frame(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    u, v, d = screen_frame(direction.astype(np.float64))
    return screen_frame(d + _LEAN[0] * u + _LEAN[1] * v, _TURN)


class _Triangles(NamedTuple):
    """Triangles on the screen; a vertex is named by its place in the order of rows."""

    low: Int[np.ndarray, "F"]
    mid: Int[np.ndarray, "F"]
    high: Int[np.ndarray, "F"]
    faces_ray_with_mid_right: Bool[np.ndarray, "F"]


def _sums(
    screen: Float[np.ndarray, "3 V"], faces: Int[np.ndarray, "F 3"], sample: Int[np.ndarray, "S"]
) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "S"], Int[np.ndarray, "S"], Bool[np.ndarray, "S"]]:
    """For each sampled vertex: O, the least and the greatest F, and whether signs do not cancel.

    A triangle contains p when one of the two of its edges that cross p's row is to the right of
    p. Both triangles of an edge decide that by the same operations on the same numbers, so the
    signs cancel exactly on a closed mesh. Rows are compared by rank: no two vertices share one.
    """
    num = screen.shape[1]
    order = np.argsort(screen[1])
    rank = np.empty(num, np.int64)
    rank[order] = np.arange(num)
    x, y, z = screen[:, order]
    a, b, c = rank[faces.T]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    mid = a + b + c - low - high
    even = (a < b).astype(np.int8) + (b < c) + (c < a) == 2

    # Edges from the lower to the higher end: low-high, low-mid, mid-high.
    start, end = np.concatenate([low, low, mid]), np.concatenate([high, mid, high])
    edge_x, edge_y = x[start], y[start]
    rise = y[end] - edge_y
    slope = (x[end] - edge_x) / np.where(rise > 0, rise, 1.0)

    sampled = np.zeros(num, bool)
    sampled[rank[sample]] = True

    def is_left(vertex, edge):
        return x[vertex] < edge_x[edge] + (y[vertex] - edge_y[edge]) * slope[edge]

    # p's own triangles: of the corners only the middle one can be inside, by the half-open rule.
    left_of_long = is_left(mid, np.arange(len(low)))
    own = np.bincount(mid, np.where(left_of_long, np.where(even, -1, 1), 0), num)
    size = np.ptp(screen, axis=1).max()
    total = own.copy()
    least, most = np.zeros(num), np.zeros(num)
    for vertex, face in _pairs(x, low, mid, high, sampled):
        short = face + len(low) * (1 + (vertex >= mid[face]))
        xl = edge_x[face] + (y[vertex] - edge_y[face]) * slope[face]
        xs = edge_x[short] + (y[vertex] - edge_y[short]) * slope[short]
        px = x[vertex]
        left_of_short = px < xs
        kept = np.flatnonzero((px < xl) != left_of_short)
        vertex, face, short, xl, xs, left_of_short = (
            w[kept] for w in (vertex, face, short, xl, xs, left_of_short)
        )
        sign = np.where(even[face] == left_of_short, 1, -1)
        e0, e1 = low[face], high[face]
        zl = z[e0] + (y[vertex] - y[e0]) * (z[e1] - z[e0]) / (y[e1] - y[e0])
        e0, e1 = start[short], end[short]
        zs = z[e0] + (y[vertex] - y[e0]) * (z[e1] - z[e0]) / (y[e1] - y[e0])
        ahead = zl + (x[vertex] - xl) * (zs - zl) / (xs - xl) - z[vertex]
        total += np.bincount(vertex, sign, num)
        near = np.abs(ahead) < 1e-3 * size
        nf = np.flatnonzero(near)
        tri = face[nf]
        p = np.stack([x, y, z])
        n = np.cross(p[:, mid[tri]] - p[:, low[tri]], p[:, high[tri]] - p[:, low[tri]], axis=0)
        touch = nf[np.abs(ahead[nf] * n[2]) <= _THINNEST * size * np.sqrt((n * n).sum(axis=0))]
        front = ahead < 0
        front[touch] = False
        front = np.bincount(vertex, sign * front, num)
        least += front
        most += front
        if len(touch):
            least += np.bincount(vertex[touch], np.minimum(sign[touch], 0), num)
            most += np.bincount(vertex[touch], np.maximum(sign[touch], 0), num)
    result = np.stack([own, least, most, total])[:, rank[sample]].astype(np.int64)
    return *result[:3], result[3] != 0


def _pairs(x, low, mid, high, sampled):
    num = len(x)
    samples = np.flatnonzero(sampled)
    n = len(samples)
    strips = int(np.sqrt(n)) + 1
    columns = int(6 * np.sqrt(n)) + 1
    xorder = np.argsort(x)
    strip = np.cumsum(sampled) * strips // (n + 1)
    column = np.empty(num, np.int64)
    column[xorder] = np.cumsum(sampled[xorder]) * columns // (n + 1)
    cell = strip[samples] * columns + column[samples]
    by_cell = samples[np.argsort(cell)]
    begins = np.zeros(strips * columns + 1, np.int64)
    np.cumsum(np.bincount(cell, minlength=strips * columns), out=begins[1:])
    first, last = strip[np.minimum(low + 1, num - 1)], strip[high - 1]
    cl, cm, ch = column[low], column[mid], column[high]
    c0, c1 = np.minimum(np.minimum(cl, cm), ch), np.maximum(np.maximum(cl, cm), ch)
    xl, xm, xh = x[low], x[mid], x[high]
    x0, x1 = np.minimum(np.minimum(xl, xm), xh), np.maximum(np.maximum(xl, xm), xh)
    rows = np.where(high - low > 1, last - first + 1, 0)
    of = np.repeat(np.arange(len(low)), rows)
    row = np.arange(len(of)) + (first - (np.cumsum(rows) - rows))[of]
    row *= columns
    begin, end = begins[row + c0[of]], begins[row + c1[of] + 1]
    width = end - begin
    some = np.flatnonzero(width)
    of, begin, width = of[some], begin[some], width[some]
    of_row = np.repeat(np.arange(len(of)), width)
    vertex = by_cell[np.arange(len(of_row)) + (begin - (np.cumsum(width) - width))[of_row]]
    face = of[of_row]
    kept = np.flatnonzero((low[face] < vertex) & (vertex < high[face]))
    vertex, face = vertex[kept], face[kept]
    px = x[vertex]
    kept = np.flatnonzero((x0[face] <= px) & (px < x1[face]) & (mid[face] != vertex))
    yield vertex[kept], face[kept]


def _within_cone(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sample: Int[np.ndarray, "S"],
    ray: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "S"]:
    """Whether a step from the vertex along the unit vector `ray` leads under its own triangles."""
    place = np.full(len(vertices), -1)
    place[sample] = np.arange(len(sample))
    of = place[faces].ravel()
    corner = np.flatnonzero(of >= 0)
    face, k = np.divmod(corner, 3)
    of = of[corner]
    p = vertices[faces[face, k]]
    e, f = (vertices[faces[face, (k + i) % 3]] - p for i in (1, 2))
    e, f = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (e, f))
    n = np.cross(e, f)
    s = np.linalg.norm(n, axis=1)
    n /= s[:, None]
    height = n @ ray
    inside = (np.cross(n, e) @ ray > 0) & (np.cross(f, n) @ ray > 0)
    along_e, along_f = np.maximum(e @ ray, 0), np.maximum(f @ ray, 0)
    nearest = np.where((along_e >= along_f)[:, None], along_e[:, None] * e, along_f[:, None] * f)
    nearest = np.where(inside[:, None], ray - height[:, None] * n, nearest)
    away = ray - nearest
    square = np.einsum("ki,ki->k", away, away)
    least = np.full(len(sample), np.inf)
    np.fmin.at(least, of, square)
    weight = np.where(square < 1, 1.0, np.arctan2(s, np.einsum("ki,ki->k", e, f)))
    side = np.where(square <= least[of] * (1 + 1e-9), weight * np.einsum("ki,ki->k", n, away), 0.0)
    return np.bincount(of, np.where(np.isfinite(side), side, 0.0), len(sample)) < 0
