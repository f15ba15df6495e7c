"""The search behind `untangle_mesh`: push overlaps apart, then shrink what still crosses.

Each step takes the regions in which the surface crosses itself one by one. A region whose overlap
the rays can see is pushed along the gradient of its volume, a Newton step towards no volume. One
that they cannot see any more is a curve where two sheets just cross, and is moved so that the
curve gets shorter. Both are spread smoothly over the surface around (`spread.py`).

Of 200 posed bodies this frees 181 at the first attempt and the rest in later ones; the volume
alone leaves 4 to 80 crossings on nearly every one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.measure import Sampling, measure
from spt_jax.overlap.triangles.pairs import EdgeCrossings, edge_crossings
from spt_jax.untangle.contours import contour_forces
from spt_jax.untangle.spread import Spread, Surface

# How far a push spreads, in edges, by the root of the number of vertices in the overlap: wide
# enough that the middle of a deep overlap and its rim move together. Of 0.17, 0.25 and 0.5, the
# small ones move the worst frames least (56, 60 and 212 mm for a body that lies on its arms) and
# more often need a second attempt, in which it is doubled.
_REACH = 0.2
_SHORTEST_REACH, _LONGEST_REACH = 4.0, 96.0

# What moves, in multiples of the reach: beyond, a push has faded to under 2 %.
_PATCH = 3.0

# The volume of a contact grows with the square of its depth, so a Newton step goes half the way;
# a factor of 2 would go it all at once, and further than it must where the contact is no lens.
_OVERSTEP = 1.5

# A region counts as seen by the rays if its volume is more than that of a cube on one pixel.
_LEAST_VOLUME = 1.0

# The contour's own steps, in mean edges, and how far they spread, in edges.
_CONTOUR_STEP = 0.15
_CONTOUR_REACH = 2.0

# While no region is seen by the rays, they are cast only once in so many steps.
_MEASURE_EVERY = 8

# An attempt is given up after so many steps without fewer crossings.
_PATIENCE = 12

_TIGHTENINGS = 4

OnStep = Callable[[int, int, int], None]


@dataclass(frozen=True)
class Freed:
    """What the search found.

    Attributes:
        vertices: those with the fewest crossings, at values that the dtype asked for can hold.
        crossings: of edges through triangles that are left.
        steps: over all attempts.
    """

    vertices: Float[np.ndarray, "V 3"]
    crossings: int
    steps: int


@dataclass(frozen=True)
class _Region:
    """Vertices around one place where the surface crosses itself, and how far a push spreads."""

    members: Int[np.ndarray, "M"]
    reach: float


def free_vertices(
    surface: Surface,
    vertices: Float[np.ndarray, "V 3"],
    sampling: Sampling,
    *,
    attempts: int,
    steps_per_attempt: int,
    on_step: OnStep,
) -> Freed:
    """Vertices near those given at which no edge passes through a triangle, as far as it goes.

    Every attempt starts from the vertices given, with the push spread twice as far around what
    the last one left. The first that leaves nothing is taken, pulled back as far as it can be;
    otherwise the one that leaves the fewest crossings.

    Args:
        surface: the mesh's graph, made once for all vertices of the same faces.
        vertices: float32 or float64; crossings are judged at values of this dtype.
        sampling: the rays that measure the overlap.
        attempts: at most so many.
        steps_per_attempt: at most so many in each.
        on_step: called with the attempt, the steps so far and the crossings before each step.
    """
    search = _Search(surface, vertices, sampling, on_step)
    crossings = search.crossings(search.start)
    best, least = search.start, len(crossings.face)
    if not least:
        return Freed(best, 0, 0)
    regions = search.regions(crossings)
    for attempt in range(attempts):
        found, left = search.descend(search.reach(regions), attempt, steps_per_attempt)
        if len(left.face) < least:
            best, least = found, len(left.face)
        if not least:
            best = search.tighten(best, crossings)
            break
        regions = search.stiffer(regions, left)
    return Freed(search.rounded(best), least, search.steps)


class _Search:
    def __init__(self, surface: Surface, vertices: np.ndarray, sampling: Sampling, on_step: OnStep):
        self.surface, self.sampling, self.on_step = surface, sampling, on_step
        self.dtype = vertices.dtype
        self.start = vertices.astype(np.float64)
        self.edge_length = surface.edge_length(self.start)
        self.steps = 0

    def rounded(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        return vertices.astype(self.dtype).astype(np.float64)

    def crossings(
        self, vertices: Float[np.ndarray, "V 3"], moving: Bool[np.ndarray, "V"] | None = None
    ) -> EdgeCrossings:
        """Crossings as they will be in the caller's dtype; those of moving vertices only."""
        among = None if moving is None else np.logical_or.reduce(moving[self.surface.faces], axis=1)
        return edge_crossings(self.rounded(vertices), self.surface.faces, among=among)

    def push(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "V 3"], float]:
        """The gradient of the overlap volume, and the volume of a cube on one pixel."""
        found = measure(vertices, self.surface.faces, self.sampling)
        pixel = max((beam.beam.ray_area for beam in found.beams), default=0.0)
        return found.gradient("boundary", "vertex"), pixel**1.5

    def groups(
        self, crossings: EdgeCrossings, also: Bool[np.ndarray, "V"]
    ) -> list[Int[np.ndarray, "_"]]:
        """Vertices at crossings and others that hang together with them, by edge or crossing."""
        corners = self.surface.faces[crossings.face]
        crossed = np.zeros(len(self.start), bool)
        crossed[crossings.edge] = crossed[corners] = True
        found = self.surface.groups(crossed | also, crossings.edge[:, 0], corners[:, 0])
        # A part that lies within another whole has overlap, but nothing that crosses: pushing
        # its surface inwards would shrink it to nothing.
        return [members for members in found if crossed[members].any()]

    def regions(self, crossings: EdgeCrossings) -> list[_Region]:
        push, _ = self.push(self.start)
        return [
            _Region(members, max(_SHORTEST_REACH, _REACH * np.sqrt(len(members))))
            for members in self.groups(crossings, np.linalg.norm(push, axis=1) > 0)
        ]

    def reach(self, regions: list[_Region]) -> Float[np.ndarray, "V"]:
        """How far pushes spread at each vertex; zero where nothing moves."""
        reach = np.zeros(len(self.start))
        for region in regions:
            far = min(region.reach, _LONGEST_REACH)
            near = self.surface.within(region.members, int(_PATCH * far))
            reach[near] = np.maximum(reach[near], far)
        return reach

    def stiffer(self, regions: list[_Region], left: EdgeCrossings) -> list[_Region]:
        """Regions for the next attempt: twice the reach where crossings are left."""
        nothing = np.zeros(len(self.start), bool)
        new = [_Region(members, _SHORTEST_REACH) for members in self.groups(left, nothing)]
        remaining = np.concatenate([region.members for region in new])
        grown = []
        for region in regions:
            near = self.surface.within(region.members, int(region.reach))
            factor = 2.0 if np.isin(near, remaining).any() else 1.0
            grown.append(_Region(region.members, min(factor * region.reach, _LONGEST_REACH)))
        return grown + new

    def descend(
        self, reach: Float[np.ndarray, "V"], attempt: int, most: int
    ) -> tuple[Float[np.ndarray, "V 3"], EdgeCrossings]:
        """One attempt: the vertices with the fewest crossings of all its steps, and those."""
        moving = reach > 0
        wide = Spread(self.surface, reach)
        narrow = Spread(self.surface, np.where(moving, _CONTOUR_REACH, 0.0))
        vertices = best = self.start
        left = crossings = self.crossings(vertices, moving)
        idle, seen = 0, True
        for step in range(most):
            self.on_step(attempt, self.steps, len(crossings.face))
            if not len(crossings.face) or idle >= _PATIENCE:
                break
            cast = seen or step % _MEASURE_EVERY == 0
            move, seen = self.move(vertices, crossings, wide, narrow, cast)
            vertices = vertices + move
            self.steps += 1
            crossings = self.crossings(vertices, moving)
            idle += 1
            if len(crossings.face) < len(left.face):
                best, left, idle = vertices, crossings, 0
        return best, left

    def move(
        self,
        vertices: Float[np.ndarray, "V 3"],
        crossings: EdgeCrossings,
        wide: Spread,
        narrow: Spread,
        cast: bool,
    ) -> tuple[Float[np.ndarray, "V 3"], bool]:
        """The displacement of one step, and whether the rays saw any region."""
        push, least = np.zeros(vertices.shape), np.inf
        if cast:
            push, pixel = self.push(vertices)
            least = _LEAST_VOLUME * pixel
        contour = contour_forces(self.surface.faces, vertices, crossings)
        pushed, pulled = [], []
        for members in self.groups(crossings, np.linalg.norm(push, axis=1) > 0):
            # The volume is homogeneous of degree three in the vertices, so by Euler's theorem it
            # is a third of their product with its gradient: here of this region alone.
            arm = vertices[members] - vertices[members].mean(axis=0)
            volume = float(np.sum(push[members] * arm)) / 3.0
            if volume > least:
                pushed.append((members, _OVERSTEP * volume))
            else:
                pulled.append((members, _CONTOUR_STEP * np.median(self.edge_length[members])))
        move = _newton_step(wide, push, pushed) + _sized_step(narrow, contour, pulled)
        return move, bool(pushed)

    def tighten(
        self, vertices: Float[np.ndarray, "V 3"], crossings: EdgeCrossings
    ) -> Float[np.ndarray, "V 3"]:
        """Each part of a free mesh pulled back towards the start while it stays free."""
        displacement = vertices - self.start
        moving = np.linalg.norm(displacement, axis=1) > 0
        groups = self.groups(crossings, moving)
        name = np.full(len(moving), len(groups))
        for k, members in enumerate(groups):
            name[members] = k
        low, high = np.zeros(len(groups) + 1), np.ones(len(groups) + 1)
        for _ in range(_TIGHTENINGS):
            middle = 0.5 * (low + high)
            crossed = self.crossings(self.start + middle[name][:, None] * displacement, moving)
            stuck = np.zeros(len(groups) + 1, bool)
            stuck[name[crossed.edge]] = stuck[name[self.surface.faces[crossed.face]]] = True
            low, high = np.where(stuck, middle, low), np.where(stuck, high, middle)
        tight = self.start + high[name][:, None] * displacement
        # Two parts that were pulled back by turns may meet once both are.
        return vertices if len(self.crossings(tight, moving).face) else tight


def _newton_step(
    spread: Spread, push: Float[np.ndarray, "V 3"], regions: list[tuple[np.ndarray, float]]
) -> Float[np.ndarray, "V 3"]:
    """The smallest displacement, in the sense of `spread`, that takes so much volume away."""
    forces = np.zeros(push.shape)
    if not regions:
        return forces
    size = {}
    for k, (members, _) in enumerate(regions):
        size[k] = np.linalg.norm(push[members])
        forces[members] = push[members] / size[k]
    moved = spread(forces)
    for k, (members, volume) in enumerate(regions):
        gain = size[k] * np.sum(forces[members] * moved[members])
        forces[members] *= -volume / gain if gain > 0 else 0.0
    return spread(forces)


def _sized_step(
    spread: Spread, pull: Float[np.ndarray, "V 3"], regions: list[tuple[np.ndarray, float]]
) -> Float[np.ndarray, "V 3"]:
    """A displacement along the forces, as large as asked for in each region."""
    forces = np.zeros(pull.shape)
    if not regions:
        return forces
    for members, _ in regions:
        forces[members] = pull[members]
    moved = spread(forces)
    for members, size in regions:
        largest = np.linalg.norm(moved[members], axis=1).max()
        forces[members] *= size / largest if largest > 0 else 0.0
    return spread(forces)
