"""Where a surface crosses itself, and the forces that shorten that curve; NumPy only."""

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import area_normals
from spt_jax.overlap.triangles.pairs import EdgeIntersections

# Sine below which an edge runs along the face that it crosses: the contour would run away.
_FLATTEST = 0.05

# Forces well below this are proportional to how bent the contour is, those above are of length 1.
_SATURATION = 0.2


def contour_forces(
    faces: Int[np.ndarray, "F 3"],
    vertices: Float[np.ndarray, "V 3"],
    intersections: EdgeIntersections,
) -> Float[np.ndarray, "V 3"]:
    """Forces along which the intersection contour gets shorter, until it vanishes.

    Volino and Magnenat-Thalmann 2006, "Resolving surface collisions through intersection contour
    minimization". Where edge e crosses face f, the contour goes on within both faces at e, along
    R_1 and R_2, of length one. Moving e by u against f moves the crossing by
    u - e (u . n) / (e . n), n being the normal of f, and changes the contour's length by minus
    the product of that with R = R_1 + R_2; so the force on e is R - (R . e) / (e . n) n, and f
    gets the opposite, both shared out by barycentric weights.

    Args:
        faces: the triangles, none of which lists a vertex twice.
        vertices: positions.
        intersections: of edges through faces.

    Returns:
        The sum of the forces at each vertex, without unit.
    """
    tail, head = intersections.edge.T
    normal = unit(area_normals(vertices, faces))
    across = normal[intersections.face]
    edge = vertices[head] - vertices[tail]
    along = unit(edge)
    bend = np.zeros(along.shape)
    for face in intersections.edge_faces.T:
        onward = unit(np.cross(normal[face], across))
        # Into the face: towards its middle, as seen from its edge.
        middle = vertices[faces[face]].mean(axis=1) - vertices[tail]
        middle = middle - dot(middle, along) * along
        bend += np.sign(dot(onward, middle)) * onward
    sine = dot(along, across)
    sine = np.where(np.abs(sine) < _FLATTEST, np.copysign(_FLATTEST, sine), sine)
    force = bend - dot(bend, along) / sine * across
    force /= np.sqrt(dot(force, force) + _SATURATION**2)

    length = np.maximum(np.linalg.norm(edge, axis=1), np.finfo(float).tiny)
    part = np.linalg.norm(intersections.point - vertices[tail], axis=1) / length
    part = np.clip(part, 0.0, 1.0)[:, None]
    corners = faces[intersections.face]
    weights = _barycentric(vertices[corners], intersections.point)
    total = np.zeros(vertices.shape)
    np.add.at(total, tail, (1.0 - part) * force)
    np.add.at(total, head, part * force)
    np.add.at(total, corners, -weights[:, :, None] * force[:, None])
    return total


def dot(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 1"]:
    """Row by row, as a column."""
    return np.einsum("ni,ni->n", a, b)[:, None]


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Rows of length one; a zero row stays zero."""
    # Divided by the largest entry first: squares of tiny numbers are zero.
    largest = np.abs(vectors).max(axis=1, initial=0.0)[:, None]
    vectors = vectors / np.where(largest > 0, largest, 1.0)
    length = np.sqrt(dot(vectors, vectors))
    return vectors / np.where(length > 0, length, 1.0)


def _barycentric(
    corners: Float[np.ndarray, "K 3 3"], points: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "K 3"]:
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    square = dot(normal, normal)
    square = np.where(square > 0, square, 1.0)
    first = dot(np.cross(c - b, points - b), normal) / square
    second = dot(np.cross(a - c, points - c), normal) / square
    weights = np.concatenate([first, second, 1.0 - first - second], axis=1)
    return np.clip(weights, 0.0, 1.0)
