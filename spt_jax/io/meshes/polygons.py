"""Polygons of any number of corners cut into triangles: by a diagonal, or ear by ear.

trimesh 5.2 cuts every polygon into a fan about its first corner, which covers the wrong area where
the polygon is not convex.
"""

import numpy as np
from jaxtyping import Float, Int

# A corner is straight where the parallelogram of its sides has less area than this part of the
# polygon's.
_STRAIGHT = 1e-12


def polygon_triangles(
    points: Float[np.ndarray, "V 3"],
    corners: Int[np.ndarray, "C"],
    counts: Int[np.ndarray, "P"],
) -> tuple[Int[np.ndarray, "T 3"], Int[np.ndarray, "T"], int]:
    """Triangles of polygons, as places in the list of corners.

    Args:
        points: the vertices' positions.
        corners: the polygons' vertices, one polygon after the other; each must be an index.
        counts: how many corners each polygon has; those of fewer than three have no triangles.

    Returns:
        Of each triangle, in the polygons' order: where its corners stand in `corners`, and the
        polygon; and how many polygons cross themselves, so that no triangles cover them right.
    """
    starts = np.cumsum(counts) - counts
    cut = np.zeros(int(np.maximum(counts - 2, 0).sum()), np.int64)
    triangles = np.zeros((len(cut), 3), np.int64)
    first = np.cumsum(np.maximum(counts - 2, 0)) - np.maximum(counts - 2, 0)
    crossed = 0
    three = np.flatnonzero(counts == 3)
    triangles[first[three]] = starts[three, None] + np.arange(3)
    four = np.flatnonzero(counts == 4)
    if len(four):
        place = starts[four, None] + _quad_triangles(points[corners[starts[four, None] + _FOUR]])
        triangles[first[four, None] + np.arange(2)] = place.reshape(-1, 2, 3)
    for polygon in np.flatnonzero(counts > 4).tolist():
        start, count = starts[polygon], counts[polygon]
        ears, simple = _ears(points[corners[start : start + count]])
        crossed += not simple
        triangles[first[polygon] : first[polygon] + count - 2] = start + ears
    cut[:] = np.repeat(np.arange(len(counts)), np.maximum(counts - 2, 0))
    return triangles, cut, crossed


_FOUR = np.arange(4)


def _quad_triangles(corners: Float[np.ndarray, "Q 4 3"]) -> Int[np.ndarray, "Q 6"]:
    """Both triangles of each quadrilateral, cut from its reflex corner where there is one."""
    with np.errstate(over="ignore", invalid="ignore"):
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        ahead = np.roll(corners, -1, axis=1) - corners
        turn = np.einsum("qki,qi->qk", np.cross(np.roll(ahead, 1, axis=1), ahead), normal)
    reflex = (turn[:, 1] < 0) | (turn[:, 3] < 0)
    return np.where(reflex[:, None], [1, 2, 3, 1, 3, 0], [0, 1, 2, 0, 2, 3])


def _ears(corners: Float[np.ndarray, "N 3"]) -> tuple[Int[np.ndarray, "M 3"], bool]:
    """The triangles of one polygon, and whether they cover it once (it does not cross itself)."""
    count = len(corners)
    flat = _flattened(corners)
    turn = _turn(np.roll(flat, 1, axis=0), flat, np.roll(flat, -1, axis=0))
    area = np.abs(turn).sum()
    straight = _STRAIGHT * area
    # Of a polygon that winds once, the turns of one sense add up to no more than a full one.
    if (turn > straight).all() and _winds_once(flat):
        k = np.arange(1, count - 1)
        return np.stack([np.zeros_like(k), k, k + 1], axis=1), True
    left = list(range(count))
    found, simple, k = [], not _crosses_itself(flat), 0
    while len(left) > 3:
        for tried in range(len(left)):
            place = (k + tried) % len(left)
            trio = [left[place - 1], left[place], left[(place + 1) % len(left)]]
            if _is_ear(flat, trio, left, straight):
                break
        else:
            place, simple = _widest(flat, left), False
            trio = [left[place - 1], left[place], left[(place + 1) % len(left)]]
        found.append(trio)
        del left[place]
        k = place  # on to the next corner: ears all from one corner would be slivers
    found.append(left)
    return np.array(found), simple


def _is_ear(flat: np.ndarray, trio: list[int], left: list[int], straight: float) -> bool:
    a, b, c = flat[trio]
    if not _turn(a, b, c) > straight:
        return False
    others = flat[left]
    # Corners at the very place of one of the ear's belong to a slit that leads to a hole.
    others = others[~(others[:, None] == flat[trio]).all(axis=2).any(axis=1)]
    inside = (
        (_turn(a, b, others) >= -straight)
        & (_turn(b, c, others) >= -straight)
        & (_turn(c, a, others) >= -straight)
    )
    return not inside.any()


def _crosses_itself(flat: Float[np.ndarray, "N 2"]) -> bool:
    """Whether two sides pass through each other; those that only touch do not."""
    ends = np.roll(flat, -1, axis=0)
    for a, b in zip(flat, ends, strict=True):
        parted = _turn(a, b, flat) * _turn(a, b, ends) < 0
        if (parted & (_turn(flat, ends, a) * _turn(flat, ends, b) < 0)).any():
            return True
    return False


def _widest(flat: np.ndarray, left: list[int]) -> int:
    points = flat[left]
    turn = _turn(np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0))
    return int(np.argmax(turn))


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area of a triangle in the plane, positive counter-clockwise."""
    ab, ac = b - a, c - a
    return ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]


def _winds_once(flat: np.ndarray) -> bool:
    side = np.roll(flat, -1, axis=0) - flat
    angle = np.arctan2(side[:, 1], side[:, 0])
    turns = (np.roll(angle, -1) - angle + np.pi) % (2 * np.pi) - np.pi
    return bool(abs(turns.sum()) < 3 * np.pi)


def _flattened(corners: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
    """The polygon without the axis that it faces most, counter-clockwise."""
    moved = corners - corners.mean(axis=0)
    normal = np.cross(moved, np.roll(moved, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    kept = moved[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return kept if normal[axis] >= 0 else kept[:, ::-1]
