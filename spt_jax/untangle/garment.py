"""The search behind `untangle_mesh(fixed=)` for open sheets: a garment taken out of a body.

A sheet has no overlap volume to push along. But each of its vertices that lies in a solid knows
the nearest place on the solids' surface, and so how it would have to move. Those displacements are
wished for, and the sheet follows in the least thin-plate energy (Botsch and Sorkine 2008, "On
linear variational surface deformation methods"), so that what lies between comes along and the
cloth keeps its shape. Where triangles still intersect although no vertex is inside, a solid's edge
or tip comes through the cloth: the triangle's corners go outwards along the solid's normal.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from spt_jax._steps import OnStep, Step
from spt_jax.overlap.arrays.vectors import area_normals, summed
from spt_jax.overlap.sheets import SheetInSolids
from spt_jax.untangle.spread import Surface

# What is left between sheet and solids, in mean edges of the sheet, and by how much it grows from
# step to step where triangles still intersect.
_GAP, _MORE = 0.02, 1.3
# How far a wish is felt, in edges, and how stiff the sheet is against a wish.
_REACH, _STIFFNESS = 3.0, 0.1
# Halvings of the way back, at the end.
_HALVINGS = 4


@dataclass(frozen=True, eq=False)
class SheetPlace:
    """Vertices that the search came by, measured.

    Attributes:
        vertices: of the solids and of the sheet, in the order given.
        found: how the sheet lies in the solids.
        volume: depth times area inside, summed up over the vertices.
        inside: which vertices lie in a solid.
    """

    vertices: Float[np.ndarray, "V 3"]
    found: SheetInSolids
    volume: float
    inside: Bool[np.ndarray, "V"]

    @property
    def rank(self) -> tuple[int, int, float]:
        """Sorts places, the best first."""
        return self.found.pairs, int(np.count_nonzero(self.inside)), self.volume


def free_sheet(
    surface: Surface,
    vertices: Float[np.ndarray, "V 3"],
    is_sheet: Bool[np.ndarray, "F"],
    fixed: Bool[np.ndarray, "V"],
    *,
    most: int,
    on_step: OnStep,
) -> tuple[SheetPlace, SheetPlace, int]:
    """The sheet out of the solids, as far as it goes; the solids stay where they are.

    Args:
        surface: the mesh's graph.
        vertices: float32 or float64; what intersects is judged at values of this dtype.
        is_sheet: of each of the surface's faces, whether it is the sheet's; others are solids'.
        fixed: vertices that stay.
        most: at most so many steps.
        on_step: called with a `Step` before each step.

    Returns:
        The place given, the best one found, and the steps taken.

    Raises:
        Unmeasurable: solids or sheet that cannot be measured as they are given.
    """
    # A first list of faces, the solids', and then the sheet's.
    order = np.argsort(is_sheet, kind="stable")
    faces, solids = surface.faces[order], int(np.count_nonzero(~is_sheet))
    own = np.unique(faces[solids:])
    moving = own[~fixed[own]]
    dtype, rounding = vertices.dtype, float(np.finfo(vertices.dtype).eps)

    def look(at: np.ndarray) -> SheetPlace:
        at = at.astype(dtype).astype(np.float64)
        found = SheetInSolids(at, faces, solids, rounding)
        return SheetPlace(at, found, found.depth()[0], found.winding != 0)

    start = best = place = look(vertices.astype(np.float64))
    edge = float(np.median(surface.edge_length(start.vertices)[own]))
    bend = _bending(surface, moving)
    gap, steps = _GAP * edge, 0
    for _ in range(most):
        state = place
        on_step(
            Step(
                0,
                steps,
                place.vertices.astype(dtype),
                None,
                lambda state=state: (state.volume, state.found.pairs),
            )
        )
        if not place.found.pairs and not place.inside[moving].any():
            break
        steps += 1
        moved = place.vertices.copy()
        moved[moving] += _step(place, moving, bend, gap)
        place = look(moved)
        if place.rank < best.rank:
            best = place
        gap *= _MORE
    if best is not start and not best.found.pairs and not best.inside[moving].any():
        best = _pulled_back(start, best, look)
    return start, best, steps


def _pulled_back(
    start: SheetPlace, free: SheetPlace, look: Callable[[np.ndarray], SheetPlace]
) -> SheetPlace:
    """The place as near to the start, along the way to it, as stays free."""
    low, high, nearest = 0.0, 1.0, free
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        there = look(start.vertices + middle * (free.vertices - start.vertices))
        if there.found.pairs or there.inside.any():
            low = middle
        else:
            high, nearest = middle, there
    return nearest


def _bending(surface: Surface, moving: Int[np.ndarray, "M"]) -> Any:
    """The thin-plate energy of displacements of these vertices; others stay."""
    laplacian = surface.laplacian[:, moving] * (_REACH**2 / 6.0)
    return (laplacian.T @ laplacian).tocsc()


def _step(
    place: SheetPlace, moving: Int[np.ndarray, "M"], bend: Any, gap: float
) -> Float[np.ndarray, "M 3"]:
    """Displacements of the vertices that may move."""
    wish, weight = _wishes(place, gap)
    weight = weight[moving]
    form = scipy.sparse.diags(weight + 1e-6) + _STIFFNESS * bend
    return scipy.sparse.linalg.splu(form.tocsc()).solve(weight[:, None] * wish[moving])


def _wishes(place: SheetPlace, gap: float):
    """Where vertices would go, and the weight of each."""
    found, count = place.found, len(place.vertices)
    wish, weight = np.zeros((count, 3)), np.zeros(count)
    at, nearest = found.nearest()
    out = nearest - place.vertices[at]
    depth = np.linalg.norm(out, axis=1, keepdims=True)
    wish[at] = out * (1.0 + gap / np.where(depth > 0, depth, np.inf))
    weight[at] = 1.0
    sheet, solid = found.intersecting()
    if len(sheet):
        normal = area_normals(place.vertices, solid)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
        # How far the solid's triangle sticks out, along its own normal.
        tips = np.einsum("nkc,nc->nk", place.vertices[solid], normal).max(axis=1)
        corners = np.einsum("nkc,nc->nk", place.vertices[sheet], normal)
        lift = np.clip(tips[:, None] - corners, 0.0, None) + gap
        vertex = sheet.ravel()
        times = np.bincount(vertex, minlength=count)
        pull = summed(vertex, (lift[:, :, None] * normal[:, None]).reshape(-1, 3), count)
        outside = (times > 0) & (weight == 0)
        wish[outside] = pull[outside] / times[outside, None]
        weight[outside] = 1.0
    return wish, weight
