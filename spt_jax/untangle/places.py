"""Places of the search for intersection-free vertices: what is left there, and what was harmed.

A `Place` is one set of vertices with its measurement. `Places` measures them, and judges each
against the vertices given: whether more intersects or overlaps there than before, and whether a
part is inside out, enclosed in another, or crumpled.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, dot
from spt_jax.overlap.measure import Measurement, Sampling, Unmeasurable, measure
from spt_jax.overlap.triangles.pairs import EdgeIntersections
from spt_jax.untangle.spread import Surface

# A part is no longer itself where more of its triangles are turned over, or its area has grown by
# more: of 40 posed bodies at most 0.2 % are turned over, and none grows.
_MOST_FLIPPED, _MOST_AREA = 0.1, 1.5

# Depth, against the largest coordinate, up to which triangles touch in double precision.
_TOUCHING = 8.0 * float(np.finfo(np.float64).eps)
# Of a volume, in rounding.
_EQUAL = 1e-9

_EXACT = Sampling(None, ((0.0, 0.0, -1.0),))


@dataclass(frozen=True, eq=False)
class Place:
    """Vertices that the search came by, measured.

    Attributes:
        vertices: at values that the dtype asked for can hold.
        found: what was measured of them, exactly.
        intersections: of edges through triangles that are to go; in the numbering of
            `found.surface`.
        left: pairs of triangles to be separated. More than those counted as intersecting: in
            single precision, also those that are deeper in each other than rounding alone explains.
        inverted: connected parts whose volume changed its sign.
    """

    vertices: Float[np.ndarray, "V 3"]
    found: Measurement
    intersections: EdgeIntersections
    left: int
    inverted: int

    @property
    def pairs(self) -> int:
        """Pairs of triangles that intersect; contact is none."""
        return self.found.total_intersecting_pairs

    @cached_property
    def volume(self) -> float:
        """The overlap volume, exact."""
        return self.found.overlap.volume

    @cached_property
    def labels(self) -> Int[np.ndarray, "V"]:
        """The labels of the vertices."""
        return self.found.labels("vertex")

    @property
    def rank(self) -> tuple[int, int, float]:
        """Sorts places, the best first."""
        return self.pairs, self.left, self.volume

    @cached_property
    def crossed(self) -> Bool[np.ndarray, "V"]:
        """Vertices of edges and triangles that are to be parted."""
        crossed = np.zeros(len(self.vertices), bool)
        for vertices in self.ends:
            crossed[vertices] = True
        return crossed

    @property
    def ends(self) -> tuple[Int[np.ndarray, "K 2"], Int[np.ndarray, "K 3"]]:
        """Of the intersections the edges and the triangles, by the vertices given."""
        manifold = self.found.surface.manifold
        corners = manifold.faces[self.intersections.face]
        return manifold.origin[self.intersections.edge], manifold.origin[corners]


class Places:
    """Measures vertices of one mesh, and compares them with those given.

    Args:
        surface: the mesh's graph.
        vertices: those given, float32 or float64; all places are judged at values of this dtype.

    Raises:
        Unmeasurable: the vertices given have no surface that could be measured.
    """

    def __init__(self, surface: Surface, vertices: Float[np.ndarray, "V 3"]):
        self.surface = surface
        self.dtype = vertices.dtype
        given = vertices.astype(np.float64)
        found = self._measured(given)
        self._sense = surface.part_senses(given)
        self._normals = area_normals(given, surface.faces)
        self._areas = surface.part_sums(np.linalg.norm(self._normals, axis=1))
        # What touches at the start may go on doing so.
        pairs, listed = self._listed(found)
        self._touching = self._keys(pairs[listed & ~found.surface.proper])
        self.start = self._place(found)

    def look(self, vertices: Float[np.ndarray, "V 3"]) -> Place:
        """The place as it will be in the caller's dtype.

        Raises:
            Unmeasurable: there is nothing to measure.
        """
        with np.errstate(over="ignore"):  # which cannot be measured
            at = vertices.astype(self.dtype).astype(np.float64)
        return self._place(self._measured(at))

    def there(self, vertices: Float[np.ndarray, "V 3"]) -> Place | None:
        """The place, or None where there is nothing to measure."""
        try:
            return self.look(vertices)
        except Unmeasurable:
            return None

    def is_no_worse(self, place: Place) -> bool:
        """Whether nothing has come that was not there at the start."""
        start = self.start
        if place.inverted or place.pairs > start.pairs:
            return False
        if place.volume > (1 + _EQUAL) * start.volume or self.is_crumpled(place):
            return False
        # What no longer intersects may have been pushed into another part whole.
        moved = (place.vertices != start.vertices).any(axis=1)
        return bool(place.pairs) or not (place.labels[moved] != 0).any()

    def is_crumpled(self, place: Place) -> bool:
        """Whether some part no longer is what it was."""
        normals = area_normals(place.vertices, self.surface.faces)
        area = self.surface.part_sums(np.linalg.norm(normals, axis=1))
        flipped = self.surface.part_sums(dot(normals, self._normals) < 0)
        every = self.surface.part_sums(np.ones(len(normals)))
        return bool(
            (flipped > _MOST_FLIPPED * every).any() or (area > _MOST_AREA * self._areas).any()
        )

    def is_freed(self, place: Place | None) -> bool:
        """Whether nothing is left to part at a place that is no worse than the start."""
        return place is not None and not place.left and self.is_no_worse(place)

    def _measured(self, vertices: Float[np.ndarray, "V 3"]) -> Measurement:
        rounding = float(np.finfo(self.dtype).eps)
        return measure(vertices, self.surface.faces, _EXACT, rounding=rounding)

    def _place(self, found: Measurement) -> Place:
        surface = found.surface
        pairs, listed = self._listed(found)
        close = surface.contours.proper(surface.points, surface.manifold.faces, _TOUCHING)
        close &= ~np.isin(self._keys(pairs), self._touching)
        wanted = listed & (surface.proper | close)
        ends = surface.contours.end[wanted]
        kept = np.zeros(len(surface.intersections.face), bool)
        kept[ends[ends >= 0]] = True
        turned = self.surface.part_senses(found.vertices) * self._sense < 0
        return Place(
            found.vertices,
            found,
            surface.intersections.only(kept),
            int(np.count_nonzero(wanted)),
            int(np.count_nonzero(turned)),
        )

    def _listed(self, found: Measurement):
        """The faces given of all contours, and which contours have no fan."""
        faces = found.surface.manifold.kept[found.surface.contours.pair]
        return faces, (faces >= 0).all(axis=1)

    def _keys(self, pairs: Int[np.ndarray, "P 2"]) -> Int[np.ndarray, "P"]:
        return pairs.min(axis=1) * len(self.surface.faces) + pairs.max(axis=1)
