"""The segments along which pairs of triangles cross; together they are the rims of the overlaps."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.triangles.sheets import Sheets, shared_corners

# More segments than this on one triangle are not compared with each other; rays take over.
_MOST_SEGMENTS = 2000

# Segments that meet within this part of their lengths from an end do not cross there.
_AT_END = 1e-6


@dataclass(frozen=True)
class Segments:
    """Where pairs of triangles cross.

    Attributes:
        pair: the two triangles.
        start, end: of the segment.
        cusp: the vertex that the two share, where the segment then starts; -1: they share none.
        whole: whether it has two ends; where degeneracy leaves another number, what is there.
    """

    pair: Int[np.ndarray, "K 2"]
    start: Float[np.ndarray, "K 3"]
    end: Float[np.ndarray, "K 3"]
    cusp: Int[np.ndarray, "K"]
    whole: Bool[np.ndarray, "K"]

    def only(self, kept: Bool[np.ndarray, "K"]) -> "Segments":
        """Some of the segments."""
        return replace(self, **{name: value[kept] for name, value in vars(self).items()})

    def cusps(self, faces, row, own, jump) -> "Cusps":
        """What the segments that start at shared vertices do to their triangles' corners."""
        cusp = np.repeat(self.cusp, 2)
        at = np.flatnonzero(cusp >= 0)
        corner = np.argmax(faces[own[at]] == cusp[at, None], axis=1)
        total = np.zeros(3 * (row.max(initial=-1) + 1))
        np.add.at(total, 3 * row[own[at]] + corner, jump[at])
        return Cusps(np.unique(cusp[at]), total)


@dataclass(frozen=True)
class Cusps:
    """Vertices where the surface touches itself, so that the winding number around is not one.

    `jump` is how much it changes from a triangle's side that starts at such a corner to the one
    that ends there, over the segments between them.
    """

    vertices: Int[np.ndarray, "C"]
    jump: Float[np.ndarray, "S"]


def find_segments(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], sheets: Sheets
) -> Segments:
    """The segment of every pair of triangles that cross."""
    crossings, count = sheets.crossings, len(faces)
    edge_face = crossings.edge_faces.T.ravel()
    other = np.tile(crossings.face, 2)
    point = np.tile(crossings.point, (2, 1))
    kept = edge_face >= 0
    low, high = np.minimum(edge_face, other)[kept], np.maximum(edge_face, other)[kept]
    point = point[kept]
    # A vertex that the two triangles share is an end of their segment, and is put first.
    shared_by, shared = shared_corners(faces, sheets.pairs)
    key = np.concatenate([sheets.pairs[shared_by] @ np.array([count, 1]), low * count + high])
    point = np.concatenate([vertices[shared], point])
    cusp = np.concatenate([shared, np.full(len(low), -1)])
    order = np.argsort(key, kind="stable")
    key, point, cusp = key[order], point[order], cusp[order]
    begin = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]])[: len(key)])
    end = np.append(begin, len(key))[1:] - 1
    pair = np.stack(np.divmod(key[begin], count), axis=1)
    return Segments(pair, point[begin], point[end], cusp[begin], end == begin + 1)


def crossed_triangles(row, start, end, count: int) -> Bool[np.ndarray, "H"]:
    """Triangles on which two segments cross: three parts meet there, and may lie in one place."""
    order = np.argsort(row, kind="stable")
    row, start, end = row[order], start[order], end[order]
    number = np.bincount(row, minlength=count)
    crossed = number > _MOST_SEGMENTS
    # Each segment against those after it on the same triangle.
    last = np.cumsum(number)[row]
    later = np.where(crossed[row], 0, last - np.arange(len(row)) - 1)
    first = np.repeat(np.arange(len(row)), later)
    second = np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later) + first + 1

    def cuts(a, b, c, d):
        # Whether the line through a and b passes between c and d; not at an end, where the
        # segments of neighbouring triangles meet.
        u, v = b - a, np.stack([c - a, d - a])
        turn = u[:, 0] * v[..., 1] - u[:, 1] * v[..., 0]
        width = np.abs(turn[0] - turn[1])
        return (turn[0] * turn[1] < 0) & (np.abs(turn).min(axis=0) > _AT_END * width)

    one, other = (start[first], end[first]), (start[second], end[second])
    crossed[row[first[cuts(*one, *other) & cuts(*other, *one)]]] = True
    return crossed
