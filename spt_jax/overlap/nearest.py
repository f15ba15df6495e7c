"""The nearest points of two patches of triangles, exactly: corners against triangles, edges
against edges, and nothing where the two intersect."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from spt_jax.overlap.arrays.vectors import cross, dot

# Triangles of the first patch that are compared with the second at once.
_CHUNK = 256


class Nearest(NamedTuple):
    """The nearest points of two patches.

    Attributes:
        faces: the two triangles.
        weights: barycentric, (2, 3), of the point on each.
        distance: between the points; 0 where the patches intersect.
    """

    faces: tuple[int, int]
    weights: Float[np.ndarray, "2 3"]
    distance: float


def nearest_points(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    first: Int[np.ndarray, "A"],
    second: Int[np.ndarray, "B"],
) -> Nearest:
    """Where two patches are nearest to each other, and how near.

    Args:
        vertices: positions, finite.
        faces: indices of each triangle's corners.
        first, second: the triangles of each patch, at least one.
    """
    ours, theirs = vertices[faces[first]], vertices[faces[second]]
    centers, others = ours.mean(axis=1), theirs.mean(axis=1)
    radius = np.linalg.norm(ours - centers[:, None], axis=2).max(axis=1)
    reach = float(np.linalg.norm(theirs - others[:, None], axis=2).max())
    tree = KDTree(others)
    least = tree.query(centers)[0] - radius - reach  # no triangle is nearer to the other patch
    best = Nearest((int(first[0]), int(second[0])), np.eye(3)[[0, 0]], np.inf)
    order = np.argsort(least, kind="stable")
    # The first look is at few, which say how far to look.
    for chunk in (order[:8], *(order[k : k + _CHUNK] for k in range(8, len(order), _CHUNK))):
        chunk = chunk[least[chunk] <= best.distance]
        if not len(chunk):
            break
        own, other = _candidates(tree, centers[chunk], radius[chunk], reach, best.distance)
        if len(own):
            own = chunk[own]
            found = _pairwise(ours[own], theirs[other])
            at = int(np.argmin(found[2]))
            if found[2][at] < best.distance:
                pair = int(first[own[at]]), int(second[other[at]])
                best = Nearest(pair, np.stack([found[0][at], found[1][at]]), float(found[2][at]))
        if best.distance == 0:
            break
    return best


def _candidates(tree: KDTree, centers, radius, reach: float, most: float):
    """Pairs of rows of `centers` and of the tree whose triangles may be so near."""
    if not np.isfinite(most):
        count = min(8, tree.n)
        near = tree.query(centers, k=count)[1].reshape(len(centers), count)
        return np.repeat(np.arange(len(centers)), count), near.ravel()
    near = tree.query_ball_point(centers, (most + radius + reach) * (1 + 1e-12))
    lengths = [len(one) for one in near]
    if not sum(lengths):
        return np.zeros((2, 0), np.int64)
    return np.repeat(np.arange(len(centers)), lengths), np.concatenate(near).astype(np.int64)


def _pairwise(
    ours: Float[np.ndarray, "N 3 3"], theirs: Float[np.ndarray, "N 3 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]]:
    """Of each pair of triangles the nearest points' weights, and their distance."""
    found = []
    corner = np.eye(3)
    for k in range(3):
        at = np.broadcast_to(corner[k], (len(ours), 3))
        found.append((at, _on_triangle(ours[:, k], theirs)))
        found.append((_on_triangle(theirs[:, k], ours), at))
        for j in range(3):
            s, t = _on_edges(ours[:, [k, k - 2]], theirs[:, [j, j - 2]])
            along = corner[k] + s[:, None] * (corner[k - 2] - corner[k])
            found.append((along, corner[j] + t[:, None] * (corner[j - 2] - corner[j])))
    own, other = (np.stack(weights) for weights in zip(*found, strict=True))
    apart = np.einsum("knc,nci->kni", own, ours) - np.einsum("knc,nci->kni", other, theirs)
    distance = np.linalg.norm(apart, axis=2)
    at, rows = distance.argmin(axis=0), np.arange(len(ours))
    nearest = distance[at, rows]
    nearest[_intersect(ours, theirs) | _intersect(theirs, ours)] = 0.0
    return own[at, rows], other[at, rows], nearest


def _on_triangle(
    points: Float[np.ndarray, "N 3"], triangles: Float[np.ndarray, "N 3 3"]
) -> Float[np.ndarray, "N 3"]:
    """Weights of the foot of each point over its triangle; outside, any point of its plane's edge.

    Where the foot is outside, an edge is nearer, and pairs of edges find that: the point returned
    is then a corner, which is on the triangle but need not be the nearest of it.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    ab, ac, ap = b - a, c - a, points - a
    normal = cross(ab, ac)
    square = dot(normal, normal)
    safe = np.where(square > 0, square, 1.0)
    v, w = dot(cross(ap, ac), normal) / safe, dot(cross(ab, ap), normal) / safe
    over = (square > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    weights = np.stack([1 - v - w, v, w], axis=1)
    return np.where(over[:, None], weights, np.eye(3)[0])


def _on_edges(
    first: Float[np.ndarray, "N 2 3"], second: Float[np.ndarray, "N 2 3"]
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Which parts of two edges' lengths lie before their nearest points.

    Ericson 2005, "Real-Time Collision Detection", section 5.1.9.
    """
    d, e, r = first[:, 1] - first[:, 0], second[:, 1] - second[:, 0], first[:, 0] - second[:, 0]
    a, b, f = dot(d, d), dot(d, e), dot(e, r)
    c, g = dot(d, r), dot(e, e)
    det = a * g - b * b
    told = det > 1e-14 * a * g  # else they are parallel, and any place will do
    s = np.clip(np.where(told, b * f - c * g, 0.0) / np.where(told, det, 1.0), 0.0, 1.0)
    t = (b * s + f) / np.where(g > 0, g, 1.0)
    clipped = np.clip(t, 0.0, 1.0)
    s = np.clip((b * clipped - c) / np.where(a > 0, a, 1.0), 0.0, 1.0)
    return s, clipped


def _intersect(
    edges: Float[np.ndarray, "N 3 3"], triangles: Float[np.ndarray, "N 3 3"]
) -> Bool[np.ndarray, "N"]:
    """Whether an edge of the first triangle passes through the second."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = cross(b - a, c - a)
    height = np.einsum("nci,ni->nc", edges - a[:, None], normal)
    found = np.zeros(len(edges), bool)
    for k in range(3):
        p, q = edges[:, k], edges[:, k - 2]
        through = height[:, k] * height[:, k - 2] < 0
        way = q - p
        sides = [dot(cross(y - x, p - x), way) for x, y in ((a, b), (b, c), (c, a))]
        same = np.stack(sides)
        found |= through & ((same >= 0).all(axis=0) | (same <= 0).all(axis=0))
    return found
