"""`rays="auto"`, where the closed form does not apply: fine rays around overlaps, none elsewhere.

The screen is cut into tiles. Every tile that a triangle with class not 0 touches is marked, and
rays are cast in marked tiles alone. An overlap is bounded by such triangles, so nothing is lost:
the volume is what the same lattice gives over the whole screen, to the last digit, and marking
more or fewer tiles changes nothing. The finer the rays, the smaller the overlaps' outline has to
be: the pixel is the finest of a few, each half of the last, for which the marked tiles hold no more
rays than a fixed number.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.beam import Beam, ScreenPoints, on_lattice, square_pixel, turned_frame
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import find_overlaps
from spt_jax.overlap.rays.tiles import Tiles, boxes
from spt_jax.overlap.triangles.segments import find_segments
from spt_jax.overlap.triangles.sheets import Sheets, find_sheets

# Rays along the longer side of the screen at refinement 0; tiles are two of its pixels wide.
BASE_RAYS = 512
_TILE = 2
# Refinements: 256 rays a side to 16384.
_COARSEST, _FINEST = -1, 5

# Rays in the marked tiles of one beam. Where even refinement -1 has more, it is taken all the
# same: at most 9 % more than 256 x 256 then.
MOST_MARKED = 16_000

# A triangle whose bounding box has more tiles than this is large: which of them matter is decided
# one by one. A tile with overlap lies wholly within it, and the ray through it sees it, or the
# overlap's outline passes through the tile, and that is made of edges and of the segments along
# which triangles cross.
_LARGE = 256

# Crossings this near to an edge or a vertex, as a part of the triangle, tell exact contact; and how
# far the vertices are then shaken, as a part of the mesh's size: more than what counts as contact
# in `triangles.vertex_winding`, and far less than a pixel.
_CONTACT, _SHAKE = 1e-9, 1e-6


def aim_at_sheets(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    direction: Float[np.ndarray, "3"],
    sheets: Sheets,
    bounding: Int[np.ndarray, "H"],
) -> tuple[Beam, ScreenPoints]:
    """A beam through the tiles that some of the bounding triangles touch, as fine as it may be."""
    frame = turned_frame(direction)
    pixel = square_pixel(vertices, direction, BASE_RAYS)
    bounding = _with_contact(vertices, faces, direction, sheets, bounding)

    def aim(refinement: int) -> tuple[Beam, ScreenPoints]:
        size = int(_TILE * 2.0**refinement)
        beam, points = on_lattice(vertices, frame, pixel / 2.0**refinement, size)
        marked = _mark(vertices, faces, sheets, bounding, beam, points, size)
        return Beam(beam.frame, beam.pixel, beam.origin, beam.shape, Tiles(size, marked)), points

    beam, points = aim(0)
    rays = max(beam.num_rays, 1)
    refinement = int(np.floor(np.log2(MOST_MARKED / rays) / 2))
    refinement = min(max(refinement, _COARSEST), _FINEST)
    return aim(refinement) if refinement else (beam, points)


def _with_contact(vertices, faces, direction, sheets: Sheets, bounding) -> Int[np.ndarray, "C"]:
    """The bounding triangles, and those that are only because solids coincide.

    A sheet on top of another counts as contact, whichever of the two bounds an overlap. Once the
    vertices are shaken apart, one of them is inside.
    """
    crossings = sheets.crossings
    corner, point = vertices[faces[crossings.face]], crossings.point
    opposite = np.cross(
        np.roll(corner, -1, 1) - point[:, None], np.roll(corner, -2, 1) - point[:, None]
    )
    area = np.linalg.norm(opposite, axis=2)
    ends = np.linalg.norm(vertices[crossings.edge] - point[:, None], axis=2)
    slight = area.min(axis=1) <= _CONTACT * area.max(axis=1)
    slight |= ends.min(axis=1) <= _CONTACT * ends.max(axis=1)
    if not (slight & np.isin(crossings.face, bounding)).any():
        return bounding
    shift = np.random.default_rng(0).normal(size=vertices.shape)
    shaken = vertices + _SHAKE * np.ptp(vertices, axis=0).max() * shift
    apart = find_sheets(shaken, faces, direction[None]).faces
    return np.union1d(bounding, apart[sheets.region[apart] < 0])


def _mark(vertices, faces, sheets, bounding, beam, points, size) -> Bool[np.ndarray, "R C"]:
    shape = tuple(-(-side // size) for side in beam.shape)
    marked = np.zeros(shape, bool)
    top, bottom, left, right = boxes(points.row, points.column, size, shape, faces[bounding])
    rows, columns = bottom - top + 1, right - left + 1
    large = rows * columns > _LARGE
    small = np.flatnonzero(~large)
    triangle = np.repeat(small, (rows * columns)[small])
    count = (rows * columns)[small]
    step = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    down, across = np.divmod(step, columns[triangle])
    marked[top[triangle] + down, left[triangle] + across] = True
    if large.any():
        suspect = _filled(shape, top[large], bottom[large], left[large], right[large]) & ~marked
        marked |= _seen(vertices, faces, beam, size, suspect)
        triangles = bounding[large]
        corner = vertices[faces[triangles]]
        segments = find_segments(vertices, faces, sheets)
        first, second = segments.pair.T
        segments = segments.only(np.isin(first, triangles) | np.isin(second, triangles))
        rims = segments.start, segments.end
        outline = corner.reshape(-1, 3), np.roll(corner, -1, axis=1).reshape(-1, 3)
        for start, end in (rims, outline):
            marked |= _along(start, end, beam, size, shape)
    return marked


def _filled(shape, top, bottom, left, right) -> Bool[np.ndarray, "R C"]:
    corner = np.zeros((shape[0] + 1, shape[1] + 1), np.int64)
    np.add.at(corner, (top, left), 1)
    np.add.at(corner, (bottom + 1, left), -1)
    np.add.at(corner, (top, right + 1), -1)
    np.add.at(corner, (bottom + 1, right + 1), 1)
    return corner.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0


def _seen(vertices, faces, fine: Beam, size: int, suspect) -> Bool[np.ndarray, "R C"]:
    # One ray a tile tells whether the tile lies within the overlap; tiles at its outline are found
    # by the edges and rims that make the outline.
    beam, points = on_lattice(vertices, fine.frame, fine.pixel * size)
    rows, columns = np.indices(beam.shape)
    row, column = (
        np.clip(
            np.floor(((index + beam.origin[axis]) * size - fine.origin[axis]) / size), 0, None
        ).astype(np.int64)
        for index, axis in ((rows, 1), (columns, 0))
    )
    row, column = (
        np.minimum(row, suspect.shape[0] - 1),
        np.minimum(column, suspect.shape[1] - 1),
    )
    coarse = Tiles(1, suspect[row, column])
    beam = Beam(beam.frame, beam.pixel, beam.origin, beam.shape, coarse)
    kept = cast(beam, points, faces, simple_rays=False)
    overlapped = find_overlaps(beam, points, faces, kept)
    seen = np.zeros(suspect.shape, bool)
    at = beam.locate(overlapped.ray)
    seen[row[at], column[at]] = True
    return seen


def _along(start, end, beam: Beam, size: int, shape) -> Bool[np.ndarray, "R C"]:
    # Sampled twice a tile, and marked with all neighbours: no tile that a segment enters is missed.
    marked = np.zeros(shape, bool)
    start, end = (
        (points @ beam.frame[:2].T / beam.pixel - beam.origin) / size for points in (start, end)
    )
    count = np.ceil(2 * np.abs(end - start).max(axis=1, initial=0)).astype(np.int64) + 2
    segment = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count, count)
    part = (step / (count - 1)[segment])[:, None]
    column, row = np.floor(start[segment] * (1 - part) + end[segment] * part).astype(np.int64).T
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            r, c = row + down, column + across
            inside = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
            marked[r[inside], c[inside]] = True
    return marked
