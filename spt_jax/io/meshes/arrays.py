"""Vertices and faces checked, and what single precision does to them."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

# What rounding to float32 may move vertices by, against the size of the mesh, and not be seen: near
# the origin it does by a tenth of that.
_MOST_ROUNDING = 1e-6


def as_mesh_arrays(
    vertices: Any, faces: Any, labels: Any = None
) -> tuple[
    Float[np.ndarray, "V 3"],
    Int[np.ndarray, "F 3"],
    Int[np.ndarray, " V"],
]:
    """Return (vertices float64, faces int64, labels int8) once they make one mesh.

    Raises:
        ValueError: a shape, a type, an index or a label that does not, or NaN or infinity.
    """
    points, triangles = np.asarray(vertices), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise ValueError(f"vertices must be (V, 3) numbers: got {points.dtype} {points.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must be (F, 3) integers: got {triangles.dtype} {triangles.shape}")
    if len(triangles) == 0:
        raise ValueError("faces must hold at least one triangle: got none")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(f"vertices must be finite: got {points[row]} at vertex {row}")
    low, high = int(triangles.min()), int(triangles.max())
    if low < 0 or high >= len(points):
        raise ValueError(
            f"faces must index into vertices: got index {low if low < 0 else high} for "
            f"{len(points)} vertices; indices are 0-based"
        )
    label = np.zeros(len(points), np.int8) if labels is None else np.asarray(labels)
    if label.shape != (len(points),) or not np.isin(label, (-1, 0, 1)).all():
        raise ValueError(
            f"labels must be 0, +1 or -1 for each of {len(points)} vertices: got "
            f"{label.dtype} {label.shape} with values {np.unique(label)[:5]}"
        )
    return points.astype(np.float64), triangles.astype(np.int64), label.astype(np.int8)


def single_rounding(vertices: Float[np.ndarray, "V 3"]) -> float:
    """How far float32 moves a coordinate at most; 0 where it holds all of them exactly."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(vertices.astype(np.float32) - vertices).max(initial=0.0))


def fits_single(vertices: Float[np.ndarray, "V 3"]) -> bool:
    """Whether float32 moves vertices by so little that nobody sees it."""
    with np.errstate(invalid="ignore"):
        size = np.ptp(vertices, axis=0).max(initial=0.0)
    return bool(single_rounding(vertices) <= _MOST_ROUNDING * size)
