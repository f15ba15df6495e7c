"""Remove any closed mesh's self-intersections by moving its vertices."""

from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax._mesh_check import check_mesh, one_mesh
from spt_jax._query import as_directions, as_rays
from spt_jax._result import Overlap, Result
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax._steps import OnStep, no_step
from spt_jax.overlap.measure import Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.overlap.vectors import area_normals, dot
from spt_jax.untangle.freeing import Freed, Place, free_vertices
from spt_jax.untangle.spread import Surface


class UntangleMeshResult(Result):
    """What `untangle_mesh` found.

    Attributes:
        vertices: the mesh's new positions, in the dtype given.
        before, after: the overlap of the mesh given and of the mesh found, measured exactly.
        moved: how many vertices are not where they were.
        median_displacement, largest_displacement: of those, in the mesh's unit; 0.0 for none.
        relative_displacement: the largest displacement against the size of the connected part that
            it belongs to, the diagonal of the box around it; at most 1.
        inverted_parts: connected parts that were turned inside out; always 0, because such a mesh
            is not returned.
        flipped_triangles: triangles whose normal turned by more than 90 degrees.
        steps: of the search, over all attempts.
        status: how it ended, one of `spt_jax.RESULTS`.

    Example:
        >>> import trimesh
        >>> from spt_jax import untangle_mesh
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.1, 0.2]))
        >>> found = untangle_mesh(pair.vertices, pair.faces)
        >>> found.is_free, found.before.intersecting_pairs > 0, found.largest_displacement < 0.2
        (True, True, True)
    """

    vertices: Float[np.ndarray, "V 3"]
    before: Overlap
    after: Overlap
    moved: int
    median_displacement: float
    largest_displacement: float
    relative_displacement: float
    inverted_parts: int
    flipped_triangles: int
    steps: int
    status: RESULTS

    @property
    def is_free(self) -> bool:
        """Whether no triangles intersect, nothing overlaps, and no part was turned inside out."""
        return bool(self.status == RESULTS.successful)

    @property
    def reason(self) -> str:
        """The status in words."""
        return in_words(self.status, {"successful": "intersection-free"})

    def as_dict(self) -> dict[str, Any]:
        """All but the vertices, as JSON types."""
        return {
            "is_free": self.is_free,
            "status": names_of(self.status),
            "reason": self.reason,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "moved": self.moved,
            "median_displacement": self.median_displacement,
            "largest_displacement": self.largest_displacement,
            "relative_displacement": self.relative_displacement,
            "inverted_parts": self.inverted_parts,
            "flipped_triangles": self.flipped_triangles,
            "steps": self.steps,
        }


def untangle_mesh(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    *,
    rays: Rays = None,
    directions: Any = 3,
    attempts: int = 4,
    steps_per_attempt: int = 40,
    on_step: OnStep | None = None,
) -> UntangleMeshResult:
    r"""The mesh with its vertices moved until no triangles intersect, and never a worse one.

    Each region of overlap takes Newton steps towards no volume along the gradient g of
    `self_intersection_penalty`: of all displacements u with g . u = -V to first order, the one of
    least

        \|u\|^2 + \|s^2 L u / 6\|^2,

    the thin-plate energy of Botsch and Sorkine 2008 ("On linear variational surface deformation
    methods") with the graph's Laplacian L; s grows with the region. What has next to no volume, the
    last intersections of folds above all, goes by shortening the curve along which the surface
    intersects itself (Volino and Magnenat-Thalmann 2006, "Resolving surface collisions through
    intersection contour minimization"). Where an attempt leaves intersections, the next starts anew
    with twice the s there; where none leaves nothing, connected parts that intersect each other are
    pushed apart as they are. At the end the displacement of each part is scaled down as far as the
    mesh stays intersection-free, and vertices to which it has all but faded go back.

    Every place that the search comes by is measured exactly. It is taken only where it has neither
    more intersecting pairs nor more overlap than the mesh given, and where no connected part is
    inside out, or within another, that was not before. Parts that intersect nothing do not move,
    and no vertex moves farther than its part is large.

    Contact is no intersection: solids that touch, and flat faces that lie on each other, stay as
    they are. A part that lies within another whole, or upon a copy of its own, overlaps it but
    intersects nothing; it is left there, and `is_free` is False.

    Args:
        vertices: positions of one mesh, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside. The mesh
            must be closed and consistently wound; it need not be connected.
        rays: as in `self_intersection_penalty`, for the gradient that the search follows; what is
            compared and reported is exact in any case.
        directions: as in `self_intersection_penalty`.
        attempts: at most so many, each from the vertices given.
        steps_per_attempt: at most so many steps in each attempt.
        on_step: called with a `spt_jax.Step` before each step; what it raises ends the search.

    Returns:
        The vertices of the first attempt that is intersection-free, else the best ones found: see
        `is_free`. A
        mesh without intersections comes back to the bit, and so do vertices far from any.

    Raises:
        TypeError: vertices not float32 or float64, or traced; faces not whole numbers; rays or
            directions that are no numbers.
        ValueError: wrong shapes; a mesh that is not closed and consistently wound, that is inside
            out or not finite; `spt_jax.overlap.measure.Unmeasurable` for one that is too crumpled,
            or too far from the origin; rays, attempts or steps_per_attempt not positive.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax import untangle_mesh
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.0, 0.0]))
        >>> result = untangle_mesh(np.asarray(pair.vertices), pair.faces)
        >>> result.is_free, bool(result.largest_displacement < 0.15)
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
    whole_parts: bool = True,
    on_step: OnStep | None = None,
) -> UntangleMeshResult:
    """`untangle_mesh` for a mesh that is known to be fit: many poses of one body, say.

    Args:
        vertices: positions.
        surface: of the body's faces, made once.
        sampling: how the gradient is measured.
        attempts, steps_per_attempt, on_step: as in `untangle_mesh`.
        whole_parts: whether connected parts are pushed apart as they are where no attempt did.

    Raises:
        Unmeasurable: there is no surface that could be measured.
    """
    found = free_vertices(
        surface,
        vertices,
        sampling,
        attempts=attempts,
        steps_per_attempt=steps_per_attempt,
        whole_parts=whole_parts,
        on_step=on_step or no_step,
    )
    start, best = found.start.vertices, found.best.vertices
    shift = best - start
    far, size = surface.farthest(shift), surface.part_sizes(start)
    length = np.linalg.norm(shift, axis=1)
    length = length[length > 0]
    return UntangleMeshResult(
        # Exact: the search ends on values of this dtype. What did not move is what was given.
        vertices=best.astype(vertices.dtype) if len(length) else vertices.copy(),
        before=_overlap(found.start),
        after=_overlap(found.best),
        moved=len(length),
        median_displacement=float(np.median(length)) if len(length) else 0.0,
        largest_displacement=float(length.max(initial=0.0)),
        relative_displacement=float((far / np.where(size > 0, size, 1.0)).max(initial=0.0)),
        inverted_parts=found.best.inverted,
        flipped_triangles=_flipped(start, best, surface),
        steps=found.steps,
        status=_status(found),
    )


def _status(found: Freed) -> Any:
    if not found.best.pairs:
        return RESULTS.successful if found.best.volume == 0 else RESULTS.enclosed
    if found.diverged:
        return RESULTS.nonlinear_divergence
    return RESULTS.nonlinear_max_steps_reached if found.ran_out else RESULTS.intersections_left


def _overlap(place: Place) -> Overlap:
    ratio = float(np.mean(place.labels != 0)) if len(place.labels) else 0.0
    numbers: Any = (place.volume, place.volume, ratio, place.pairs, place.pairs)
    return Overlap(*numbers)


def _flipped(before, after, surface: Surface) -> int:
    first, second = (area_normals(points, surface.faces) for points in (before, after))
    return int(np.count_nonzero(dot(first, second) < 0))
