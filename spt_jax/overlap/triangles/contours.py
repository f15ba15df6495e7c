"""The intersection contours: segments along which pairs of triangles intersect.

Two triangles of a closed surface in general position that intersect do so along one segment, each
end of which is where an edge of one passes through the other:

        both ends on one triangle's edges          one end on each one's edges

               ___________                                ____________
              /     |    /                               /    |      /|
             /   s==|=e /   the other one's two         /     |  s==/=|==e
            /_______|__/    edges pass through it      /______|____/  |

Where they share a vertex the segment starts there and has one such end (`cusp`).

The segment runs along the first triangle's normal times the second's. Along its own edges,
counter-clockwise, the first triangle enters the second's solid at the segment's end and leaves it
at the segment's start; the second triangle the other way about. So on the first triangle the part
that lies inside the second's solid is on the left of the segment, seen from outside, and on the
second triangle the part inside the first's solid is on the right of it. `closed_form.py` and
`winding.py` rest on this.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, cross, dot
from spt_jax.overlap.triangles.pair_layout import Topology
from spt_jax.overlap.triangles.pairs import EdgeIntersections


@dataclass(frozen=True)
class Contours:
    """A segment for every pair of triangles that intersect.

    It runs along the first triangle's normal times the second's. Each of its ends is where an edge
    of one triangle passes through the other, or a vertex that the two share.

    Attributes:
        pair: the two triangles, the lower first.
        end: (P, 2), the start and the end as rows of the intersections; -1: the shared vertex.
        owner: which of the two triangles has the edge that passes there.
        half: that edge as a half-edge of the triangle.
        cusp: the vertex that the two share; -1: none.
        point: (P, 2, 3), the places.
        whole: whether both ends were found; of a closed surface always.
    """

    pair: Int[np.ndarray, "P 2"]
    end: Int[np.ndarray, "P 2"]
    owner: Int[np.ndarray, "P 2"]
    half: Int[np.ndarray, "P 2"]
    cusp: Int[np.ndarray, "P"]
    point: Float[np.ndarray, "P 2 3"]
    whole: Bool[np.ndarray, "P"]

    @property
    def length(self) -> Float[np.ndarray, "P"]:
        """Of each segment."""
        return np.linalg.norm(self.point[:, 1] - self.point[:, 0], axis=1)

    def only(self, kept: Bool[np.ndarray, "P"]) -> "Contours":
        """Some of the segments."""
        return replace(self, **{name: value[kept] for name, value in vars(self).items()})

    def proper(
        self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], reach: float
    ) -> Bool[np.ndarray, "P"]:
        """Pairs that intersect, and do not only touch.

        Each triangle has corners on both sides of the other's plane, farther away than `reach`,
        and the segment is longer than that.
        """
        proper = self.length > reach
        for own, other in ((0, 1), (1, 0)):
            corners = faces[self.pair[:, other]]
            normal = area_normals(vertices, corners)
            size = np.sqrt(dot(normal, normal))
            arm = vertices[faces[self.pair[:, own]]] - vertices[corners[:, :1]]
            height = np.einsum("pci,pi->pc", arm, normal)
            proper &= (height.min(axis=1) < -reach * size) & (height.max(axis=1) > reach * size)
        return proper


def find_contours(
    vertices: Float[np.ndarray, "V 3"], topology: Topology, intersections: EdgeIntersections
) -> Contours:
    """The segment of every pair of triangles that intersect."""
    faces, count = topology.faces, len(topology.faces)
    number = np.tile(np.arange(len(intersections.face)), 2)
    half = topology.halves[intersections.row].T.ravel()
    kept = np.flatnonzero(half >= 0)
    number, half = number[kept], half[kept]
    own, other = half // 3, intersections.face[number]
    first = own < other
    # Along its own edges, counter-clockwise, each triangle enters the other's solid once and leaves
    # it once. The segment runs from where the first triangle leaves to where it enters, and for
    # the second the other way about: on the left of it is the first one's part inside the second.
    enters = intersections.jump[number] * senses(topology, half) > 0
    last = enters == first
    key = np.where(first, own * count + other, other * count + own)
    pairs, at = np.unique(key, return_inverse=True)
    pair = np.stack(np.divmod(pairs, max(count, 1)), axis=1)

    end = np.full((len(pair), 2), -1)
    owner, halves = np.zeros((2, len(pair), 2), np.int64)
    slot = last.astype(np.int64)
    found = np.bincount(2 * at + slot, minlength=2 * len(pair)).reshape(-1, 2)
    end[at, slot], owner[at, slot], halves[at, slot] = number, np.where(first, 0, 1), half
    cusp = np.full(len(pair), -1)
    row, vertex = shared_corners(faces, pair)
    cusp[row] = vertex
    common = np.bincount(row, minlength=len(pair))
    point = intersections.point[end] if len(intersections.face) else np.zeros((len(pair), 2, 3))
    missing = end < 0
    point[missing] = vertices[np.repeat(cusp[:, None], 2, axis=1)[missing]]
    whole = (found <= 1).all(axis=1) & (found.sum(axis=1) + common == 2)
    return Contours(pair, end, owner, halves, cusp, point, whole)


def senses(topology: Topology, half: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """+1 where a half-edge runs from the lower to the higher vertex of its edge, else -1."""
    face, corner = np.divmod(half, 3)
    start = topology.faces[face, (corner + 1) % 3]
    return np.where(start == topology.ends[topology.row[half], 0], 1, -1)


def shared_corners(
    faces: Int[np.ndarray, "F 3"], pairs: Int[np.ndarray, "P 2"]
) -> tuple[Int[np.ndarray, "C"], Int[np.ndarray, "C"]]:
    """Pairs whose two triangles share a vertex, as rows of `pairs`, and that vertex."""
    first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
    row, corner = np.nonzero((first[:, :, None] == second[:, None, :]).any(axis=2))
    return row, first[row, corner]


def length_gradient(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intersections: EdgeIntersections,
    contours: Contours,
    weight: Float[np.ndarray, "P"],
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """The derivative of the weighted sum of the segments' lengths: vertices, and force on each.

    Its ends pass their forces on by `force_on_intersections`; a vertex that the two triangles share
    takes its own.
    """
    along = contours.point[:, 1] - contours.point[:, 0]
    length = np.sqrt(dot(along, along))
    along = along * (weight / np.where(length > 0, length, 1.0))[:, None]
    force = np.stack([-along, along], axis=1).reshape(-1, 3)
    end, cusp = contours.end.ravel(), np.repeat(contours.cusp, 2)
    at_cusp = np.flatnonzero((end < 0) & (cusp >= 0))
    passing = np.flatnonzero(end >= 0)
    through = intersections.only(end[passing])
    at, rows = force_on_intersections(vertices, faces, through, force[passing])
    return np.concatenate([cusp[at_cusp], at]), np.concatenate([force[at_cusp], rows])


def force_on_intersections(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intersections: EdgeIntersections,
    force: Float[np.ndarray, "K 3"],
) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Forces on places where edges pass through triangles, as vertices and the force on each.

    Where edge pq passes through a triangle with the normal n, the place is p + t (q - p) =
    alpha a + beta b + gamma c. A force f on it acts on the edge as f - h and on the triangle as h,
    h = n f.(q - p) / n.(q - p), in these shares.
    """
    p, q = intersections.edge.T
    corners = faces[intersections.face]
    edge = vertices[q] - vertices[p]
    normal = area_normals(vertices, corners)
    through = dot(normal, edge)
    h = normal * (dot(force, edge) / np.where(through != 0, through, np.inf))[:, None]
    part = intersections.part[:, None]
    shares = barycentric(vertices[corners], intersections.point)
    rows = [(1 - part) * (force - h), part * (force - h)]
    rows += [shares[:, c, None] * h for c in range(3)]
    return np.concatenate([p, q, *corners.T]), np.concatenate(rows)


def barycentric(
    corners: Float[np.ndarray, "K 3 3"], points: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "K 3"]:
    """Of points on triangles, none below zero."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = cross(b - a, c - a)
    square = np.maximum(dot(normal, normal), np.finfo(float).tiny)
    u = dot(normal, cross(points - a, c - a)) / square
    v = dot(normal, cross(b - a, points - a)) / square
    weights = np.clip(np.stack([1.0 - u - v, u, v], axis=1), 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)
