"""Remove any closed mesh's self-intersections by moving its vertices."""

from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from spt_jax._mesh_check import check_mesh, one_mesh
from spt_jax._query import as_directions, as_rays
from spt_jax._result import Overlap, Result
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax._steps import OnStep, no_step
from spt_jax.overlap.arrays.vectors import area_normals, dot
from spt_jax.overlap.measure import Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.overlap.triangles.manifold import manifold_of
from spt_jax.untangle.freeing import Freed, free_vertices
from spt_jax.untangle.garment import SheetPlace, free_sheet
from spt_jax.untangle.places import Place
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
    fixed: Bool[Array, "V"] | np.ndarray | None = None,
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
        fixed: a mask of vertices that stay where they are, to the bit: the body that a garment is
            to be freed from. Parts with a hole, however small, are garments then, if all parts that
            are closed are fixed: they stay open, and are moved until none of their triangles
            intersects a solid's and none of their vertices lies in one (`sheet_report`); `volume`
            of the result is depth times area, as in `sheet_penalty(value="depth")`. What garments
            do to each other and to themselves is not looked at.
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
        ValueError: wrong shapes; a mask that does not fit; a mesh that is not closed but for holes
            and consistently wound, that is inside out or not finite;
            `spt_jax.overlap.measure.Unmeasurable` for one that is too crumpled, or too far from the
            origin; rays, attempts or steps_per_attempt not positive.

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
    points, triangles = one_mesh(vertices, faces)
    stays = _as_mask(fixed, len(points))
    surface = Surface(triangles, len(points))
    if stays is not None:
        garment = _garments(surface, stays)
        if garment is not None:
            check_mesh(points, surface.faces[~garment]).raise_if_unfit()
            most = attempts * steps_per_attempt
            return _without_sheets(points, surface, garment, stays, most, on_step or no_step)
    check_mesh(vertices, faces).raise_if_unfit()
    return untangle_checked(
        points,
        surface,
        sampling,
        fixed=stays,
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
    fixed: Bool[np.ndarray, "V"] | None = None,
) -> UntangleMeshResult:
    """`untangle_mesh` for a mesh that is known to be fit: many poses of one body, say.

    Args:
        vertices: positions.
        surface: of the body's faces, made once.
        sampling: how the gradient is measured.
        attempts, steps_per_attempt, on_step: as in `untangle_mesh`.
        whole_parts: whether connected parts are pushed apart as they are where no attempt did.
        fixed: vertices that stay.

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
        fixed=fixed,
    )
    return _result(
        vertices,
        surface,
        (found.start.vertices, found.best.vertices),
        before=_overlap(found.start),
        after=_overlap(found.best),
        inverted_parts=found.best.inverted,
        steps=found.steps,
        status=_status(found),
    )


def _result(given, surface: Surface, places, **values: Any) -> UntangleMeshResult:
    """With what follows from the vertices before and after."""
    start, best = places
    shift = best - start
    far, size = surface.farthest(shift), surface.part_sizes(start)
    length = np.linalg.norm(shift, axis=1)
    length = length[length > 0]
    return UntangleMeshResult(
        # Exact: the search ends on values of this dtype. What did not move is what was given.
        vertices=best.astype(given.dtype) if len(length) else given.copy(),
        moved=len(length),
        median_displacement=float(np.median(length)) if len(length) else 0.0,
        largest_displacement=float(length.max(initial=0.0)),
        relative_displacement=float((far / np.where(size > 0, size, 1.0)).max(initial=0.0)),
        flipped_triangles=_flipped(start, best, surface),
        **values,
    )


def _as_mask(fixed: Any, count: int) -> Bool[np.ndarray, "V"] | None:
    if fixed is None:
        return None
    mask = np.asarray(fixed)
    if mask.dtype != bool or mask.shape != (count,):
        raise ValueError(
            f"fixed must be a mask, one of True and False for each of the {count} vertices: got "
            f"an array of {mask.dtype} of shape {mask.shape}; np.isin(np.arange({count}), indices) "
            "makes one of indices."
        )
    return mask


def _garments(surface: Surface, fixed: Bool[np.ndarray, "V"]) -> Bool[np.ndarray, "F"] | None:
    """The faces of open parts that may move, where all other parts are fixed; None if not so."""
    manifold = manifold_of(surface.faces, surface.num_vertices)
    rim = np.zeros(surface.num_parts, bool)
    for loop in manifold.loops[: manifold.num_fans]:
        rim[surface.part[loop]] = True
    part = surface.part[surface.faces[:, 0]]
    whole = np.bincount(part, fixed[surface.faces].all(axis=1), surface.num_parts)
    still = whole == np.bincount(part, minlength=surface.num_parts)
    garment = rim & ~still
    used = np.bincount(part, minlength=surface.num_parts) > 0
    if not garment.any() or not still[used & ~garment].all() or not (used & ~garment).any():
        return None
    return garment[part]


def _without_sheets(
    points, surface: Surface, garment, fixed, most: int, on_step: OnStep
) -> UntangleMeshResult:
    before, after, steps = free_sheet(surface, points, garment, fixed, most=most, on_step=on_step)
    free = not after.found.pairs and not after.inside.any()

    def overlap(place: SheetPlace) -> Overlap:
        ratio = float(np.mean(place.inside)) if len(place.inside) else 0.0
        numbers: Any = (place.volume, place.volume, ratio, place.found.pairs, place.found.pairs)
        return Overlap(*numbers)

    ran_out = RESULTS.nonlinear_max_steps_reached
    return _result(
        points,
        surface,
        (before.vertices, after.vertices),
        before=overlap(before),
        after=overlap(after),
        inverted_parts=0,
        steps=steps,
        status=RESULTS.successful if free else ran_out,
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
