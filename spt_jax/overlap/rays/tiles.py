"""Parts of a screen where rays are cast, so that the rest costs nothing."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class Tiles:
    """Square tiles of pixels, of which some are marked; pixels of marked tiles are numbered.

    The numbers run along the pixel rows and leave out what is not marked, so that arrays by pixel
    are as long as the marked part of the screen, however fine the screen is.

    Attributes:
        size: pixels along a tile's side.
        marked: rows and columns of tiles.
    """

    size: int
    marked: Bool[np.ndarray, "R C"]

    @property
    def num_pixels(self) -> int:
        """Pixels in marked tiles."""
        return int(self._before_row[-1]) * self.size**2

    @cached_property
    def _before_row(self) -> Int[np.ndarray, "B"]:
        return np.concatenate([[0], np.cumsum(np.count_nonzero(self.marked, axis=1))])

    @cached_property
    def _before_tile(self) -> Int[np.ndarray, "R C"]:
        # Marked tiles to the left in the same row of tiles.
        return np.cumsum(self.marked, axis=1) - self.marked

    @cached_property
    def _runs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # Neighbouring marked tiles of a row form a run: where each row's runs begin in the list,
        # and each run's first and last column of tiles.
        rows, columns = self.marked.shape
        padded = np.zeros((rows, columns + 2), np.int8)
        padded[:, 1:-1] = self.marked
        change = np.diff(padded, axis=1)
        row, first = np.nonzero(change > 0)
        _, end = np.nonzero(change < 0)
        begin = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=rows))])
        return begin, first, end - 1

    @cached_property
    def _extent(self) -> tuple[tuple[int, int], tuple[int, int]]:
        # First and last row and first and last column of tiles that are marked.
        rows, columns = (np.flatnonzero(self.marked.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return (0, -1), (0, -1)
        return (int(rows[0]), int(rows[-1])), (int(columns[0]), int(columns[-1]))

    @property
    def rows(self) -> tuple[int, int]:
        """Rows of pixels in which tiles are marked: the first, and the one behind the last."""
        first, last = self._extent[0]
        return first * self.size, (last + 1) * self.size

    def number(self, row: Int[np.ndarray, "N"], column: Int[np.ndarray, "N"]):
        """Numbers of pixels in marked tiles; along a row they rise by one from pixel to pixel."""
        tile_row, sub_row = np.divmod(row, self.size)
        tile_column, sub_column = np.divmod(column, self.size)
        before = self._before_row[tile_row]
        in_row = self._before_row[tile_row + 1] - before
        number = before * self.size + sub_row * in_row + self._before_tile[tile_row, tile_column]
        return number * self.size + sub_column

    def locate(self, number: Int[np.ndarray, "N"]):
        """Row and column of numbered pixels."""
        strip, sub_column = np.divmod(number, self.size)
        tile_row = np.searchsorted(self._before_row * self.size, strip, side="right") - 1
        before = self._before_row[tile_row]
        in_row = self._before_row[tile_row + 1] - before
        sub_row, tile = np.divmod(strip - before * self.size, in_row)
        tile_column = np.nonzero(self.marked)[1][before + tile]
        return tile_row * self.size + sub_row, tile_column * self.size + sub_column

    def touched_by(
        self,
        row: Float[np.ndarray, "V"],
        column: Float[np.ndarray, "V"],
        faces: Int[np.ndarray, "F 3"],
    ) -> Int[np.ndarray, "G"]:
        """The triangles whose bounding box on the screen touches a marked tile."""
        last = np.array(self.marked.shape) - 1
        row_tile, column_tile = _tile(row, self.size, last[0]), _tile(column, self.size, last[1])
        # All corners on one side of all marked tiles: told from a byte a vertex, mostly.
        (first_row, last_row), (first_column, last_column) = self._extent
        beyond = np.zeros(len(row), np.uint8)
        for bit, side in enumerate(
            (
                row_tile < first_row,
                row_tile > last_row,
                column_tile < first_column,
                column_tile > last_column,
            )
        ):
            beyond |= side.view(np.uint8) << np.uint8(bit)
        a, b, c = (beyond.take(corner) for corner in faces.T)
        near = np.flatnonzero((a & b & c) == 0)
        faces = faces.take(near, axis=0)
        # How many marked tiles lie above and to the left of each tile's corner.
        count = np.zeros((last[0] + 2, last[1] + 2), np.int32)
        np.cumsum(np.cumsum(self.marked, axis=0, dtype=np.int32), axis=1, out=count[1:, 1:])
        top, bottom = _bounds(row_tile, faces)
        left, right = _bounds(column_tile, faces)
        inside = count[bottom + 1, right + 1] - count[top, right + 1]
        inside += count[top, left] - count[bottom + 1, left]
        return near[inside > 0]

    def clip(
        self,
        row: Int[np.ndarray, "S"],
        first_column: Int[np.ndarray, "S"],
        width: Int[np.ndarray, "S"],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The parts of spans of pixels that lie in marked tiles.

        Returns:
            For each part the span that it belongs to, its first column and its width.
        """
        begin, first, last = self._runs
        tile_row = row // self.size
        count = (begin[1:] - begin[:-1])[tile_row]
        span = np.repeat(np.arange(len(row)), count)
        run = np.arange(len(span)) + (begin[tile_row] - (np.cumsum(count) - count))[span]
        start = np.maximum(first_column[span], first[run] * self.size)
        end = np.minimum((first_column + width)[span], (last[run] + 1) * self.size)
        kept = np.flatnonzero(end > start)
        return span[kept], start[kept], (end - start)[kept]


def boxes(
    row: Float[np.ndarray, "V"],
    column: Float[np.ndarray, "V"],
    size: int,
    shape: tuple[int, int],
    faces: Int[np.ndarray, "F 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First and last row and first and last column of tiles that hold pixels of each triangle."""
    return (
        *_bounds(_tile(row, size, shape[0] - 1), faces),
        *_bounds(_tile(column, size, shape[1] - 1), faces),
    )


def _tile(coordinate, size, last):
    # A triangle covers pixels from ceil(lowest) on; rounding down is on the safe side.
    return np.minimum((coordinate * (1.0 / size)).astype(np.int64), last)


def _bounds(tile, faces):
    a, b, c = (tile.take(corner) for corner in faces.T)
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
