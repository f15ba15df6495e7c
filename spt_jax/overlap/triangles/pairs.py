"""Which edges of a mesh pass through which of its triangles: every place where it cuts itself.

Triangles around one vertex do not intersect each other if, seen along some direction, they lie side
by side. That holds nearly everywhere and is proved for all vertices at once; only where the proof
fails are these pairs examined. Pairs that share no vertex are found by boxes: of clusters of
neighbors, then of the triangles in them. The remaining pairs are decided by the signs of volumes,
which are exact (`predicates.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.pieces import concatenate
from spt_jax.overlap.arrays.ranges import unique
from spt_jax.overlap.triangles.contacts import Contacts
from spt_jax.overlap.triangles.near_triangles import NearTriangles
from spt_jax.overlap.triangles.pair_layout import Layout, Topology, prepared
from spt_jax.overlap.triangles.predicates import Predicates


@dataclass(frozen=True)
class EdgeIntersections:
    """Edges that pass through triangles, sorted by edge and then by triangle.

    Attributes:
        edge: vertices of the edge, the lower first.
        edge_faces: the two triangles of the edge; -1 where it has one only. An edge of more than
            two triangles is listed once for every two of them.
        row: of the edge, in the mesh's topology.
        face: the triangle that the edge passes through.
        part: of the edge's length, from the lower vertex, where it does.
        point: the place itself.
        jump: by how much the winding number rises along the edge: +1 where it enters, -1 where it
            leaves the solid that the triangle bounds.
    """

    edge: Int[np.ndarray, "K 2"]
    edge_faces: Int[np.ndarray, "K 2"]
    row: Int[np.ndarray, "K"]
    face: Int[np.ndarray, "K"]
    part: Float[np.ndarray, "K"]
    point: Float[np.ndarray, "K 3"]
    jump: Int[np.ndarray, "K"]

    def only(self, kept: Bool[np.ndarray, "K"] | Int[np.ndarray, "N"]) -> "EdgeIntersections":
        """Some of the intersections, given by a mask or by number."""
        return replace(self, **{name: value[kept] for name, value in vars(self).items()})


def edge_intersections(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    among: Bool[np.ndarray, "F"] | None = None,
) -> EdgeIntersections:
    """Every edge that passes through a triangle with which it shares no vertex.

    Edge pq passes through triangle abc where the tetrahedra pabc and qabc have opposite signed
    volumes and pqab, pqbc and pqca have one sign. The signs are exact, and those of volumes that
    are exactly zero are decided as `predicates.py` says: the intersections are those of a surface
    in general position, which differs from the one given by less than any number. So two triangles
    always intersect along a segment that has two ends; `Contours.proper` is False where they only
    touch.

    Args:
        vertices: positions, in any unit.
        faces: indices of each triangle's corners. Any triangles will do: open, closed, several
            to an edge, repeated. What follows from them alone is kept for the next call, for the
            last few meshes; how fast a call is, but not what it returns, depends on the shapes
            in which the mesh has been seen.
        among: faces of interest: only intersections of an edge that belongs to one of them, or that
            pass through one of them, are returned.

    Returns:
        The intersections, sorted; none where any vertex is not finite, or all are one point.

    Raises:
        IndexError: a face does not index into the vertices.
        Entangled: more pairs of triangles are near each other than 2,000,000 and 20 to a triangle.

    Example:
        >>> import numpy as np
        >>> from spt_jax.overlap.triangles.pairs import edge_intersections
        >>> flat = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> upright = [[1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
        >>> found = edge_intersections(np.array(flat + upright), np.array([[0, 1, 2], [3, 4, 5]]))
        >>> print(found.edge.tolist(), found.face, found.point.tolist())
        [[3, 4], [3, 5]] [0 0] [[1.0, 1.0, 0.0], [1.5, 1.0, 0.0]]
    """
    return find_intersections(vertices, faces, among=among)[0]


def find_intersections(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    among: Bool[np.ndarray, "F"] | None = None,
    predicates: Predicates | None = None,
    reach: float = 0.0,
) -> tuple[EdgeIntersections, Callable[[], Contacts]]:
    """`edge_intersections`, and a function that finds the vertices that lie on other triangles.

    Args:
        vertices, faces, among: as there.
        predicates: the signs, where they are needed for more.
        reach: how near to a triangle a vertex lies on it, against the largest coordinate.
    """
    nothing = np.zeros(0, np.int64)
    if len(faces) == 0 or not np.isfinite(vertices).all():
        pairs, places = np.zeros((0, 2), np.int64), np.zeros((0, 3))
        none = EdgeIntersections(pairs, pairs, nothing, nothing, np.zeros(0), places, nothing)
        return none, lambda: Contacts(nothing, nothing)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise IndexError(
            f"faces must index into vertices: got indices {faces.min()} to {faces.max()} for "
            f"{len(vertices)} vertices; indices are 0-based."
        )
    if predicates is None:
        predicates = Predicates(vertices, faces)
    points = predicates.points
    if not np.ptp(points, axis=1).any():
        return find_intersections(vertices, faces[:0])
    mesh = prepared(faces, len(vertices))
    topology = mesh.topology
    touching = None if among is None else _touching(topology, among)
    near = NearTriangles(mesh, predicates, reach, touching)
    layout = near.layout
    found = list(near.around_vertices())
    found += [_edges_of_pairs(topology, layout, t, u) for t, u in near.straddling()]
    row, slot = concatenate(found) if found else (nothing, nothing)
    if among is not None:
        kept = _edges_of(topology, among)[topology.edge_id[row]] | among[layout.face[slot]]
        row, slot = row[kept], slot[kept]
    row, slot, part, jump = decided(predicates, topology, layout, row, slot)
    face = layout.face[slot]
    order = np.lexsort((face, row))
    row, face, part, jump = row[order], face[order], part[order], jump[order]
    ends = topology.ends[row]
    p, q = np.float64(vertices[ends[:, 0]]), np.float64(vertices[ends[:, 1]])
    point = p + part[:, None] * (q - p)
    found = EdgeIntersections(ends, topology.edge_faces[row], row, face, part, point, jump)
    return found, lambda: near.contacts


def face_pairs(intersections: EdgeIntersections) -> Int[np.ndarray, "P 2"]:
    """Unique pairs of triangles (the lower first) that intersect along some segment.

    Args:
        intersections: what `edge_intersections` found.

    Returns:
        The triangles of each edge, where it has them, with the triangle that it passes through.

    Example:
        >>> import numpy as np
        >>> from spt_jax.overlap.triangles.pairs import edge_intersections, face_pairs
        >>> flat = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
        >>> upright = [[1.0, 1.0, -1.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]]
        >>> found = edge_intersections(np.array(flat + upright), np.array([[0, 1, 2], [3, 4, 5]]))
        >>> print(face_pairs(found))
        [[0 1]]
    """
    of_edge = intersections.edge_faces.ravel()
    through = np.repeat(intersections.face, 2)
    kept = of_edge >= 0
    of_edge, through = of_edge[kept], through[kept]
    low, high = np.minimum(of_edge, through), np.maximum(of_edge, through)
    # As single numbers they sort ten times as fast as by rows.
    count = int(high.max(initial=-1)) + 1
    return np.stack(np.divmod(unique(low * count + high), max(count, 1)), axis=1)


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


def _edges_of_pairs(topology: Topology, layout: Layout, t, u):
    """Candidates (row, slot) of pairs of triangles."""
    row = topology.opposite.take(layout.face[np.concatenate([t, u])], axis=0).ravel()
    slot = np.repeat(np.concatenate([u, t]), 3)
    kept = np.flatnonzero(row >= 0)
    return row[kept], slot[kept]


def decided(predicates: Predicates, topology: Topology, layout: Layout, row, slot):
    """The candidates that cross, what part of the edge lies before the crossing, and the jump."""
    corners, ends = layout.corners.take(slot, axis=1), topology.ends.take(row, axis=0).T
    side, height = predicates.volume(corners, ends)
    kept = np.flatnonzero(side[0] != side[1])
    row, slot, side, height = row[kept], slot[kept], side[0, kept], height[:, kept]
    corners, ends = corners[:, kept], ends[:, kept]
    # The edge passes on one side of all three of the triangle's.
    kept = np.flatnonzero(np.abs(predicates.turns(ends, corners).sum(axis=0)) == 3)
    part = predicates.part_before(corners[:, kept], ends[:, kept], np.abs(height[:, kept]))
    jump = side[kept] * layout.sense[slot[kept]].astype(np.int64)
    return row[kept], slot[kept], part, jump
