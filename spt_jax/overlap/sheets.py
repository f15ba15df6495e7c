"""An open sheet beside closed solids: how much of it lies inside of them, and how deep.

A sheet has no inside, so it overlaps nothing. But w, the winding number of the solids, is known all
over it, and with it the integral of w over the sheet: the area inside, twice where two solids
overlap. A triangle's part of it is bounded by pieces of its sides and by the segments along which
solids' triangles pass through it. With n the triangle's unit normal it is the sum over these pieces
p to q of w n . (p x q) / 2 (w on the left of the piece), and every end is a corner or a place where
an edge passes through a triangle. So the derivative is a force q x n or n x p, times w / 2, on each
end, which `force_on_intersections` hands on to the edge and the triangle that make it.

How deep: of each vertex inside, the distance to the nearest triangle of a solid, times a third of
the area of the triangles around it, summed up. It is zero where the area inside is, but for
triangles without a vertex inside, and unlike the area pulls what lies deep inside outwards.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, cross, dot, summed
from spt_jax.overlap.caps import open_sheets
from spt_jax.overlap.depth import nearest_points
from spt_jax.overlap.measure import Unmeasurable, check_usable
from spt_jax.overlap.surface import ExactSurface
from spt_jax.overlap.triangles.closed_form import sides_of
from spt_jax.overlap.triangles.contours import force_on_intersections, senses
from spt_jax.overlap.triangles.manifold import manifold_of
from spt_jax.overlap.triangles.near_triangles import Entangled
from spt_jax.overlap.triangles.winding import winding_numbers

# What the pieces of a triangle may leave open, against its longest side.
_GAP = 1e-6


@dataclass(frozen=True, eq=False)
class SheetInSolids:
    """A sheet and solids, measured.

    Attributes:
        vertices: of the solids and then of the sheet.
        faces: the same; no vertex belongs to both.
        solids: how many of the faces, the first ones, are the solids'.
        rounding: machine epsilon of the numbers that the vertices came in.

    Raises:
        Unmeasurable: as `measure`; solids that are open sheets themselves.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    solids: int
    rounding: float

    def __post_init__(self):
        check_usable(self.vertices, self.faces, self.rounding)
        solid = self.faces[: self.solids]
        reason = open_sheets(manifold_of(solid, len(self.vertices)), self.vertices)
        if reason is not None:
            raise Unmeasurable(f"of the solids, {reason}")

    @cached_property
    def surface(self) -> ExactSurface:
        """What intersects."""
        try:
            return ExactSurface(self.vertices, self.faces, self.rounding)
        except Entangled as tangle:
            raise Unmeasurable(str(tangle)) from None

    @cached_property
    def _is_sheet(self) -> Bool[np.ndarray, "P"]:
        """Which connected parts are the sheet's."""
        manifold = self.surface.manifold
        found = np.zeros(manifold.num_parts, bool)
        found[manifold.part[manifold.faces[manifold.beside >= self.solids, 0]]] = True
        return found

    def _counted(self, first, second) -> Bool[np.ndarray, "N 1"]:
        """Overlap of the sheet with solids is included, that of solids with anything is not."""
        return (self._is_sheet[first] & ~self._is_sheet[second])[:, None]

    @cached_property
    def _counts(self) -> Bool[np.ndarray, "K"]:
        surface = self.surface
        part, faces = surface.manifold.part, surface.manifold.faces
        first = part[surface.intersections.edge[:, 0]]
        return self._counted(first, part[faces[surface.intersections.face, 0]])[:, 0]

    @cached_property
    def _ends(self):
        surface = self.surface
        return winding_numbers(
            surface.topology,
            surface.manifold,
            surface.predicates,
            surface.intersections,
            surface.contours,
            self._counts[:, None],
            self._counted,
        )

    @cached_property
    def winding(self) -> Int[np.ndarray, "V"]:
        """In how many solids each vertex of the sheet lies; 0 of the solids' own."""
        manifold = self.surface.manifold
        found = np.zeros(len(self.vertices), np.int64)
        own = self._ends.of_vertices()[: len(manifold.origin), 0]
        found[manifold.origin] = np.where(self._is_sheet[manifold.part[: len(own)]], own, 0)
        return found

    @property
    def pairs(self) -> int:
        """How many pairs of the sheet's triangles and the solids' intersect."""
        return len(self.intersecting()[0])

    def area(self) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """The area inside, and its derivative by all vertices.

        Raises:
            Unmeasurable: the pieces of a triangle do not close, which has not been seen.
        """
        surface = self.surface
        manifold, points, scale = surface.manifold, surface.points, surface.scale
        faces = manifold.faces
        normal = area_normals(points, faces)
        normal /= np.maximum(np.sqrt(dot(normal, normal)), np.finfo(float).tiny)[:, None]
        own = (manifold.beside >= self.solids) & (manifold.kept >= 0)
        winding = self._ends.of_vertices()[:, 0]

        # Sides whole, with w as it is at their start; then what changes from each crossing on.
        found = np.flatnonzero(own & (winding[faces] != 0).any(axis=1))
        face = np.repeat(found, 3)
        start, end = faces[found].ravel(), np.roll(faces[found], -1, axis=1).ravel()
        pieces = [(face, points[start], points[end], winding[start], start, end)]
        intersections = replace(
            surface.intersections, jump=np.where(self._counts, surface.intersections.jump, 0)
        )
        number, half = sides_of(surface.topology, intersections)
        mine = own[half // 3] & (intersections.jump[number] != 0)
        number, half = number[mine], half[mine]
        last = faces[half // 3, (half + 2) % 3]
        jump = intersections.jump[number] * senses(surface.topology, half)
        at = -1 - number  # a place, not a vertex
        pieces.append((half // 3, intersections.point[number], points[last], jump, at, last))
        for k, sense in ((0, 1), (1, -1)):
            contours = surface.contours
            rows = np.flatnonzero(own[contours.pair[:, k]] & ~self._sheets(contours.pair[:, 1 - k]))
            first, second = contours.end[rows].T
            ends = contours.point[rows].transpose(1, 0, 2)
            weight = np.full(len(rows), sense)
            pieces.append((contours.pair[rows, k], *ends, weight, -1 - first, -1 - second))
        face, start, end, weight, at_start, at_end = (
            np.concatenate(column) for column in zip(*pieces, strict=True)
        )
        gap = summed(face, weight[:, None] * (end - start), len(faces))
        size = np.abs(points[faces] - points[np.roll(faces, 1, axis=1)]).max(axis=(1, 2))
        if (np.abs(gap).max(axis=1) > _GAP * np.maximum(size, np.finfo(float).tiny)).any():
            raise Unmeasurable("the pieces of the sheet inside the solids do not close.")
        # About a corner of each triangle: far from the origin the products would cancel.
        corner = points[faces[face, 0]]
        start, end, half_w = start - corner, end - corner, 0.5 * weight[:, None]
        value = float(np.sum(half_w[:, 0] * dot(normal[face], cross(start, end))))
        places = np.concatenate([at_start, at_end])
        force = np.concatenate(
            [half_w * cross(end, normal[face]), half_w * cross(normal[face], start)]
        )
        total = summed(places[places >= 0], force[places >= 0], len(points))
        passing = summed(-1 - places[places < 0], force[places < 0], len(intersections.face))
        vertex, passed = force_on_intersections(points, faces, intersections, passing)
        total += summed(vertex, passed, len(points))
        return value / scale**2, manifold.gather(total / scale, len(self.vertices))

    def _sheets(self, faces: Int[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
        manifold = self.surface.manifold
        return self._is_sheet[manifold.part[manifold.faces[faces, 0]]]

    @cached_property
    def _depths(self):
        """The vertices inside, how far they are from the solids' surface, and from where on it."""
        inside = np.flatnonzero(self.winding)
        solid = self.faces[: self.solids]
        if not len(inside):
            return inside, np.zeros(0), np.zeros((0, 3), np.int64), np.zeros((0, 3))
        depth, face, shares = nearest_points(self.vertices[inside], self.vertices[solid])
        return inside, depth, solid[face], shares

    def nearest(self) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
        """The sheet's vertices inside, and for each the nearest place on the solids' surface."""
        inside, _, corners, shares = self._depths
        return inside, np.einsum("nk,nkc->nc", shares, self.vertices[corners])

    def intersecting(self) -> tuple[Int[np.ndarray, "P 3"], Int[np.ndarray, "P 3"]]:
        """Corners of the sheet's triangles and of the solids' that intersect, pair by pair."""
        surface = self.surface
        faces = surface.manifold.kept[surface.contours.pair]
        sheet = self._sheets(surface.contours.pair.ravel()).reshape(-1, 2)
        between = np.flatnonzero((sheet[:, 0] != sheet[:, 1]) & surface.listed)
        faces, sheet = faces[between], sheet[between]
        first = np.where(sheet[:, 0], faces[:, 0], faces[:, 1])
        return self.faces[first], self.faces[faces.sum(axis=1) - first]

    @property
    def depths(self) -> Float[np.ndarray, "V"]:
        """How deep each vertex of the sheet lies in the solids; 0 outside."""
        found = np.zeros(len(self.vertices))
        found[self._depths[0]] = self._depths[1]
        return found

    def depth(self) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """The sum of depth times a third of the area around, and its derivative."""
        sheet = self.faces[self.solids :]
        normals = area_normals(self.vertices, sheet)
        length = np.sqrt(dot(normals, normals))
        depths = self.depths
        mass = np.bincount(sheet.ravel(), np.repeat(length / 6, 3), len(depths))
        value = float(mass @ depths)
        # Of the areas: |n| / 6 times the depths of the corners.
        unit = normals / np.where(length > 0, length, 1.0)[:, None]
        weight = depths[sheet].sum(axis=1)[:, None] / 6
        total = np.zeros(self.vertices.shape)
        for k in range(3):
            across = self.vertices[sheet[:, (k + 2) % 3]] - self.vertices[sheet[:, (k + 1) % 3]]
            total += summed(sheet[:, k], weight * cross(unit, across), len(depths))
        inside, depth, corners, shares = self._depths
        away = self.vertices[inside] - np.einsum("nk,nkc->nc", shares, self.vertices[corners])
        away *= (mass[inside] / np.where(depth > 0, depth, np.inf))[:, None]
        total += summed(inside, away, len(depths))
        against = -shares[:, :, None] * away[:, None, :]
        total += summed(corners.ravel(), against.reshape(-1, 3), len(depths))
        return value, total
