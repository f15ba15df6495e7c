"""Triangles around one vertex: whether they lie side by side, and where they may not."""

import numpy as np
from jaxtyping import Int, UInt8

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.arrays.pieces import parts
from spt_jax.overlap.arrays.ranges import spread
from spt_jax.overlap.triangles.box_words import Shape
from spt_jax.overlap.triangles.determinants import BOUND, LEAST, largest_of
from spt_jax.overlap.triangles.pair_layout import Layout, Topology
from spt_jax.overlap.triangles.pair_planes import ROUNDING


def around_vertices(points, topology: Topology, layout: Layout, vertex: Int[np.ndarray, "U"]):
    """Candidates (row, slot) whose triangles share the one vertex that is not on the edge.

    Args:
        points: all vertices.
        topology, layout: of the mesh.
        vertex: the vertices around which to look.
    """
    corner, at = spread(topology.fan_start[vertex], np.diff(topology.fan_start)[vertex])
    corner, vertex = topology.fan[corner], vertex[at]
    row = topology.opposite.ravel()[corner]
    kept = np.flatnonzero(row >= 0)
    row, vertex = row[kept], vertex[kept]
    first, count = topology.fan_start[vertex], np.diff(topology.fan_start)[vertex]
    for part in parts(count):
        other, at = spread(first[part], count[part])
        edge, face = row[part][at], topology.fan[other] // 3
        kept = np.flatnonzero(_apart(topology, edge, face))
        edge, slot = edge[kept], layout.slot[face[kept]]
        kept = np.flatnonzero(_straddles(points, topology.ends[edge].T, layout, slot))
        yield edge[kept], slot[kept]


def _straddles(points, ends, layout: Layout, slot):
    """Whether edges have ends on both sides of the planes of triangles, or may."""
    a, b, c = (points.take(corner, axis=1) for corner in layout.corners.take(slot, axis=1))
    u, v = b - a, c - a
    normal, size = cross(u, v), largest_of(u) * largest_of(v)
    sides = []
    for end in ends:
        arm = points.take(end, axis=1) - a
        height = normal[0] * arm[0] + normal[1] * arm[1] + normal[2] * arm[2]
        margin = BOUND * size * largest_of(arm) + LEAST
        sides.append((height <= margin, height >= -margin))
    (below, above), (other_below, other_above) = sides
    return (below | other_below) & (above | other_above)


def _apart(topology: Topology, row, face):
    ends, corner = topology.ends[row], topology.faces[face]
    return (ends[:, :, None] != corner[:, None, :]).all(axis=(1, 2))


def facing(topology: Topology, layout: Layout, shape: Shape):
    """Vertices around which triangles are shown to lie side by side, and how far they may turn.

    Let the triangles around a vertex all face a direction d with d_k = 0. Seen along d they turn
    around the vertex in one sense, once for every two of them that lie across the plane of
    constant x_k: once in all exactly if the vertex is the median of x_k in two of its triangles.
    Then they do not overlap. Ties of x_k are broken by vertex number, as if moved by nothing.

    While they move and all still face d, they turn around the vertex as often as before.

    Returns:
        (V), whether the vertex is such a one; (3, S), for each corner d times the normal of its
        triangle, which is as long as twice the area; (V), the length of d.
    """
    # All three components at once: the sparse product is read once.
    d = np.ascontiguousarray((layout.at_vertices @ np.ascontiguousarray(shape.normal.T)).T)
    x, y, z = np.abs(d)
    # argmin along a short axis takes four times as long.
    axis = np.where((x <= y) & (x <= z), 0, np.where(y <= z, 1, 2))
    d[axis, np.arange(len(axis))] = 0.0
    length = np.abs(d).sum(axis=0)
    d /= np.where(length > 0, length, 1.0)
    at = d.take(layout.corners, axis=1)
    faces = at[0] * shape.normal[0]
    faces += at[1] * shape.normal[1]
    faces += at[2] * shape.normal[2]
    away = faces <= ROUNDING * shape.extent * shape.extent
    away[:, layout.empty] = False
    sure = topology.closed & (_medians(shape, layout, axis.astype(np.uint8)) == 2)
    sure[layout.corners[away]] = False
    return sure, faces, np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)


def _medians(shape: Shape, layout: Layout, axis: UInt8[np.ndarray, "V"]) -> Int[np.ndarray, "V"]:
    """In how many of its triangles each vertex is the median, along the axis that it names."""
    # The number of the median corner along x, y and z, two bits each: bytes take an eighth of what
    # whole numbers would.
    medians = np.zeros(shape.corner.shape[2], np.uint8)
    for k, x in enumerate(shape.corner):
        # Corners are sorted by number, so this is what breaks ties.
        first, second, third = x[0] <= x[1], x[1] <= x[2], x[2] < x[0]
        middle = first == second
        last = (second == third) & ~middle
        medians |= (middle.view(np.uint8) | last.view(np.uint8) << 1) << (2 * k)
    corner = (medians >> 2 * axis.take(layout.corners_32)) & 3
    found = corner == np.arange(3, dtype=np.uint8)[:, None]
    found[:, layout.empty] = False
    return np.bincount(layout.corners.ravel().take(np.flatnonzero(found)), minlength=len(axis))
