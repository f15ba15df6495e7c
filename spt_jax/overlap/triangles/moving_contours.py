"""How the intersection contours move with the vertices, and what that does to sums over triangles.

Where edge pq passes through triangle abc, with e = q - p, normal n and x = p + t e = alpha a +
beta b + gamma c, let v_e and v_n be the velocities of the edge's point and of the triangle's point
at x. Then t' = n.(v_n - v_e) / n.e and x' = v_e + t' e, and x' - v_n, which lies in the triangle's
plane, says how the barycentric coordinates change.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, cross, dot, summed
from spt_jax.overlap.triangles.contours import Contours, barycentric, senses
from spt_jax.overlap.triangles.pair_layout import Topology
from spt_jax.overlap.triangles.pairs import EdgeIntersections

_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # (u, v) of a triangle's corners


@dataclass(frozen=True)
class Rates:
    """Velocities of the part of the edge, the place and the barycentric weights."""

    part: Float[np.ndarray, "K"]
    point: Float[np.ndarray, "K 3"]
    shares: Float[np.ndarray, "K 3"]


class MovingIntersections:
    """Edges that pass through triangles, as functions of the vertices.

    Args:
        vertices: positions.
        faces: of the mesh.
        intersections: the edges and the triangles.
        parallel: an edge whose angle with the triangle's plane has a sine below this is parallel to
            it but for rounding: where it passes has no derivative, and is held.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        intersections: EdgeIntersections,
        parallel: float,
    ):
        self.intersections, self.corners = intersections, faces[intersections.face]
        self.start, self.end = intersections.edge.T
        self.edge = vertices[self.end] - vertices[self.start]
        triangles = vertices[self.corners]
        a, b, c = triangles.transpose(1, 0, 2)
        self.ab, self.ac = b - a, c - a
        self.normal = area_normals(vertices, self.corners)
        self.part, self.point = intersections.part, intersections.point
        self.shares = barycentric(triangles, intersections.point)
        square = dot(self.normal, self.normal)
        through = dot(self.normal, self.edge)
        size = np.sqrt(square * dot(self.edge, self.edge))
        # Infinite where there is nothing to divide by: what is divided is then zero.
        self.through = np.where(np.abs(through) > parallel * size, through, np.inf)
        inverse = 1.0 / np.maximum(square, np.finfo(float).tiny)[:, None]
        self._across = cross(self.ac, self.normal) * inverse, cross(self.normal, self.ab) * inverse

    def rates(self, velocity: Float[np.ndarray, "V 3"]) -> Rates:
        """How fast everything moves when the vertices do."""
        t = self.part[:, None]
        along = (1 - t) * velocity[self.start] + t * velocity[self.end]
        carried = np.einsum("kc,kci->ki", self.shares, velocity[self.corners])
        part = dot(self.normal, carried - along) / self.through
        point = along + part[:, None] * self.edge
        slides = np.where(np.isfinite(self.through)[:, None], point - carried, 0.0)
        u, v = dot(slides, self._across[0]), dot(slides, self._across[1])
        return Rates(part, point, np.stack([-u - v, u, v], axis=1))

    def normal_rates(self, velocity: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "K 3"]:
        """How the triangles' area normals change."""
        a, b, c = velocity[self.corners].transpose(1, 0, 2)
        return cross(b - a, self.ac) + cross(self.ab, c - a)


class MovingContours:
    """The segments of contours in the barycentric coordinates of both of their triangles.

    Args:
        vertices: positions.
        topology: of the mesh.
        intersections: those that the contours' ends are rows of.
        contours: the segments.
        parallel: as in `MovingIntersections`.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        topology: Topology,
        intersections: EdgeIntersections,
        contours: Contours,
        parallel: float,
    ):
        self.faces, self.contours = topology.faces, contours
        self.moving = MovingIntersections(vertices, self.faces, intersections, parallel)
        self._segment, self._end = np.nonzero(contours.end >= 0)
        self._number = contours.end[self._segment, self._end]
        self._owner = contours.owner[self._segment, self._end]
        half = contours.half[self._segment, self._end]
        self._sense = senses(topology, half)
        self._from = _CORNERS[(half % 3 + 1) % 3]
        self._side = _CORNERS[(half % 3 + 2) % 3] - self._from
        part = self.moving.part[self._number]
        part = np.where(self._sense > 0, part, 1 - part)
        sides = self._from + part[:, None] * self._side
        self._places = self._assembled(sides, self.moving.shares[self._number, 1:])
        segment, end = np.nonzero((contours.end < 0) & (contours.cusp >= 0)[:, None])
        for k in range(2):
            corners = self.faces[contours.pair[segment, k]]
            at = np.argmax(corners == contours.cusp[segment, None], axis=1)
            self._places[k, segment, end] = _CORNERS[at]
        along = contours.point[:, 1] - contours.point[:, 0]
        self.length = np.sqrt(dot(along, along))
        self.along = along / np.where(self.length > 0, self.length, np.inf)[:, None]

    def _assembled(self, on_sides, within) -> Float[np.ndarray, "2 P 2 2"]:
        """What is known on the edges' own triangles and on those that they pass through."""
        values = np.zeros((2, len(self.contours.pair), 2, 2))
        values[self._owner, self._segment, self._end] = on_sides
        values[1 - self._owner, self._segment, self._end] = within
        return values

    def share_rates(
        self, rates: Rates, row: Int[np.ndarray, "F"], count: int, times=None
    ) -> Float[np.ndarray, "H 3"]:
        """How the integrals of w_out lambda over the triangles change, by triangle and corner.

        What w jumps by across a segment, times the integral over it of lambda times how fast it
        moves across itself: quadratic, so that Simpson's rule is exact.

        Args:
            rates: of the intersections.
            row: of each face of the mesh, in what is returned.
            count: how many rows that has.
            times: how often each triangle is there.
        """
        sides = (self._sense * rates.part[self._number])[:, None] * self._side
        moves = self._assembled(sides, rates.shares[self._number, 1:]).reshape(-1, 2, 2)
        places = self._places.reshape(-1, 2, 2)
        middle = (places[:, :1] + places[:, 1:]) / 2, (moves[:, :1] + moves[:, 1:]) / 2
        u, v = np.concatenate([places[:, :1], middle[0], places[:, 1:]], axis=1).transpose(2, 0, 1)
        x, y = np.concatenate([moves[:, :1], middle[1], moves[:, 1:]], axis=1).transpose(2, 0, 1)
        step = places[:, 1] - places[:, 0]
        swept = step[:, :1] * y - step[:, 1:] * x
        swept *= np.array([1 / 6, 4 / 6, 1 / 6])
        found = -np.stack([((1 - u - v) * swept), u * swept, v * swept], axis=2).sum(axis=1)
        pair = self.contours.pair
        found[len(pair) :] *= -1.0
        if times is not None:
            found *= times[pair[:, ::-1].T.ravel(), None]
        return summed(row[pair.T.ravel()], found, count)

    def end_velocities(
        self, rates: Rates, velocity: Float[np.ndarray, "V 3"]
    ) -> Float[np.ndarray, "P 2 3"]:
        """How fast the segments' ends move; an end may be a vertex that two triangles share."""
        moves = np.zeros((len(self.contours.pair), 2, 3))
        moves[self._segment, self._end] = rates.point[self._number]
        segment, end = np.nonzero((self.contours.end < 0) & (self.contours.cusp >= 0)[:, None])
        moves[segment, end] = velocity[self.contours.cusp[segment]]
        return moves

    def length_curvature(
        self,
        velocity: Float[np.ndarray, "V 3"],
        rates: Rates,
        weight: Float[np.ndarray, "P"],
        change: Float[np.ndarray, "P"],
        count: int,
    ) -> Float[np.ndarray, "V 3"]:
        """How the derivative of the weighted sum of lengths (`length_gradient`) changes.

        Args:
            velocity: of the vertices.
            rates: of the intersections, at that velocity.
            weight, change: of each segment, and how fast that changes.
            count: of the vertices.
        """
        moves = self.end_velocities(rates, velocity)
        slides = moves[:, 1] - moves[:, 0]
        across = slides - self.along * dot(self.along, slides)[:, None]
        turns = across / np.where(self.length > 0, self.length, np.inf)[:, None]
        force = self.along * weight[:, None]
        pull = turns * weight[:, None] + self.along * change[:, None]
        force = np.stack([-force, force], axis=1)
        pull = np.stack([-pull, pull], axis=1)
        segment, end = np.nonzero((self.contours.end < 0) & (self.contours.cusp >= 0)[:, None])
        at, rows = [self.contours.cusp[segment]], [pull[segment, end]]

        m, k = self.moving, self._number
        f, df = force[self._segment, self._end], pull[self._segment, self._end]
        normal, d_normal = m.normal[k], m.normal_rates(velocity)[k]
        edge, d_edge = m.edge[k], velocity[m.end[k]] - velocity[m.start[k]]
        through = m.through[k]
        d_through = dot(d_normal, edge) + dot(normal, d_edge)
        ratio = dot(f, edge) / through
        d_ratio = (dot(df, edge) + dot(f, d_edge) - ratio * d_through) / through
        h = normal * ratio[:, None]
        dh = d_normal * ratio[:, None] + normal * d_ratio[:, None]
        t, dt = m.part[k][:, None], rates.part[k][:, None]
        shares, d_shares = m.shares[k], rates.shares[k]
        at += [m.start[k], m.end[k], *m.corners[k].T]
        rows += [(1 - t) * (df - dh) - dt * (f - h), t * (df - dh) + dt * (f - h)]
        rows += [shares[:, c, None] * dh + d_shares[:, c, None] * h for c in range(3)]
        return summed(np.concatenate(at), np.concatenate(rows), count)
