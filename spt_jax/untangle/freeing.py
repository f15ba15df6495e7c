"""The search behind `untangle_mesh`: push overlaps apart, then shrink what still intersects.

Each step takes the regions in which the surface intersects itself one by one. A region of some
volume is pushed along the gradient of that volume, a Newton step towards none. One of next to none
is a curve where two sheets just pass through each other, and is moved so that the curve gets
shorter. Both are spread smoothly over the surface around (`spread.py`).

Every step is measured (`places.py`): what the search returns is the best of all the places where it
has been, and what it was given where none of them is better in every respect. Where nothing is left
to part, the displacements are made as small as they can be (`tightening.py`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax._steps import OnStep, Step
from spt_jax.overlap.measure import Sampling, measure
from spt_jax.untangle.contours import contour_forces
from spt_jax.untangle.places import Place, Places
from spt_jax.untangle.spread import Spread, Surface, newton_step, sized_step
from spt_jax.untangle.tightening import tighten

# How far a push spreads, in edges, by the root of the number of vertices in the overlap: wide
# enough that the middle of a deep overlap and its contour move together. Of 0.17, 0.25 and 0.5, the
# small ones move the worst frames least (56, 60 and 212 mm for a body that lies on its arms) and
# more often need a second attempt, in which it is doubled.
_REACH = 0.2
_SHORTEST_REACH, _LONGEST_REACH = 4.0, 96.0
# What moves, in multiples of the reach: beyond, a push has faded to under 2 %.
_PATCH = 3.0

# The volume of a contact grows with the square of its depth, so a Newton step goes half the way;
# a factor of 2 would go it all at once, and further than it must where the contact is no lens.
_OVERSTEP = 1.5

# A region is pushed by its volume if that is more than that of a cube on so much of an edge.
_LEAST_VOLUME = 0.5

# The contour's own steps, in mean edges, and how far they spread, in edges.
_CONTOUR_STEP = 0.15
_CONTOUR_REACH = 2.0

# An attempt is given up after so many steps without fewer intersections.
_PATIENCE = 12

# No vertex goes farther than this many times the size of its connected part.
_FARTHEST = 1.0

# What parts that are pushed apart as they are keep between them, in their size, and in how many
# steps that must be done.
_GAP = 1e-3
_RIGID_STEPS = 12


@dataclass(frozen=True)
class Freed:
    """What the search found.

    Attributes:
        best: the best place; `start` itself where nothing better was found.
        start: the vertices given.
        steps: over all attempts.
        ran_out: whether the last attempt had steps to go.
        diverged: whether an attempt came to where there was nothing to measure.
    """

    best: Place
    start: Place
    steps: int = 0
    ran_out: bool = False
    diverged: bool = False


@dataclass(frozen=True)
class _Region:
    """Vertices around one place where the surface intersects itself, and how far a push spreads."""

    members: Int[np.ndarray, "M"]
    reach: float


def free_vertices(
    surface: Surface,
    vertices: Float[np.ndarray, "V 3"],
    sampling: Sampling,
    *,
    attempts: int,
    steps_per_attempt: int,
    whole_parts: bool,
    on_step: OnStep,
    fixed: Bool[np.ndarray, "V"] | None = None,
) -> Freed:
    """Vertices near those given at which no triangles intersect, as far as it goes.

    Every attempt starts from the vertices given, with the push spread twice as far around what
    the last one left. Where none leaves nothing, connected parts that intersect each other are
    pushed apart as they are. The first place where nothing is left is taken, pulled back as far as
    it can be; otherwise the one with the fewest intersections, of those that are no worse than the
    start: neither more intersections nor more overlap, and no part inside out, within another or
    crumpled that was not so before. Connected parts that intersect nothing do not move.

    Args:
        surface: the mesh's graph, made once for all vertices of the same faces.
        vertices: float32 or float64; intersections are judged at values of this dtype.
        sampling: how the overlap's gradient is measured.
        attempts: at most so many.
        steps_per_attempt: at most so many in each.
        whole_parts: whether connected parts are pushed apart as they are where no attempt did.
        on_step: called with a `Step` before each step.
        fixed: vertices that stay; a part with one of them is not pushed as a whole.

    Raises:
        Unmeasurable: the vertices given have no surface that could be measured.
    """
    search = _Search(surface, vertices, sampling, on_step, fixed)
    best = start = search.start
    # Without an intersection there is nothing to shrink: what touches stays in touch, and a part
    # within another whole would be pushed into nothing.
    if not start.pairs or not search.may_move.any():
        return Freed(start, start)
    regions = search.regions()
    for attempt in range(attempts):
        found, last = search.descend(search.reach(regions), attempt, steps_per_attempt)
        if found.rank < best.rank:
            best = found
        if not best.left:
            break
        regions = search.stiffer(regions, last)
    if best.left and whole_parts:
        found = search.part(attempts)
        best = found if found.rank < best.rank else best
    if not best.left:
        best = tighten(search.places, best)
    return Freed(best, start, search.steps, search.ran_out, search.diverged)


class _Search:
    def __init__(
        self,
        surface: Surface,
        vertices: np.ndarray,
        sampling: Sampling,
        on_step: OnStep,
        fixed: np.ndarray | None = None,
    ):
        self.surface, self.sampling, self.on_step = surface, sampling, on_step
        self.steps = 0
        self.ran_out = self.diverged = False
        self.places = Places(surface, vertices)
        self.start = self.places.start
        self._size = surface.part_sizes(self.start.vertices)
        self.edge_length = surface.edge_length(self.start.vertices)
        parts = np.unique(surface.part[self.start.crossed])
        self.may_move = np.isin(surface.part, parts)
        if fixed is not None:
            self.may_move &= ~fixed
            parts = np.setdiff1d(parts, surface.part[fixed])
        # Of two parts that intersect, this one gives way: the smaller one of those that may.
        self._weight = np.where(np.isin(np.arange(surface.num_parts), parts), self._size, np.inf)

    def push(self, place: Place) -> Float[np.ndarray, "V 3"]:
        """The gradient of the overlap volume."""
        if self.sampling.rays is None:
            return place.found.overlap.gradient()
        found = measure(place.vertices, self.surface.faces, self.sampling)
        return found.gradient("boundary", "vertex")

    def groups(self, place: Place, also: Bool[np.ndarray, "V"]) -> list[Int[np.ndarray, "_"]]:
        """Vertices at intersections, with others they are connected to by edge or intersection."""
        edge, corners = place.ends
        found = self.surface.groups(place.crossed | also, edge[:, 0], corners[:, 0])
        # A part that is enclosed in another overlaps it but intersects nothing: pushing its surface
        # inwards would shrink it to nothing.
        return [members for members in found if place.crossed[members].any()]

    def regions(self) -> list[_Region]:
        push = self.push(self.start)
        return [
            _Region(members, max(_SHORTEST_REACH, _REACH * np.sqrt(len(members))))
            for members in self.groups(self.start, (push != 0).any(axis=1))
        ]

    def reach(self, regions: list[_Region]) -> Float[np.ndarray, "V"]:
        """How far pushes spread at each vertex; zero where nothing moves."""
        reach = np.zeros(self.surface.num_vertices)
        for region in regions:
            far = min(region.reach, _LONGEST_REACH)
            near = self.surface.within(region.members, int(_PATCH * far))
            reach[near] = np.maximum(reach[near], far)
        return np.where(self.may_move, reach, 0.0)

    def stiffer(self, regions: list[_Region], last: Place) -> list[_Region]:
        """Regions for the next attempt: twice the reach where intersections are left."""
        nothing = np.zeros(self.surface.num_vertices, bool)
        new = [_Region(members, _SHORTEST_REACH) for members in self.groups(last, nothing)]
        grown = []
        for region in regions:
            near = self.surface.within(region.members, int(region.reach))
            # An attempt that parted everything, and turned something inside out, has to be wider.
            factor = 2.0 if not last.left or last.crossed[near].any() else 1.0
            grown.append(_Region(region.members, min(factor * region.reach, _LONGEST_REACH)))
        return grown + new

    def report(self, attempt: int, place: Place) -> None:
        """Call `on_step` with a place."""
        vertices = place.vertices.astype(self.places.dtype)
        self.on_step(Step(attempt, self.steps, vertices, None, lambda: (place.volume, place.pairs)))

    def descend(
        self, reach: Float[np.ndarray, "V"], attempt: int, most: int
    ) -> tuple[Place, Place]:
        """One attempt: the best of its steps, and the one that left least to part."""
        wide = Spread(self.surface, reach)
        narrow = Spread(self.surface, np.where(reach > 0, _CONTOUR_REACH, 0.0))
        best = least = place = self.start
        idle = 0
        for _ in range(most):
            self.report(attempt, place)
            if not place.left or idle >= _PATIENCE:
                break
            self.steps += 1
            ahead = self.places.there(self.bounded(place.vertices + self.move(place, wide, narrow)))
            if ahead is None:
                self.diverged = True
                break
            place = ahead
            idle += 1
            if place.left < least.left:
                least, idle = place, 0
            if place.rank < best.rank and self.places.is_no_worse(place):
                best = place
        self.ran_out = bool(place.left) and idle < _PATIENCE
        return best, least

    def bounded(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """The same, with no part's vertices farther from the start than the part is large."""
        if not np.isfinite(vertices).all():
            return vertices  # which cannot be measured
        shift = vertices - self.start.vertices
        far = self.surface.farthest(shift)
        most = _FARTHEST * self._size
        scale = np.where(far > most, most / np.where(far > 0, far, 1.0), 1.0)
        if (scale == 1.0).all():
            return vertices
        return self.start.vertices + scale[self.surface.part][:, None] * shift

    def move(self, place: Place, wide: Spread, narrow: Spread) -> Float[np.ndarray, "V 3"]:
        """The displacement of one step."""
        push, vertices = self.push(place), place.vertices
        manifold = place.found.surface.manifold
        contour = contour_forces(manifold.faces, place.found.surface.points, place.intersections)
        contour = manifold.gather(contour, len(vertices))
        pushed, pulled = [], []
        for members in self.groups(place, (push != 0).any(axis=1)):
            # The volume is homogeneous of degree three in the vertices, so by Euler's theorem it
            # is a third of their product with its gradient: here of this region alone.
            arm = vertices[members] - vertices[members].mean(axis=0)
            volume = float(np.sum(push[members] * arm)) / 3.0
            edge = float(np.median(self.edge_length[members]))
            if volume > (_LEAST_VOLUME * edge) ** 3:
                pushed.append((members, _OVERSTEP * volume))
            else:
                pulled.append((members, _CONTOUR_STEP * edge))
        return newton_step(wide, push, pushed) + sized_step(narrow, contour, pulled)

    def part(self, attempt: int) -> Place:
        """The best place on the way of connected parts that push each other apart as they are.

        Of two that intersect the smaller one gives way, along the axis along which the boxes around
        them overlap least.
        """
        best = place = self.start
        for _ in range(_RIGID_STEPS):
            self.report(attempt, place)
            edge, corners = place.ends
            pairs = self.surface.part[np.stack([edge[:, 0], corners[:, 0]], axis=1)]
            pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
            if not len(pairs):
                break
            shift = np.zeros((self.surface.num_parts, 3))
            low, high = self.surface.part_boxes(place.vertices)
            for pair in pairs:
                mover, other = pair[np.argsort(self._weight[pair], kind="stable")]
                if self._weight[mover] == np.inf:
                    continue
                gap = _GAP * self._size[mover]
                # By how much to go up, and by how much down.
                ways = np.stack([high[other] - low[mover], low[other] - high[mover]])
                way, axis = np.unravel_index(np.abs(ways).argmin(), ways.shape)
                shift[mover, axis] += ways[way, axis] + np.copysign(gap, ways[way, axis])
            self.steps += 1
            ahead = self.places.there(self.bounded(place.vertices + shift[self.surface.part]))
            if ahead is None:
                break
            place = ahead
            if place.rank < best.rank and self.places.is_no_worse(place):
                best = place
        return best
