"""Freeing any closed mesh of its self-intersections by moving its vertices."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax.arguments import as_directions, as_rays
from spt_jax.mesh_check import check_mesh, one_mesh
from spt_jax.overlap.measure import Directions, Sampling, measure
from spt_jax.overlap.triangles.pairs import edge_crossings
from spt_jax.untangle.freeing import free_vertices
from spt_jax.untangle.spread import Surface

# The search needs no more: the last crossings go by their contours, which no ray has to see.
SEARCH_RAYS = 256


@dataclass(frozen=True)
class MeshOverlap:
    """How much of a mesh is in self-intersection.

    Attributes:
        volume: the overlap volume, in the cube of the mesh's unit.
        ratio: the part of the vertices in it (paper, Eq. 11).
        crossings: how often an edge passes through a triangle that it does not touch.
    """

    volume: float
    ratio: float
    crossings: int


@dataclass(frozen=True, eq=False)
class UntangleMeshResult:
    """What `untangle_mesh` found.

    Attributes:
        vertices: the mesh's new positions, in the dtype given.
        before, after: the overlap of the mesh given and of the mesh found.
        moved: how many vertices are not where they were.
        median_displacement, largest_displacement: of those, in the mesh's unit; 0.0 for none.
        steps: of the search, over all attempts.

    Example:
        >>> import trimesh
        >>> from spt_jax import untangle_mesh
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.1, 0.2]))
        >>> found = untangle_mesh(pair.vertices, pair.faces)
        >>> found.free, found.before.crossings > 0, found.largest_displacement < 0.2
        (True, True, True)
    """

    vertices: Float[np.ndarray, "V 3"]
    before: MeshOverlap
    after: MeshOverlap
    moved: int
    median_displacement: float
    largest_displacement: float
    steps: int

    @property
    def free(self) -> bool:
        """Whether no edge passes through a triangle any more."""
        return self.after.crossings == 0

    def as_dict(self) -> dict[str, Any]:
        """All but the vertices, for JSON."""
        return {
            "free": self.free,
            "before": asdict(self.before),
            "after": asdict(self.after),
            "moved": self.moved,
            "median_displacement": self.median_displacement,
            "largest_displacement": self.largest_displacement,
            "steps": self.steps,
        }


def untangle_mesh(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    *,
    rays: int = SEARCH_RAYS,
    directions: Any = 3,
    attempts: int = 4,
    steps_per_attempt: int = 40,
    on_step: Callable[[int, int, int], None] | None = None,
) -> UntangleMeshResult:
    r"""The mesh with its vertices moved until no triangle passes through another.

    Each region of overlap takes Newton steps towards no volume along the gradient g of
    `self_intersection_penalty`: of all displacements u with g . u = -V to first order, the one of
    least

        \|u\|^2 + \|s^2 L u / 6\|^2,

    the thin-plate energy of Botsch and Sorkine 2008 ("On linear variational surface deformation
    methods") with the graph's Laplacian L; s grows with the region. What the rays do not see any
    more, the last crossings of folds above all, goes by shortening the curve along which the
    surface crosses itself (Volino and Magnenat-Thalmann 2006, "Resolving surface collisions
    through intersection contour minimization"). Where an attempt leaves crossings, the next
    starts anew with twice the s there. At the end the displacement of each part is scaled down as
    far as the mesh stays free. Only vertices around intersections move.

    A part that lies within another whole has overlap, but crosses nothing, and is left there:
    `after.volume` tells.

    Args:
        vertices: positions of one mesh, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside. The mesh
            must be closed and consistently wound; it need not be connected.
        rays: as in `self_intersection_penalty`, for the search; more do not free more.
        directions: as in `self_intersection_penalty`.
        attempts: at most so many, each from the vertices given.
        steps_per_attempt: at most so many steps in each attempt.
        on_step: called before each step with the index of the attempt, the steps so far and the
            number of crossings.

    Returns:
        The first attempt's vertices that are free of crossings, else those with the fewest: look
        at `free`. A mesh without crossings comes back to the bit, and so do vertices far from any.

    Raises:
        TypeError: vertices not float32 or float64, or traced; faces not whole numbers; rays or
            directions that are no numbers.
        ValueError: wrong shapes; a mesh that is not closed and consistently wound, that is inside
            out or not finite; rays, attempts or steps_per_attempt not positive.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax import untangle_mesh
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.0, 0.0]))
        >>> result = untangle_mesh(np.asarray(pair.vertices), pair.faces)
        >>> result.free, bool(result.largest_displacement < 0.15)
        (True, True)
    """
    if isinstance(vertices, Tracer) or isinstance(faces, Tracer):
        raise TypeError(
            "vertices and faces must be known: got a traced array; untangle_mesh decides by the "
            "values that it sees, so call it outside jit, vmap and grad."
        )
    for name, count in (("attempts", attempts), ("steps_per_attempt", steps_per_attempt)):
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"{name} must be a positive whole number: got {count!r}.")
    sampling = Sampling(as_rays(rays), as_directions(directions))
    check_mesh(vertices, faces).raise_if_unfit()
    points, triangles = one_mesh(vertices, faces)
    return untangle_checked(
        points,
        Surface(triangles, len(points)),
        sampling,
        attempts=int(attempts),
        steps_per_attempt=int(steps_per_attempt),
        on_step=on_step,
    )


def untangle_checked(
    vertices: Float[np.ndarray, "V 3"],
    surface: Surface,
    sampling: Sampling,
    *,
    attempts: int = 4,
    steps_per_attempt: int = 40,
    on_step: Callable[[int, int, int], None] | None = None,
) -> UntangleMeshResult:
    """`untangle_mesh` for a mesh that is known to be fit: many poses of one body, say.

    Args:
        vertices: finite positions.
        surface: of the body's faces, made once.
        sampling: the rays.
        attempts, steps_per_attempt, on_step: as in `untangle_mesh`.
    """
    found = free_vertices(
        surface,
        vertices,
        sampling,
        attempts=attempts,
        steps_per_attempt=steps_per_attempt,
        on_step=on_step or _nothing,
    )
    freed = found.vertices.astype(vertices.dtype)  # exact: the search ends on values of this dtype
    shift = np.linalg.norm(found.vertices - vertices.astype(np.float64), axis=1)
    shift = shift[shift > 0]
    before = _overlap(vertices, surface, sampling.directions)
    return UntangleMeshResult(
        vertices=freed,
        before=before,
        after=_overlap(freed, surface, sampling.directions) if len(shift) else before,
        moved=len(shift),
        median_displacement=float(np.median(shift)) if len(shift) else 0.0,
        largest_displacement=float(shift.max(initial=0.0)),
        steps=found.steps,
    )


def _overlap(
    vertices: Float[np.ndarray, "V 3"], surface: Surface, directions: Directions
) -> MeshOverlap:
    points = vertices.astype(np.float64)
    if not len(surface.faces):
        return MeshOverlap(0.0, 0.0, 0)
    found = measure(points, surface.faces, Sampling("auto", directions))
    return MeshOverlap(
        volume=float(found.volume),
        ratio=float(np.mean(found.labels("vertex") != 0)),
        crossings=len(edge_crossings(points, surface.faces).face),
    )


def _nothing(attempt: int, steps: int, crossings: int) -> None:
    pass
