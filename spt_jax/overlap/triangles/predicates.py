"""Signs of determinants of vertices, exact, with ties decided by simulation of simplicity.

All that the search for intersections asks of coordinates is on which side of a plane through three
vertices a fourth one lies, and the same in two dimensions. Where rounding could change the answer
it is found in whole numbers. Where the answer is exactly zero, the vertices are taken to be moved
by eps times a push of their own, eps being smaller than any number: the determinant is a polynomial
in eps, and the first of its coefficients that is not zero has the sign (Edelsbrunner and Muecke
1990, "Simulation of simplicity", https://doi.org/10.1145/77635.77639; with one eps for all, as in
Yap 1990). So all answers are those of one surface in general position, whatever touches, coincides
or lies in one plane: no edge meets another edge, no vertex lies on a triangle.

The push points into the solid, farther for one part than for the next, so that solids that touch
are moved apart and copies of one solid into each other. That choice only makes contact cheap.
"""

from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, summed
from spt_jax.overlap.triangles.determinants import (
    BOUND,
    LEAST,
    derivative,
    determinant,
    doubled_determinants,
    largest_of,
    permanent,
    units,
    vanishes,
    whole_coefficient,
    whole_determinants,
)

# The same against the sum of the products' sizes.
_RELATIVE = 16 * 2.0**-53

# Heights of both ends below this many times what rounding may add are worked out exactly.
_POOR = 2.0**16

# So many undecided signs are worth a search for those that are asked for again.
_MANY = 2000

# Of the pushes: a step along the normal, and what is added to break ties.
_STEP, _NOISE = 2.0**40, 2.0**28


class Predicates:
    """The signs for one set of vertices.

    Attributes:
        points: the vertices as (3, V), none of whose coordinates is above one.
        scale: what they were multiplied by.

    Args:
        vertices: positions, in any unit.
        faces: the triangles, whose normals the pushes follow.
        part: a number for each vertex, the same for those of one connected part.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        part: Int[np.ndarray, "V"] | None = None,
    ):
        # By a power of two, so that nothing is rounded and products of three lengths stay in range.
        _, exponent = np.frexp(np.abs(vertices).max(initial=0.0))
        self.scale = float(np.ldexp(1.0, -int(exponent)))
        self.points = np.ldexp(vertices.T.astype(np.float64, order="C"), -int(exponent))
        self._faces = faces
        self._part = part

    @cached_property
    def push(self) -> Float[np.ndarray, "3 V"]:
        """How each vertex is moved where a determinant is zero: whole numbers."""
        count = self.points.shape[1]
        rows = np.ascontiguousarray(self.points.T)
        normal = area_normals(rows, self._faces)
        normal = summed(self._faces.ravel(), np.repeat(normal, 3, axis=0), count)
        largest = np.abs(normal).max(axis=1, initial=0.0, keepdims=True)
        normal /= np.where(largest > 0, largest, 1.0)
        length = np.sqrt((normal * normal).sum(axis=1, keepdims=True))
        normal /= np.where(length > 0, length, 1.0)
        depth = np.ones(count)
        if self._part is not None:
            depth += self._part / (1.0 + self._part.max(initial=0))
        return np.rint(-_STEP * (depth[:, None] * normal).T) + np.rint(_NOISE * _noise(count))

    @cached_property
    def _units(self) -> Int[np.ndarray, "V"]:
        return units(self.points)

    @cached_property
    def ranks(self) -> Int[np.ndarray, "3 V"]:
        """The vertices' order along each axis, in which those in one place follow their pushes.

        Vertices of the same push have the same number.
        """
        found = np.empty(self.points.shape, np.int64)
        for place, push, rank in zip(self.points, self.push, found, strict=True):
            order = np.argsort(place)
            higher = np.append(True, np.diff(place[order]) != 0)
            alone = higher & np.append(higher[1:], True)
            # By push only where places are the same: sorting by both takes three times as long.
            tied = np.flatnonzero(~alone)
            some = order[tied]
            order[tied] = some[np.lexsort((push[some], np.cumsum(higher)[tied]))]
            new = higher[1:] | (np.diff(push[order]) != 0)
            rank[order] = np.append(0, np.cumsum(new))[: len(order)]
        return found

    def volume(
        self, base, apex, key=None, if_alike: bool = False
    ) -> tuple[Int[np.ndarray, "*M N"], Float[np.ndarray, "*M N"]]:
        """Signs of tetrahedra's volumes, positive where the apex is on the base's normal's side.

        Args:
            base: (3, N), the vertices of each tetrahedron's base.
            apex: (N), its fourth vertex, different from those; or (M, N), several for each base.
            key: numbers that are the same for the same tetrahedra, where many are asked for again.
            if_alike: whether only those bases are of interest whose signs are all the same; for
                others some sign is +1 and some is -1, and which is which is not told.

        Returns:
            The signs, +1 or -1, and six times the volumes: to rounding, and 0.0 where they vanish.
        """
        origin = self.points.take(base[0], axis=1)
        u, v = (self.points.take(x, axis=1) - origin for x in base[1:])
        w = self.points.take(apex, axis=1)
        w -= origin if apex.ndim == 1 else origin[:, None]
        value = determinant(u, v, w)
        bound = BOUND * (largest_of(u) * largest_of(v) * largest_of(w)) + LEAST
        return self._decided(value, bound, (*base, apex), (0, 1, 2), key, if_alike)

    def turns(self, edge, triangle) -> Int[np.ndarray, "3 N"]:
        """On which side of an edge a triangle's sides pass: signs of the volumes pqab, pqbc, pqca.

        Where they are not all the same, which is which is not told.

        Args:
            edge: (2, N), the vertices p and q.
            triangle: (3, N), the vertices a, b and c, different from those.
        """
        origin = self.points.take(edge[0], axis=1)
        along = self.points.take(edge[1], axis=1) - origin
        arms = self.points.take(triangle, axis=1) - origin[:, None]
        ends = arms[:, [1, 2, 0]]
        size = largest_of(arms)
        value = determinant(along[:, None], arms, ends)
        bound = BOUND * (largest_of(along) * size * size[[1, 2, 0]]) + LEAST
        corners = (*edge, triangle, triangle[[1, 2, 0]])
        return self._decided(value, bound, corners, (0, 1, 2), if_alike=True)[0]

    def area(self, a, b, c, axes: tuple[int, int]) -> Int[np.ndarray, "N"]:
        """Signs of the areas of triangles seen along an axis: +1 counter-clockwise, -1 clockwise.

        Args:
            a, b, c: vertices, three different ones in each triangle.
            axes: the two coordinates that are seen.
        """
        points = self.points[list(axes)]
        origin = points.take(a, axis=1)
        u, v = (points.take(x, axis=1) - origin for x in (b, c))
        value = determinant(u, v)
        bound = BOUND * (largest_of(u) * largest_of(v)) + LEAST
        return self._decided(value, bound, (a, b, c), axes)[0]

    def part_before(self, triangle, edge, height) -> Float[np.ndarray, "N"]:
        """What part of each edge lies before its crossing of a triangle.

        Args:
            triangle: (3, N), corners of a triangle that the edge passes through.
            edge: (2, N), the edge's ends.
            height: (2, N), how far the two are from the plane, times twice the triangle's area.
        """
        (a, b, c), (p, q) = triangle, edge
        origin = self.points.take(a, axis=1)
        largest = [largest_of(self.points.take(x, axis=1) - origin) for x in (b, c, p, q)]
        bound = BOUND * largest[0] * largest[1] * np.maximum(largest[2], largest[3]) + LEAST
        # Both ends almost in the plane: rounding would put the crossing anywhere on the edge.
        poor = np.flatnonzero(height.sum(axis=0) <= _POOR * bound)
        if len(poor):
            corners = [x[poor] for x in (a, b, c)]
            height = height.copy()
            for k, end in enumerate((p, q)):
                rows = [self.points.take(x, axis=1) for x in (*corners, end[poor])]
                height[k, poor] = np.abs(whole_determinants(rows))
        total = height.sum(axis=0)
        part = height[0] / np.where(total > 0, total, 1.0)
        flat = np.flatnonzero(total == 0)
        if len(flat):
            corners = (self.points.take(x[flat], axis=1) for x in (a, b, c, p, q))
            part[flat] = _middle_within(*corners)
        return np.clip(part, 0.0, 1.0)

    def _decided(self, value, bound, corners, axes, key=None, if_alike=False):
        sign = np.where(value < 0, -1, 1)
        undecided = np.abs(value) <= bound
        if if_alike and undecided.any():
            undecided &= ~((value > bound).any(axis=0) & (value < -bound).any(axis=0))
        open_ = np.nonzero(undecided)
        if not len(open_[0]):
            return sign, value
        corners = [np.broadcast_to(x, value.shape)[open_] for x in corners]
        if len(corners[0]) > _MANY and key is not None:
            _, first, at = np.unique(key[open_], return_index=True, return_inverse=True)
            found = self._exactly([x[first] for x in corners], axes)
            sign[open_], value[open_] = (x[at] for x in found)
        else:
            sign[open_], value[open_] = self._exactly(corners, axes)
        return sign, value

    def _exactly(self, corners, axes):
        """Signs and values where the plain determinant is not certain."""
        points = self.points[list(axes)]
        rows = [points.take(x, axis=1) for x in corners]
        edges = [x - rows[0] for x in rows[1:]]
        value, size = determinant(*edges), permanent(*edges)
        known = np.abs(value) > _RELATIVE * size + LEAST
        # Products that are all zero sum to zero exactly, and so they do where two corners coincide.
        small = np.flatnonzero(~known & (size <= LEAST))
        zero = small[vanishes(*(x[:, small] for x in edges))]
        value[zero], known[zero] = 0.0, True
        if not known.all():
            alike = np.zeros(len(value), bool)
            for i in range(1, len(rows)):
                for j in range(1, i):
                    alike |= (rows[i] == rows[j]).all(axis=0)
            value[alike] = 0.0
            known |= alike
        left = np.flatnonzero(~known)
        if len(left):
            unit = np.minimum.reduce([self._units.take(x[left]) for x in corners])
            value[left], known[left] = doubled_determinants([x[:, left] for x in rows], unit)
            left = left[~known[left]]
        if len(left):
            value[left] = whole_determinants([x[:, left] for x in rows])
        sign = np.sign(value).astype(np.int64)
        tied = np.flatnonzero(sign == 0)
        if len(tied):
            rows, corners = ([x[..., tied] for x in of] for of in (rows, corners))
            sign[tied] = self._perturbed(rows, corners, axes)
        return sign, value

    def _perturbed(self, rows, corners, axes):
        """Signs of vanishing determinants once every vertex is moved along its push."""
        push = self.push[list(axes)]
        moves = [push.take(x, axis=1) for x in corners]
        edges, turns = ([x - of[0] for x in of[1:]] for of in (rows, moves))
        value, bound = derivative(edges, turns)
        sign = np.where(np.abs(value) > bound, np.sign(value), 0.0).astype(np.int64)
        for order in range(1, len(edges) + 1):
            open_ = np.flatnonzero(sign == 0)
            if not len(open_):
                break
            at, by = ([x[:, open_] for x in of] for of in (rows, moves))
            sign[open_] = self._coefficient(at, by, order)
        # Pushes that lie in one plane, all of them: one in 1e20.
        return np.where(sign == 0, 1, sign)

    def _coefficient(self, rows, moves, order: int):
        """Signs of the determinants' coefficients of eps^order."""
        edges, turns = ([x - of[0] for x in of[1:]] for of in (rows, moves))
        among = [
            [turns[k] if moved >> k & 1 else edges[k] for k in range(len(edges))]
            for moved in range(1, 1 << len(edges))
            if moved.bit_count() == order
        ]
        # All terms together, (3, terms, N).
        factors = [np.stack(column, axis=1) for column in zip(*among, strict=True)]
        value = determinant(*factors).sum(axis=0)
        size = permanent(*factors).sum(axis=0)
        left = np.flatnonzero(np.abs(value) <= 2 * _RELATIVE * size + LEAST)
        if len(left):
            zero = vanishes(*(x[:, :, left] for x in factors)).all(axis=0)
            value[left[zero]] = 0.0
            left = left[~zero]
        if len(left):
            at, by = ([x[:, left] for x in of] for of in (rows, moves))
            value[left] = whole_coefficient(at, by, order)
        return np.sign(value).astype(np.int64)


def _noise(count: int) -> Float[np.ndarray, "3 V"]:
    """Numbers from -1 to 1 that follow from their place alone, all different (SplitMix64)."""
    with np.errstate(over="ignore"):
        x = np.arange(1, 3 * count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x ^= x >> np.uint64(31)
    return (x >> np.uint64(11)).reshape(3, count) * 2.0**-52 - 1.0


def _middle_within(a, b, c, p, q):
    """Of edges that lie in their triangles' planes: the middle of what is within the triangle.

    The edge and the triangle share all of that, and where the one is said to pass through the
    other changes no volume.
    """
    normal = np.abs(np.cross(b - a, c - a, axis=0))
    # Of triangles without an area, any plane in which they and the edge are seen.
    slim = np.flatnonzero(normal.max(axis=0, initial=0.0) == 0)
    longest = np.stack([b - a, c - a, c - b])
    longest = np.take_along_axis(longest, np.abs(longest).sum(axis=1).argmax(axis=0)[None, None], 0)
    normal[:, slim] = np.abs(np.cross(longest[0], q - p, axis=0))[:, slim]
    drop = normal.argmax(axis=0)
    seen = np.stack([(drop + 1) % 3, (drop + 2) % 3])
    a, b, c, p, q = (np.take_along_axis(x, seen, 0) for x in (a, b, c, p, q))
    turn = np.sign(determinant(b - a, c - a))
    low, high = np.zeros(p.shape[1]), np.ones(p.shape[1])
    with np.errstate(all="ignore"):
        for start, end in ((a, b), (b, c), (c, a)):
            at_p = turn * determinant(end - start, p - start)
            at_q = turn * determinant(end - start, q - start)
            crossing = np.clip(at_p / (at_p - at_q), 0.0, 1.0)
            low = np.where((at_p < 0) & (at_q > 0), np.maximum(low, crossing), low)
            high = np.where((at_p > 0) & (at_q < 0), np.minimum(high, crossing), high)
        # A line instead of a triangle: where the edge meets it, or what they share of one line.
        along = q - p
        square = (along * along).sum(axis=0)
        across = [determinant(along, x - p) for x in (a, b, c)]
        at = [((x - p) * along).sum(axis=0) / square for x in (a, b, c)]
        least, most = np.argmin(across, axis=0)[None], np.argmax(across, axis=0)[None]
        span = np.ptp(across, axis=0)
        weight = np.take_along_axis(np.stack(across), most, 0)[0] / span
        meeting = weight * np.take_along_axis(np.stack(at), least, 0)[0]
        meeting += (1 - weight) * np.take_along_axis(np.stack(at), most, 0)[0]
        shared = np.clip([np.min(at, axis=0), np.max(at, axis=0)], 0.0, 1.0).mean(axis=0)
        line = np.where(span > 0, np.clip(meeting, 0.0, 1.0), shared)
    middle = np.where(turn != 0, (low + high) / 2, line)
    return np.where(np.isfinite(middle), middle, 0.5)
