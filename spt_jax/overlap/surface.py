"""A surface, where it intersects itself and what is inside what, from its triangles alone.

From the vertices to the overlaps: the surface is closed and cut into sheets (`manifold.py`), edges
that pass through triangles are found (`pairs.py`), with exact signs (`predicates.py`), joined to
contours (`contours.py`), the winding number is followed along the surface (`winding.py`), and sums
over triangles give what each contributes to volume and gradient (`closed_form.py`).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from spt_jax.overlap.arrays.ranges import unique
from spt_jax.overlap.arrays.vectors import dot, summed
from spt_jax.overlap.exclusions import Exclusions, part_rules
from spt_jax.overlap.triangles.closed_form import Shares, of_copies, shares_of, volumes_of
from spt_jax.overlap.triangles.contacts import Contacts
from spt_jax.overlap.triangles.contours import Contours, find_contours
from spt_jax.overlap.triangles.manifold import Manifold, manifold_of
from spt_jax.overlap.triangles.pair_layout import Topology, prepared
from spt_jax.overlap.triangles.pairs import EdgeIntersections, find_intersections
from spt_jax.overlap.triangles.part_roots import enclosing_parts
from spt_jax.overlap.triangles.predicates import Predicates
from spt_jax.overlap.triangles.regions import connected_regions
from spt_jax.overlap.triangles.winding import Ends, labels_of, winding_numbers

# Vertices that are moved by this many units in the last place of the largest coordinate, as turning
# a mesh moves them, neither enter a triangle that they touch nor leave it.
_CONTACT = 8.0


@dataclass(frozen=True, eq=False)
class Layer:
    """The overlaps between the parts that one choice of pairs names.

    Attributes:
        ends: the winding numbers, of which this layer has the column `column`.
        column: of the layer.
        counts: which intersections belong to it.
        contours: the segments that do.
        intersections: as in the surface, of which the contours' ends are rows.
        shares: the triangles' contributions.
        dropped: triangles of overlaps that are there by rounding alone.
    """

    ends: Ends
    column: int
    counts: Bool[np.ndarray, "K"]
    contours: Contours
    segments: Bool[np.ndarray, "P"]
    shares: Shares
    dropped: Int[np.ndarray, "D"] = field(default_factory=lambda: np.zeros(0, np.int64))


class ExactSurface:
    """A surface, and all that follows from its triangles alone.

    Attributes:
        count: how many vertices were given.
        times: how often each triangle is there where copies are measured once; None: each once.
        manifold: the surface closed and cut into sheets.
        scale: coordinates are multiplied by this, a power of two.
        points: the new vertices' scaled positions.
        intersections, contours: where the surface meets itself.
        reach: how near things are that touch, of the scaled positions.
        proper: which of the contours' pairs intersect, and do not only touch.

    Raises:
        Entangled: the triangles are too many to a place to be listed.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        rounding: float,
        merged: bool = False,
    ):
        self.count = len(vertices)
        self.manifold: Manifold = manifold_of(faces, len(vertices))
        placed = self.manifold.place(vertices)
        # Of parts that lie on each other, vertex on vertex, one is measured for all.
        self.parts_times = self.times = self._listed = None
        if merged and self.manifold.num_parts > 1 and not self.manifold.num_fans:
            first, sense = self.manifold.copies(placed)
            if (first != np.arange(len(first))).any():
                self._merge(first, sense)
        self._faces = self.manifold.faces
        self.predicates = Predicates(placed, self._faces, self.manifold.part)
        self.scale = self.predicates.scale
        self.points = np.ascontiguousarray(self.predicates.points.T)
        self.topology: Topology = prepared(self._faces, len(placed)).topology
        self.reach = _CONTACT * rounding
        self.intersections: EdgeIntersections
        self.intersections, self._find_contacts = find_intersections(
            self.points, self._faces, predicates=self.predicates, reach=self.reach
        )
        self.contours = find_contours(self.points, self.topology, self.intersections)

    def _merge(self, first: Int[np.ndarray, "P"], sense: Int[np.ndarray, "P"]) -> None:
        """Measure each of these parts for all that lie in its place.

        One that is turned inside out takes one away: they lie in each other without a volume, where
        the derivative has a kink, and count as neither moving.
        """
        net = np.bincount(first, sense, len(first)).astype(np.int64)
        # The one that is measured has the sense of most.
        turned = np.flatnonzero(net[first] < 0)
        most = turned[sense[turned] < 0]
        leader = np.arange(len(first))
        leader[first[most[::-1]]] = most[::-1]
        first, sense = leader[first], np.where(net[first] < 0, -sense, sense)
        self.manifold, self._copies, self._originals = self.manifold.without(first)
        self.parts_times = np.abs(np.bincount(first, sense, len(first)).astype(np.int64))
        of_face = self.manifold.part[self.manifold.faces[:, 0]]
        self.times = self.parts_times[of_face]
        self._listed = np.bincount(first, minlength=len(first))[of_face]
        alike = np.bincount(first[sense > 0], minlength=len(first))
        share = np.where(sense > 0, self.parts_times[first] / np.maximum(alike, 1)[first], 0.0)
        self._moving = share[self.manifold.part]

    @cached_property
    def contacts(self) -> Contacts:
        """Vertices that lie on triangles which are not theirs."""
        return self._find_contacts()

    @cached_property
    def proper(self) -> Bool[np.ndarray, "P"]:
        """Pairs of triangles that intersect, and do not only touch."""
        return self.contours.proper(self.points, self._faces, self.reach)

    @cached_property
    def pairs(self) -> Int[np.ndarray, "P 2"]:
        """Of all contours, the faces given: where a fan is one of them, the face beside it."""
        return self.manifold.beside[self.contours.pair]

    @cached_property
    def listed(self) -> Bool[np.ndarray, "P"]:
        """Pairs of triangles that were given, not fans, and intersect properly."""
        return self.proper & (self.manifold.kept[self.contours.pair] >= 0).all(axis=1)

    def with_copies(self, values: Shaped[np.ndarray, "X ..."]) -> Shaped[np.ndarray, "X ..."]:
        """What is known at the new vertices, copied to the parts that were left out."""
        if self.times is not None:
            values[self._copies] = values[self._originals]
        return values

    def carried(self, velocity: Float[np.ndarray, "X 3"]) -> Float[np.ndarray, "X 3"]:
        """Velocities of the vertices that are measured: of parts in one place, the mean of theirs.

        The transpose of `shared_out`, over how often a part is there.
        """
        if self.parts_times is None:
            return velocity
        total = self._moving[:, None] * velocity
        total += summed(self._originals, total[self._copies], len(total))
        times = np.maximum(self.parts_times, 1)[self.manifold.part]
        return total / times[:, None]

    def shared_out(self, forces: Float[np.ndarray, "X 3"]) -> Float[np.ndarray, "X 3"]:
        """Forces on one of the parts that lie in one place, as those on each of them."""
        if self.times is not None:
            forces = self._moving[:, None] * self.with_copies(forces)
        return forces

    def of_given(self, values: Shaped[np.ndarray, "V"]) -> Shaped[np.ndarray, "V"]:
        """The same for values at the vertices given."""
        if self.times is not None:
            origin = np.append(self.manifold.origin, np.full(len(self.manifold.loops), -1))
            copies, originals = origin[self._copies], origin[self._originals]
            kept = (copies >= 0) & (originals >= 0)
            values[copies[kept]] = values[originals[kept]]
        return values

    def count_pairs(self, on: Bool[np.ndarray, "P"]) -> int:
        """How many pairs of the triangles given some contours stand for."""
        if self._listed is None:
            return int(np.count_nonzero(on))
        return int(self._listed[self.contours.pair[on]].prod(axis=1).sum())

    def layers(self, exclusions: Exclusions | None) -> list[Layer]:
        """The overlaps that are included whole, and those that their contours decide.

        Args:
            exclusions: what is excluded; None: every overlap does, those of fans with what is
                beside them, too.
        """
        faces, part = self._faces, self.manifold.part
        rules = None
        if exclusions is not None and (exclusions.any or self.manifold.num_fans):
            rules = part_rules(exclusions, self.manifold)

        def counted(first, second):
            if rules is None:
                return np.ones((len(first), 1), bool)
            return rules(first, second)

        first, second = part[self.intersections.edge[:, 0]], part[faces[self.intersections.face, 0]]
        counts = counted(first, second)
        of_pairs = counted(*part[faces[self.contours.pair, 0]].T)
        ends = winding_numbers(
            self.topology,
            self.manifold,
            self.predicates,
            self.intersections,
            self.contours,
            counts,
            counted,
            self.parts_times,
        )
        found = []
        for column in range(counts.shape[1]):
            on, segments = counts[:, column], of_pairs[:, column]
            every = bool(on.all())
            intersections = self.intersections if every else self.intersections.only(on)
            contours = self.contours
            if not every:
                number = np.cumsum(on) - 1
                contours = contours.only(segments)
                end = np.where(contours.end >= 0, number[contours.end], -1)
                contours = _with_ends(contours, end)
            shares = shares_of(
                self.points, self.topology, intersections, contours, ends, column, self.times
            )
            layer = Layer(ends, column, on, contours, segments, shares)
            found.append(self._without_contact(layer))
        return found

    def _without_contact(self, layer: Layer) -> Layer:
        """The layer without overlaps that are only there by rounding.

        Where solids touch and the mesh was turned, one may be in the other by a unit in the last
        place, all along a face: the volume is as good as nothing, its gradient is not.
        """
        proper = self.proper[layer.segments]
        # A sheet is closed by fans that lie in its own plane.
        flat = self.manifold.num_fans > 0
        if proper.all() and not flat:
            return layer
        region, count = regions_of(self, layer)
        of_face = np.full(len(self._faces), -1)
        of_face[layer.shares.faces] = region
        at = of_face[layer.contours.pair[:, 0]]
        touching = (np.bincount(at, minlength=count) > 0) | flat
        touching[at[proper]] = False
        if not touching.any():
            return layer
        shares, own = layer.shares, np.zeros(len(layer.shares.faces))
        if self.times is not None:
            own = of_copies(self.times[shares.faces])
        between = replace(shares, share=shares.share - own[:, None])
        volume = volumes_of(self.points, self._faces, between, region, count, self.times)
        area = np.bincount(region, np.sqrt(dot(shares.normals, shares.normals)), count)
        kept = ~(touching & (np.abs(volume) <= 2 * self.reach * area))
        segments = layer.segments.copy()
        segments[segments] = kept[at]
        # What copies of one part share with each other stays.
        share = np.where(kept[region][:, None], shares.share, own[:, None])
        return replace(
            layer,
            segments=segments,
            contours=layer.contours.only(kept[at]),
            shares=replace(shares, share=share).only(kept[region] | (own != 0)),
            dropped=shares.faces[~kept[region]],
        )

    def labels(self, layer: Layer, exclusions: Exclusions) -> Int[np.ndarray, "W"]:
        """w_out around each new vertex on one layer, where contact is no overlap."""
        part = self.manifold.part
        counts = np.ones(len(self.contacts.vertex), bool)
        if (exclusions.any or self.manifold.num_fans) and len(counts):
            first = part[self.contacts.vertex]
            second = part[self._faces[self.contacts.face, 0]]
            counts = part_rules(exclusions, self.manifold)(first, second)[:, layer.column]
        side, _ = self.predicates.volume(self._faces[self.contacts.face].T, self.contacts.vertex)
        found = labels_of(
            self.topology, layer.ends, layer.column, self.contacts, side, counts, part
        )
        if len(layer.dropped):
            nothing = np.zeros(len(found), bool)
            nothing[self._faces[layer.dropped]] = True
            nothing[self._faces[layer.shares.faces]] = False
            found[nothing] = 0
        return found


def _with_ends(contours: Contours, end) -> Contours:
    return Contours(**{**vars(contours), "end": end})


def regions_of(surface: ExactSurface, layer: Layer) -> tuple[Int[np.ndarray, "H"], int]:
    """Of the triangles of a layer the region, and how many regions there are."""
    within = layer.ends.of_vertices()[:, layer.column] != 0
    within[layer.contours.cusp[layer.contours.cusp >= 0]] = True
    return connected_regions(
        surface.manifold.faces, layer.shares.faces, within, layer.contours.pair
    )


def parts_in_each_other(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "N 2"]:
    """Pairs of connected parts (`Manifold.part`) that intersect, or of which one encloses another.

    Args:
        vertices: positions.
        faces: indices of each triangle's corners.

    Returns:
        Numbers of parts, the lower first.
    """
    manifold = manifold_of(faces, len(vertices))
    named = unique(manifold.part[manifold.faces].ravel())
    if len(named) < 2:
        return np.zeros((0, 2), np.int64)
    surface = ExactSurface(vertices, faces, float(np.finfo(np.float64).eps))
    pairs = manifold.part[manifold.faces[surface.contours.pair[surface.proper], 0]]
    inner, outer = enclosing_parts(surface.topology, manifold, surface.predicates)
    pairs = np.concatenate([pairs, np.stack([inner, outer], axis=1)])
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
