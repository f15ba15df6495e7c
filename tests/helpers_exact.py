"""The overlap of a closed mesh by exact arithmetic: its triangles cut along their intersections."""

import igl
import numpy as np
from helpers import Mesh
from igl.copyleft import cgal

# Where a piece is asked for the winding number in front of it: so far off, in the mesh's size.
_IN_FRONT = 1e-8

# libigl stops cutting at 1,000 intersections by default.
_NO_CUTOFF = 1_000_000


def exact_overlap(mesh: Mesh) -> tuple[float, np.ndarray]:
    """Volume and gradient, with CGAL's cuts and libigl's winding numbers.

    On every piece w_out is constant, so the divergence theorem gives the integral of w (w - 1) / 2,
    and w_out times the corner's weight at the piece's center the gradient.
    """
    vertices, faces = mesh
    cut, pieces, _, origin, *_ = cgal.remesh_self_intersections(vertices, faces, cutoff=_NO_CUTOFF)
    corner = np.asarray(cut)[np.asarray(pieces)]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(normal, axis=1)
    kept = size > 0
    corner, normal, origin = corner[kept], normal[kept], np.asarray(origin)[kept]
    center = corner.mean(axis=1)
    ahead = _IN_FRONT * np.ptp(vertices, axis=0).max() * normal / size[kept, None]
    winding = np.asarray(igl.winding_number(vertices, faces, center + ahead))
    kind = np.rint(winding)
    volume = kind @ np.einsum("ki,ki->k", corner[:, 0] - vertices.mean(axis=0), normal) / 6

    whole = vertices[faces[origin]]
    area = np.cross(whole[:, 1] - whole[:, 0], whole[:, 2] - whole[:, 0])
    gradient = np.zeros_like(vertices)
    for k in range(3):
        second, third = (whole[:, (k + step) % 3] - center for step in (1, 2))
        opposite = np.cross(second, third)
        weight = np.einsum("ki,ki->k", opposite, area) / np.einsum("ki,ki->k", area, area)
        np.add.at(gradient, faces[origin, k], (kind * weight)[:, None] * normal / 2)
    return float(volume), gradient
