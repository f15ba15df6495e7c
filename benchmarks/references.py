"""Overlap volumes and gradients by exact arithmetic, to compare with.

The triangles are cut along their intersections (libigl's interface to CGAL), so that w_out is
constant on every piece. Then the overlap's volume and the boundary integral of w_out lambda are
sums over the pieces without any quadrature. On a body that takes 3 s.
"""

from typing import NamedTuple

import igl
import numpy as np
from igl.copyleft import cgal
from jaxtyping import Float, Int

# Where the winding number of a piece is asked for: so far in front of it, in the mesh's size.
# Small against any piece that weighs anything, large against a double's rounding.
_IN_FRONT = 1e-8

# libigl stops cutting at 1,000 intersections by default.
_NO_CUTOFF = 1_000_000


class Reference(NamedTuple):
    """An overlap's volume, and its derivative with respect to the vertices."""

    volume: float
    gradient: Float[np.ndarray, "V 3"]


def exact(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Reference:
    """The overlap of a closed mesh by its triangles alone, exact to rounding.

    Args:
        vertices: of a closed, consistently wound mesh.
        faces: its triangles.

    Raises:
        ValueError: a piece of the surface has no whole winding number in front of it: the mesh
            is not closed.
    """
    found = cgal.remesh_self_intersections(vertices, faces, cutoff=_NO_CUTOFF)
    cut, pieces, origin = (np.asarray(found[k]) for k in (0, 1, 3))
    corner = cut[pieces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(normal, axis=1)
    flat = size == 0
    pieces, origin, corner, normal, size = (
        part[~flat] for part in (pieces, origin, corner, normal, size)
    )
    center = corner.mean(axis=1)
    in_front = center + _IN_FRONT * np.ptp(vertices, axis=0).max() * normal / size[:, None]
    winding = np.asarray(igl.winding_number(vertices, faces, in_front))
    if (np.abs(winding - np.rint(winding)) > 1e-3).any():
        raise ValueError(
            "the mesh must be closed: got winding numbers that are not whole; see check_mesh."
        )
    kind = np.rint(winding)

    # Divergence theorem with x / 3: each piece bounds the levels that differ by `kind` across it.
    volume = kind @ np.einsum("ki,ki->k", corner[:, 0] - vertices.mean(axis=0), normal) / 6
    # lambda is affine, so its integral over a piece is the value at the center times the area.
    weight = _barycentric(vertices[faces[origin]], center)
    force = (kind[:, None] * weight)[:, :, None] * (normal / 2)[:, None, :]
    gradient = np.zeros_like(vertices)
    np.add.at(gradient, faces[origin], force)
    return Reference(float(volume), gradient)


def _barycentric(
    corners: Float[np.ndarray, "K 3 3"], points: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "K 3"]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = corners - points[:, None]
    opposite = np.cross(np.roll(away, -1, axis=1), np.roll(away, -2, axis=1))
    weights = np.einsum("kci,ki->kc", opposite, normal)
    return weights / np.einsum("ki,ki->k", normal, normal)[:, None]
