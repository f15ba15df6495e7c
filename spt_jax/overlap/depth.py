"""How deep vertices lie inside another part of the surface."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

# Triangles whose distance is worked out for each vertex before the bound that it gives is used.
_FIRST = 8


def penetration_depths(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    inside: Bool[np.ndarray, "V"],
) -> tuple[Float[np.ndarray, "V"], Int[np.ndarray, "V"]]:
    """Of each vertex inside another part, how far the surface of that part is; 0 of the others.

    A vertex's own part is the patch of vertices inside that it is connected with along edges; the
    depth is the distance to the nearest triangle with no corner in that patch. That triangle is
    the other part's: where the vertex's own part leaves the other one it meets the other's
    surface, which is no farther away.

    Args:
        vertices: positions.
        faces: indices of each triangle's corners.
        inside: which vertices lie inside another part.

    Returns:
        Distances in the vertices' unit, and the triangle that each is the distance to; -1 without.
    """
    depth, nearest = np.zeros(len(vertices)), np.full(len(vertices), -1)
    patch = _patches(faces, inside)
    for number in range(patch.max(initial=-1) + 1):
        own = patch == number
        others = np.flatnonzero(~own[faces].any(axis=1))
        if len(others):
            at = np.flatnonzero(own)
            depth[at], found = _nearest(vertices[at], vertices[faces[others]])
            nearest[at] = others[found]
    return depth, nearest


def distances(
    points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "M 3 3"]
) -> Float[np.ndarray, "N"]:
    """From each point to the nearest triangle."""
    return _nearest(points, triangles)[0] if len(points) else np.zeros(0)


def _patches(faces, inside) -> Int[np.ndarray, "V"]:
    """The number of each vertex's patch; -1 of vertices that are not inside."""
    chosen = np.flatnonzero(inside)
    number = np.full(len(inside), -1)
    number[chosen] = np.arange(len(chosen))
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    start, end = number[edges[inside[edges].all(axis=1)]].T
    joined = coo_array((np.ones(len(start), bool), (start, end)), shape=(len(chosen),) * 2)
    number[chosen] = connected_components(joined, directed=False)[1]
    return number


def _nearest(points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "M 3 3"]):
    """From each point to the nearest triangle: how far, and which."""
    center = triangles.mean(axis=1)
    radius = float(np.linalg.norm(triangles - center[:, None], axis=2).max())
    tree = KDTree(center)
    first = tree.query(points, k=min(_FIRST, len(center)))[1].reshape(len(points), -1)
    bound = np.min([_to_triangles(points, triangles[column]) for column in first.T], axis=0)
    # A triangle that is nearer has its center within the bound and its own radius.
    near = tree.query_ball_point(points, (bound + radius) * (1 + 1e-9))
    point = np.repeat(np.arange(len(points)), [len(one) for one in near])
    candidate = np.concatenate(near).astype(np.int64)
    distance = _to_triangles(points[point], triangles[candidate])
    order = np.lexsort((distance, point))
    start = np.searchsorted(point, np.arange(len(points)))
    return distance[order][start], candidate[order][start]


def _to_triangles(points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "N 3 3"]):
    """From each point to its triangle: to its inside, or to the nearest of its edges."""
    a = triangles[:, 0]
    ab, ac, ap = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    normal = np.cross(ab, ac)
    square = np.einsum("ni,ni->n", normal, normal)
    solid = square > 0
    safe = np.where(solid, square, 1.0)
    v = np.einsum("ni,ni->n", np.cross(ap, ac), normal) / safe
    w = np.einsum("ni,ni->n", np.cross(ab, ap), normal) / safe
    over = solid & (v >= 0) & (w >= 0) & (v + w <= 1)
    height = np.abs(np.einsum("ni,ni->n", ap, normal)) / np.sqrt(safe)
    edges = [_to_edges(points, triangles[:, k], triangles[:, (k + 1) % 3]) for k in range(3)]
    return np.where(over, height, np.min(edges, axis=0))


def _to_edges(points, start, end):
    along, way = end - start, points - start
    square = np.einsum("ni,ni->n", along, along)
    part = np.einsum("ni,ni->n", way, along) / np.where(square > 0, square, 1.0)
    return np.linalg.norm(way - np.clip(part, 0, 1)[:, None] * along, axis=1)


def nearest_points(
    points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "M 3 3"]
) -> tuple[Float[np.ndarray, "N"], Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """From each point to the nearest triangle: how far, which, and the shares of its corners."""
    distance, found = _nearest(points, triangles)
    a, b, c = triangles[found].transpose(1, 0, 2)
    ab, ac, ap = b - a, c - a, points - a
    normal = np.cross(ab, ac)
    square = np.einsum("ni,ni->n", normal, normal)
    safe = np.where(square > 0, square, 1.0)
    v = np.einsum("ni,ni->n", np.cross(ap, ac), normal) / safe
    w = np.einsum("ni,ni->n", np.cross(ab, ap), normal) / safe
    over = (square > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    shares = np.stack([1 - v - w, v, w], axis=1)
    best = np.where(over, -1.0, np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        p, q = triangles[found, start], triangles[found, end]
        along = q - p
        length = np.einsum("ni,ni->n", along, along)
        part = np.einsum("ni,ni->n", points - p, along) / np.where(length > 0, length, 1.0)
        part = np.clip(part, 0, 1)
        away = np.linalg.norm(points - p - part[:, None] * along, axis=1)
        nearer = np.flatnonzero(away < best)
        best[nearer] = away[nearer]
        shares[nearer] = 0.0
        shares[nearer, start], shares[nearer, end] = 1 - part[nearer], part[nearer]
    return distance, found, shares
