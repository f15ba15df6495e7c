"""Connected overlaps: which triangles bound one and the same."""

import numpy as np
import scipy
from jaxtyping import Bool, Int


def connected_regions(
    faces: Int[np.ndarray, "F 3"],
    found: Int[np.ndarray, "H"],
    within: Bool[np.ndarray, "V"],
    pairs: Int[np.ndarray, "P 2"],
) -> tuple[Int[np.ndarray, "H"], int]:
    """Numbers of the regions of some triangles, and how many regions there are.

    Triangles of one region share a vertex that lies in an overlap, or intersect. Sharing a vertex
    outside is not enough: two overlaps may meet at one triangle's corner.

    Args:
        faces: of the mesh.
        found: the triangles that bound overlaps, among them those of all pairs.
        within: vertices in overlaps, and those at which a vertex's own triangles intersect.
        pairs: triangles that intersect.
    """
    if not len(found):
        return np.zeros(0, np.int64), 0
    corners = faces[found]
    row, corner = np.nonzero(within[corners])
    node = np.full(len(faces), -1)
    node[found] = np.arange(len(found))
    first = np.concatenate([row, node[pairs[:, 0]]])
    names, vertex = np.unique(corners[row, corner], return_inverse=True)
    second = np.concatenate([len(found) + vertex, node[pairs[:, 1]]])
    size = len(found) + len(names)
    links = scipy.sparse.coo_array(
        (np.ones(len(first), np.int8), (first, second)), shape=(size, size)
    )
    part = scipy.sparse.csgraph.connected_components(links, directed=False)[1][: len(found)]
    used, region = np.unique(part, return_inverse=True)
    return region, len(used)
