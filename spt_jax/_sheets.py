"""An open sheet beside closed solids, such as a garment on a body: what of it lies inside."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int8, Integer

from spt_jax._mesh_check import one_mesh
from spt_jax._penalty import Known, differentiable
from spt_jax._query import as_choice, as_faces, as_vertices
from spt_jax._result import Result
from spt_jax.bridge.reverse_only import refuse_forward
from spt_jax.overlap.arrays.vectors import area_normals
from spt_jax.overlap.host_functions import SheetOptions, SheetValue
from spt_jax.overlap.labels import CLEAR, PENETRATING
from spt_jax.overlap.sheets import SheetInSolids


def sheet_penalty(
    vertices: Float[Array, "*#batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    solid_vertices: Float[Array, "*#batch W 3"] | np.ndarray,
    solid_faces: Integer[Array, "G 3"] | np.ndarray,
    *,
    value: SheetValue = "area",
) -> Float[Array, "..."]:
    r"""How much of an open sheet lies inside closed solids, as a loss with its own exact gradient.

    A garment, a sail, a part of a scan: a sheet has no inside, so that
    `self_intersection_penalty` refuses it, and beside solids measures what a fan would make of it.
    Here it stays open, and overlaps the solids where it lies in them. Nothing else counts: neither
    what the sheet or the solids do to themselves, nor solids that enclose nothing of the sheet.

    Args:
        vertices: positions of one sheet or of a batch that shares its faces, in any unit.
        faces: of the sheet; which side is out does not matter.
        solid_vertices: positions of the solids, as many meshes or one.
        solid_faces: counter-clockwise seen from outside; the solids must be closed but for small
            holes (`check_mesh`), and need not be connected.
        value: "area", the area of the sheet inside, in the square of the unit, where k solids
            overlap k times: exact, with the derivative of its outline and its stretching, so that
            what lies inside whole feels only the latter. "depth", the sum over the sheet's vertices
            inside of the distance to the solids' surface times a third of the area of the triangles
            around, in the cube of the unit: it pulls out what lies deep inside, and is zero where
            the sheet is only cut between its vertices.

    Returns:
        One number per mesh, in the vertices' dtype; NaN, with a zero gradient, where a vertex is
        not finite or the solids have a hole that is too large to be closed.

    Raises:
        TypeError: vertices not float32 or float64, or of two dtypes; faces not whole numbers, or
            traced.
        ValueError: wrong shapes; batch axes that do not broadcast; a face out of range; an unknown
            option.

    Differentiation: as `self_intersection_penalty`, by both kinds of vertices.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax import sheet_penalty
        >>> box = trimesh.creation.box()
        >>> sheet = np.array([[-2.0, -2.0, 0.1], [2.0, -2.0, 0.1], [0.0, 4.0, 0.1]])
        >>> print(sheet_penalty(sheet, [[0, 1, 2]], np.array(box.vertices), box.faces).round(4))
        1.0
    """
    sheet, solid = as_vertices(vertices), as_vertices(solid_vertices)
    if sheet.dtype != solid.dtype:
        raise TypeError(
            f"vertices and solid_vertices must have one dtype: got {sheet.dtype} and {solid.dtype}."
        )
    for name, given in (("faces", faces), ("solid_faces", solid_faces)):
        if isinstance(given, Tracer):
            raise TypeError(f"{name} must be known when traced: got a traced array; use NumPy.")
    try:
        batch = jnp.broadcast_shapes(sheet.shape[:-2], solid.shape[:-2])
    except ValueError:
        raise ValueError(
            f"batch axes must broadcast: got vertices of shape {sheet.shape} and solid_vertices of "
            f"shape {solid.shape}."
        ) from None
    both = jnp.concatenate(
        [jnp.broadcast_to(x, (*batch, *x.shape[-2:])) for x in (solid, sheet)], axis=-2
    )
    own, other = as_faces(faces, sheet.shape[-2]), as_faces(solid_faces, solid.shape[-2])
    together = _joined(np.asarray(own), np.asarray(other), solid.shape[-2])
    options = SheetOptions(
        as_choice("value", value, SheetValue), len(other), float(np.finfo(sheet.dtype).eps)
    )
    return differentiable(options, Known(together), refuse_forward(both), ())


class SheetReport(Result):
    """How an open sheet lies in solids; printing it shows a table.

    Attributes:
        area: of the sheet inside, in the square of the unit.
        total_area: of the whole sheet.
        depth: the largest distance from a vertex inside to the solids' surface, in the unit.
        deepest: that vertex of the sheet; -1 where none is inside.
        depths: of every vertex; 0 outside.
        intersecting_pairs: triangles of the sheet and of the solids that intersect.
    """

    area: float
    total_area: float
    depth: float
    deepest: int
    depths: Float[np.ndarray, "V"]
    intersecting_pairs: int

    @property
    def labels(self) -> Int8[np.ndarray, "V"]:
        """1 for vertices in a solid, penetrating, and 0 for clear ones; as `classify_vertices`."""
        return np.where(self.depths > 0, PENETRATING, CLEAR).astype(np.int8)

    @property
    def is_free(self) -> bool:
        """Whether nothing of the sheet lies in a solid or passes through its surface."""
        return not (self.intersecting_pairs or self.area > 0)

    def as_dict(self) -> dict[str, Any]:
        """All but the vertices' depths, as JSON types."""
        return {
            "is_free": self.is_free,
            "area": self.area,
            "total_area": self.total_area,
            "depth": self.depth,
            "deepest": self.deepest,
            "vertices_inside": int(np.count_nonzero(self.depths)),
            "intersecting_pairs": self.intersecting_pairs,
        }


def sheet_report(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    solid_vertices: Float[Array, "W 3"] | np.ndarray,
    solid_faces: Integer[Array, "G 3"] | np.ndarray,
) -> SheetReport:
    """How much of an open sheet lies inside closed solids, how deep, and where.

    Args:
        vertices, faces, solid_vertices, solid_faces: one sheet and its solids, as in
            `sheet_penalty`.

    Returns:
        The report, measured in float64.

    Raises:
        TypeError, ValueError: as `sheet_penalty`, and ValueError for a batch, for vertices that are
            not finite, or solids with a hole that is too large to be closed; the message says why.

    Differentiation: none; for use outside jit.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax import sheet_report
        >>> box = trimesh.creation.box()
        >>> sheet = np.array([[-2.0, -2.0, 0.1], [2.0, -2.0, 0.1], [0.0, 0.0, 0.1]])
        >>> report = sheet_report(sheet, [[0, 1, 2]], np.array(box.vertices), box.faces)
        >>> report.deepest, round(report.depth, 2), report.is_free
        (2, 0.4, False)
    """
    sheet, own = one_mesh(vertices, faces)
    solid, other = one_mesh(solid_vertices, solid_faces)
    rounding = float(max(np.finfo(x.dtype).eps for x in (sheet, solid)))
    points = np.concatenate([solid.astype(np.float64), sheet.astype(np.float64)])
    together = _joined(own, other, len(solid))
    found = SheetInSolids(points, together, len(other), rounding)
    depths = found.depths[len(solid) :]
    normals = area_normals(points, together[len(other) :])
    return SheetReport(
        area=found.area()[0],
        total_area=float(0.5 * np.linalg.norm(normals, axis=1).sum()),
        depth=float(depths.max(initial=0.0)),
        deepest=int(depths.argmax()) if depths.any() else -1,
        depths=depths,
        intersecting_pairs=found.pairs,
    )


def _joined(sheet: np.ndarray, solid: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([solid.astype(np.int64), sheet.astype(np.int64) + count])
