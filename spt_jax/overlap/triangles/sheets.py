"""The sheets of the surface that lie in overlaps, told from the triangles alone, without beams.

Two things make a triangle's class differ from 0 somewhere: one of its corners is within another
part of the mesh (or inside out), or another triangle passes through it. Both are found exactly, so
every overlap, however thin, is bounded by the triangles found here.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float, Int

from spt_jax.overlap.triangles.pairs import EdgeCrossings, edge_crossings, face_pairs
from spt_jax.overlap.triangles.patches import winding_by_patches


@dataclass(frozen=True)
class Sheets:
    """Triangles whose surface lies in overlaps, wholly or in part.

    Attributes:
        winding: w_out at each vertex, the winding number just outside the surface there.
        crossings: the edges that pass through triangles.
        pairs: the triangles that pass through each other; the rims of the overlaps run there.
        faces: the triangles that bound overlaps.
        num_regions: connected overlaps; sheets are connected within the surface and by `pairs`.
        region: the number of each triangle's region; -1 outside of `faces`.
    """

    winding: Int[np.ndarray, "V"]
    crossings: EdgeCrossings
    pairs: Int[np.ndarray, "P 2"]
    faces: Int[np.ndarray, "H"]
    num_regions: int
    region: Int[np.ndarray, "F"]


def find_sheets(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    directions: Float[np.ndarray, "D 3"],
) -> Sheets:
    """The triangles that bound overlaps, and how they hang together."""
    crossings = edge_crossings(vertices, faces)
    winding = winding_by_patches(vertices, faces, directions, crossings)
    pairs = face_pairs(crossings)
    bounding = winding != 0
    a, b, c = (bounding.take(corner) for corner in faces.T)
    hot = a | b | c
    hot[pairs] = True
    found = np.flatnonzero(hot)
    num_regions, region = _regions(faces, winding, pairs, found)
    return Sheets(winding, crossings, pairs, found, num_regions, region)


def _regions(faces, winding, pairs, found) -> tuple[int, Int[np.ndarray, "F"]]:
    # Triangles of one region share a vertex that lies in an overlap, or pass through each other.
    # Sharing a vertex outside is not enough: two overlaps may meet at one triangle's corner. But at
    # a vertex whose own triangles pass through each other, inside and outside cannot be told.
    region = np.full(len(faces), -1)
    if not len(found):
        return 0, region
    corners = faces[found]
    binding = winding != 0
    binding[shared_corners(faces, pairs)[1]] = True
    row, corner = np.nonzero(binding[corners])
    node = np.full(len(faces), -1)
    node[found] = np.arange(len(found))
    first = np.concatenate([row, node[pairs[:, 0]]])
    names, vertex = np.unique(corners[row, corner], return_inverse=True)
    second = np.concatenate([len(found) + vertex, node[pairs[:, 1]]])
    size = len(found) + len(names)
    links = scipy.sparse.coo_array(
        (np.ones(len(first), np.int8), (first, second)), shape=(size, size)
    )
    component = scipy.sparse.csgraph.connected_components(links, directed=False)[1][: len(found)]
    used, region[found] = np.unique(component, return_inverse=True)
    return len(used), region


def shared_corners(
    faces: Int[np.ndarray, "F 3"], pairs: Int[np.ndarray, "P 2"]
) -> tuple[Int[np.ndarray, "C"], Int[np.ndarray, "C"]]:
    """Pairs whose two triangles share a vertex, as rows of `pairs`, and that vertex."""
    first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
    row, corner = np.nonzero((first[:, :, None] == second[:, None, :]).any(axis=2))
    return row, first[row, corner]
