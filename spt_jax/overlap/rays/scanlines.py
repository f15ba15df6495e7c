"""Triangles -> spans: the runs of pixels that each triangle covers, row by row.

Triangles are rasterised with half-open intervals: a row is covered by an edge when
ceil(y0) <= row < ceil(y1), a column by a span when ceil(x_left) <= column < ceil(x_right), and an
edge's x is computed from its two end points in an order that does not depend on the triangle. A
span is the difference of its triangle's two active edges, and the two triangles of an edge use it
with opposite signs, so the signs along any ray of a closed mesh sum to zero exactly: for rays
aimed at edges and vertices, and whatever the rounding.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from spt_jax.overlap.rays.beam import ScreenPoints

# (a > b) + 2 (b > c) + 4 (a > c) -> the order of corners that sorts rows a, b, c; the codes 2 + 0
# and so on that contradict themselves cannot occur.
SORTED_CORNERS = np.array(
    [[0, 1, 2], [1, 0, 2], [0, 2, 1], [0, 1, 2], [0, 1, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
)
EVEN = np.array([True, False, False, True, True, True, True, False])

# Pixels of a band of rows. Its arrays stay in a core's cache and are small enough for the memory
# allocator to hand the same ones out again: a screen of 512 x 512 at once takes twice as long, half
# of it in page faults. Fewer pixels cost more calls than they save.
_BAND_PIXELS = 24_000


class Rows(NamedTuple):
    """The rows begin, ..., end - 1 of a screen."""

    begin: int
    end: int


class Spans(NamedTuple):
    """Runs of pixels in which one triangle covers one row; some are empty.

    Attributes:
        face: the triangle.
        row: the row.
        first_column: where the run starts, undefined for an empty one.
        width: its number of pixels.
        leaves: whether rays leave the solid there; otherwise they enter it.
        first_depth: of the triangle at the first pixel, undefined for an empty run.
        depth_step: from pixel to pixel; zero for a single one.
    """

    face: Int[np.ndarray, "S"]
    row: Int[np.ndarray, "S"]
    first_column: Int[np.ndarray, "S"]
    width: Int[np.ndarray, "S"]
    leaves: Bool[np.ndarray, "S"]
    first_depth: Float[np.ndarray, "S"]
    depth_step: Float[np.ndarray, "S"]


def bands(
    points: ScreenPoints, faces: Int[np.ndarray, "F 3"], shape: tuple[int, int]
) -> Iterator[tuple[Rows, Int[np.ndarray, "G"]]]:
    """Bands of rows that cover the screen, each with the triangles that cover pixels of it."""
    first_row = np.ceil(points.row).astype(np.int32)
    a, b, c = (first_row.take(corner) for corner in faces.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    face = np.flatnonzero(low != high)  # the others lie between two rows
    face = face.take(np.argsort(low.take(face), kind="stable"))
    low, high = low.take(face), high.take(face)
    tallest = int((high - low).max(initial=0))
    height = max(_BAND_PIXELS // shape[1], 1)
    begins = np.arange(0, shape[0], height)
    left, right = np.searchsorted(low, [begins - tallest, begins + height])
    for begin, first, last in zip(begins.tolist(), left, right, strict=True):
        mine = np.flatnonzero(high[first:last] > begin)
        if len(mine):
            yield Rows(begin, min(begin + height, shape[0])), face[first:last].take(mine)


def scan(
    points: ScreenPoints, faces: Int[np.ndarray, "F 3"], face: Int[np.ndarray, "G"], rows: Rows
) -> Spans:
    """The spans of some of the triangles in these rows."""
    triangle = faces.take(face, axis=0).T
    count = triangle.shape[1]
    first_row = np.ceil(points.row.take(triangle))
    a, b, c = first_row
    code = (a > b) + 2 * (b > c) + 4 * (a > c)
    # (3, G): low, mid, high
    at = SORTED_CORNERS.T.take(code, axis=1) * count + np.arange(count)
    corners = triangle.ravel().take(at)
    low, mid, high = first_row.ravel().take(at)

    # Three edges a triangle, each from its lower to its higher end: low-high, low-mid, mid-high.
    # The ends' order depends on their rows alone, so both triangles of an edge compute the same x.
    place = paired(points.column.take(corners), points.depth.take(corners))
    y = points.row.take(corners)
    run = np.concatenate([place[2] - place[0], place[1] - place[0], place[2] - place[1]])
    rise = np.concatenate([y[2] - y[0], y[1] - y[0], y[2] - y[1]])
    # An edge between two lattice rows covers none of them, so its slope is never used.
    np.copyto(rise, 1.0, where=np.concatenate([low == high, low == mid, mid == high]))
    edges = _Edges(
        place=np.concatenate([place[0], place[0], place[1]]),
        row=np.concatenate([y[0], y[0], y[1]]),
        slope=run / rise,
    )

    begin = np.maximum(low, rows.begin)
    tall = np.maximum(np.minimum(high, rows.end) - begin, 0.0).astype(np.int64)
    # One repeat, then takes: np.repeat costs three times a take.
    long = np.repeat(np.arange(count), tall)
    row = np.arange(float(len(long)))
    row += (begin - (np.cumsum(tall) - tall)).take(long)
    short = long + count
    short += count * (row >= mid.take(long))

    at_long, at_short = edges.at(long, row), edges.at(short, row)
    column = np.ceil(np.real(at_long))
    signed_width = np.ceil(np.real(at_short)) - column
    column += np.minimum(signed_width, 0.0)
    # Interpolating between the edges, never extrapolating the plane, keeps the depth inside the
    # triangle's own range however steeply it grazes the rays.
    at_short -= at_long
    with np.errstate(divide="ignore", invalid="ignore"):  # of empty spans
        depth_step = np.imag(at_short) / np.real(at_short)
        depth = np.imag(at_long) + (column - np.real(at_long)) * depth_step
    width = np.abs(signed_width).astype(np.int64)
    depth_step[width < 2] = 0.0
    return Spans(
        face=face.take(long),
        row=row.astype(np.int64),
        first_column=column.astype(np.int64),
        width=width,
        # An even order of (low, mid, high) is counter-clockwise, and faces the rays, when the
        # short edges are on the right. The columns decide, not the normal: that is what makes
        # the signs of a ray cancel exactly.
        leaves=(signed_width > 0) != EVEN.take(code).take(long),
        first_depth=depth,
        depth_step=depth_step,
    )


class _Edges(NamedTuple):
    """Edges on the screen; complex numbers are column + 1j depth.

    Attributes:
        place: of the lower end.
        row: of the lower end.
        slope: from row to row.
    """

    place: Complex[np.ndarray, "E"]
    row: Float[np.ndarray, "E"]
    slope: Complex[np.ndarray, "E"]

    def at(
        self, edge: Int[np.ndarray, "S"], row: Float[np.ndarray, "S"]
    ) -> Complex[np.ndarray, "S"]:
        """Where edges pass through rows."""
        value = self.slope.take(edge)
        rise = row - self.row.take(edge)
        for part in (np.real(value), np.imag(value)):
            part *= rise
        value += self.place.take(edge)
        return value


def paired(first: Float[np.ndarray, "*N"], second: Float[np.ndarray, "*N"]):
    """Complex numbers of these parts: one take brings both, in the time of one."""
    pair = np.empty((*first.shape, 2))
    pair[..., 0], pair[..., 1] = first, second
    return pair.view(complex)[..., 0]
