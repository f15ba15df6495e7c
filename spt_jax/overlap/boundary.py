"""The gradient of the overlap volume, as one vector per vertex.

Moving the surface with velocity v changes the overlap volume, the integral of w (w - 1) / 2, by
that of w_out (v . n) over the surface: a point that it sweeps goes from w_out to w_out + 1. With
linear triangles the gradient at vertex t is the sum over its triangles of n times the integral of
w_out lambda_t; where w_out is the same all around t, and 0, 1 or -1, which is the label of
Algorithm 1, that is the paper's Eq. 9. Rays are a quadrature of the integral: a crossing stands
for the surface area a / |n . d| of its triangle.
"""

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import area_normals, summed
from spt_jax.overlap.rays.beam import Beam
from spt_jax.overlap.rays.levels import Overlaps


def boundary_gradient(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    beam: Beam,
    overlaps: Overlaps,
    directions: Float[np.ndarray, "D 3"],
) -> Float[np.ndarray, "V 3"]:
    """One beam's share of the boundary integral; the beams' shares add up to the gradient.

    Each crossing is weighed by (n . d)^2 / sum over all directions d' of (n . d')^2. With a
    single direction the weight is one and the result is the exact derivative of the beam's
    volume; with several, a grazing crossing, whose area is unbounded and badly sampled, weighs
    next to nothing and the directions that see its triangle well take over.
    """
    corners = faces[overlaps.ends.ravel()]
    normal = area_normals(vertices, corners)
    # The weight does not depend on the normal's length; squares of tiny or huge ones would.
    x, y, z = np.abs(normal).T
    longest = np.maximum(np.maximum(x, y), z)
    normal = normal / np.where(longest > 0, longest, 1.0)[:, None]
    cosines = normal @ directions.T
    seen = np.einsum("kd,kd->k", cosines, cosines)
    # area * (n.d)^2 / sum (n.d')^2 * n, with lengths of normals cancelling: no root, no division
    # by a cosine that may vanish.
    weight = np.repeat(overlaps.outer, 2) * np.abs(normal @ beam.direction) * beam.ray_area
    weight = weight / np.where(seen > 0, seen, 1.0)
    force = weight[:, None] * normal
    shares = overlaps.barycentric.reshape(-1, 3, 1) * force[:, None, :]
    return summed(corners.ravel(), shares.reshape(-1, 3), len(vertices))


def vertex_gradient(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    label: Int[np.ndarray, "V"],
    *,
    unit: bool,
) -> Float[np.ndarray, "V 3"]:
    """The paper's gradient: Eq. 9, or Eq. 10 where `unit` (zero where the normals cancel)."""
    if not label.any():
        return np.zeros(vertices.shape)
    touching = np.flatnonzero((label != 0)[faces].any(axis=1))
    corners = faces[touching]
    normal = area_normals(vertices, corners)
    gradient = summed(corners.ravel(), np.repeat(normal, 3, axis=0), len(vertices))
    if unit:
        norm = np.linalg.norm(gradient, axis=1, keepdims=True)
        gradient /= np.where(norm > 0, norm, 1.0)
    else:
        gradient /= 6.0  # a third of each triangle's area, and the normals are twice the area
    return gradient * label[:, None]
