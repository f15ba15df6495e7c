"""The overlap volume and its gradient in closed form, without rays.

A triangle's share of the gradient at its corner t is its normal times the integral of c lambda_t
over it (`overlap.boundary`), and c = sign(w_out) is constant but for jumps of one where other
triangles pass through. Where |w_out| <= 1, c is w_out itself, so Green's theorem in barycentric
coordinates (u, v), with dF/du = lambda_t,

    integral of w lambda_t du dv = sum over the triangle's sides of the integral of w F dv
                                 + sum over the crossing segments of (w_left - w_right) F dv,

needs no subdivision: w along a side is w_out at its end plus a jump wherever the side passes
through a triangle, and F is quadratic, so Simpson's rule is exact. The volume follows from the
gradient, because it is homogeneous of degree three: 3 E = sum of (x_t - center) . grad_t E.

Nothing is taken on trust. The same sums with constants in the place of F must be zero on every
triangle, which they are only if corners, sides and segments fit together, and the gradient of each
region must sum to zero. Regions where that fails (holes, exact contact), and those deeper than a
double overlap, are left to the rays.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.boundary import area_normals, cross, summed
from spt_jax.overlap.triangles.segments import Cusps, crossed_triangles, find_segments
from spt_jax.overlap.triangles.sheets import Sheets

# What the sums with constants, of sides of length one, may leave.
_GAP = 1e-6

# Sum of a region's gradient, against the sum of its parts' sizes.
_CLOSED = 1e-6

# Regions compared with all others together.
_AT_ONCE = 64

_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # (u, v) of a triangle's corners


@dataclass(frozen=True)
class ClosedForm:
    """Regions of overlap measured without rays.

    Attributes:
        solved: the regions that are; the others have neither volume nor gradient here.
        volume: of each region.
        share: integral of c lambda_t over each of `Sheets.faces`, in units of twice its area.
    """

    solved: Bool[np.ndarray, "R"]
    volume: Float[np.ndarray, "R"]
    share: Float[np.ndarray, "H 3"]


def solve(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], sheets: Sheets
) -> ClosedForm:
    """Volume and gradient of every region of overlap where the closed form applies."""
    found, corners = sheets.faces, faces[sheets.faces]
    row = np.full(len(faces), -1)
    row[found] = np.arange(len(found))
    normals = area_normals(vertices, corners)

    segments = find_segments(vertices, faces, sheets)
    # Each segment is a jump on both of its triangles.
    whole = segments.only(segments.whole)
    own, foreign = whole.pair.ravel(), whole.pair[:, ::-1].ravel()
    start, end = (np.repeat(x, 2, axis=0) for x in (whole.start, whole.end))
    # On the left of the segment, seen against the own normal, is the foreign solid's inside?
    left = cross(normals[row[own]], end - start)
    jump = -np.sign(np.einsum("ki,ki->k", left, normals[row[foreign]]))
    cusps = whole.cusps(faces, row, own, jump)
    sums, sound, deep = _sides(vertices, faces, sheets, row, cusps)
    start, end = (
        _coordinates(vertices, corners[row[own]], normals[row[own]], x) for x in (start, end)
    )
    sums += summed(row[own], jump[:, None] * _along(start, end), len(found))
    deep |= crossed_triangles(row[own], start, end, len(found))
    sound &= (np.abs(sums[:, 3:]) < _GAP).all(axis=1)
    sound[row[segments.pair[~segments.whole]]] = False

    share = sums[:, :3]
    region = sheets.region[found]
    fits = np.bincount(region, ~sound, sheets.num_regions) == 0
    shallow = np.bincount(region, deep, sheets.num_regions) == 0
    return _volumes(vertices[corners], normals, share, region, fits, shallow)


def gradient(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sheets: Sheets,
    closed: ClosedForm,
    regions: Bool[np.ndarray, "R"],
) -> Float[np.ndarray, "V 3"]:
    """The gradient of the volume of some of the solved regions."""
    kept = np.flatnonzero(regions[sheets.region[sheets.faces]])
    corners = faces[sheets.faces[kept]]
    normals = area_normals(vertices, corners)
    pull = closed.share[kept][:, :, None] * normals[:, None, :]
    return summed(corners.ravel(), pull.reshape(-1, 3), len(vertices))


def without_entangled(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sheets: Sheets,
    closed: ClosedForm,
    regions: Bool[np.ndarray, "R"],
) -> Bool[np.ndarray, "R"]:
    """Those of some solved regions that share no overlap with one that is left to the rays."""
    hollow = closed.volume < 0
    points = vertices[faces[sheets.faces]]
    return _without_entangled(points, sheets.region[sheets.faces], regions, hollow, hollow)


def _volumes(points, normals, share, region, fits, shallow) -> ClosedForm:
    count = len(fits)
    faces_in = np.maximum(np.bincount(region, minlength=count), 1)
    center = summed(region, points.mean(axis=1), count) / faces_in[:, None]
    pull = share[:, :, None] * normals[:, None, :]
    arm = points - center[region][:, None, :]
    volume = np.bincount(region, np.einsum("kci,kci->k", arm, pull), count) / 3
    size = np.bincount(region, np.abs(pull).sum(axis=(1, 2)), count)
    total = np.abs(summed(region, pull.sum(axis=1), count))
    fits = fits & (total <= _CLOSED * size[:, None]).all(axis=1)
    solved = _without_entangled(points, region, fits & shallow, (volume < 0) | ~fits, volume < 0)
    return ClosedForm(solved, np.where(solved, volume, 0.0), share)


def _without_entangled(points, region, solved, may_be_hollow, hollow) -> Bool[np.ndarray, "R"]:
    """The solved regions that share no overlap with one that is not.

    A cavity in an overlap is a region of its own, with a negative volume. Rays see the two at once:
    an interval ends at the one and at the other, so both or neither must be left to them.
    """
    if solved.all() or not solved.any():
        return solved
    low = np.full((len(solved), 3), np.inf)
    np.minimum.at(low, region, points.min(axis=1))
    high = np.full((len(solved), 3), -np.inf)
    np.maximum.at(high, region, points.max(axis=1))
    solved = solved.copy()
    left = np.flatnonzero(~solved)
    while len(left):
        now, left = left[:_AT_ONCE], left[_AT_ONCE:]
        around = (low <= low[now, None]).all(axis=2) & (high >= high[now, None]).all(axis=2)
        within = (low >= low[now, None]).all(axis=2) & (high <= high[now, None]).all(axis=2)
        entangled = (around & may_be_hollow[now, None]) | (within & hollow)
        more = np.flatnonzero(solved & entangled.any(axis=0))
        solved[more] = False
        left = np.concatenate([left, more])
    return solved


def _coordinates(vertices, corners, normals, point) -> Float[np.ndarray, "K 2"]:
    """(u, v) of points on triangles: their barycentric coordinates at corners 1 and 2."""
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    square = np.maximum(np.einsum("ki,ki->k", normals, normals), np.finfo(float).tiny)
    u = np.einsum("ki,ki->k", normals, cross(point - a, c - a)) / square
    v = np.einsum("ki,ki->k", normals, cross(b - a, point - a)) / square
    return np.stack([u, v], axis=1)


def _along(start, end) -> Float[np.ndarray, "K 5"]:
    """Integrals of F dv from start to end for the three corners, by Simpson's rule; du; dv."""
    u, v = np.stack([start, (start + end) / 2, end]).transpose(2, 0, 1)
    field = np.stack([u - u * u / 2 - u * v, u * u / 2, u * v], axis=2)
    step = end - start
    integrals = np.einsum("p,pkc->kc", [1 / 6, 4 / 6, 1 / 6], field) * step[:, 1, None]
    return np.concatenate([integrals, step], axis=1)


def _sides(vertices, faces, sheets: Sheets, row, cusps: Cusps):
    """The sides' part of all sums; where they are known; which triangles lie deeper than w = 1."""
    corners = faces[sheets.faces]
    count = len(corners)
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    side_start = np.tile(_CORNERS, (count, 1))
    side_end = np.tile(np.roll(_CORNERS, -1, axis=0), (count, 1))

    # Each edge that passes through a triangle is a side of two others.
    crossings = sheets.crossings
    face = crossings.edge_faces.T.ravel()
    kept = np.flatnonzero(face >= 0)
    face, piercing = face[kept], np.tile(np.arange(len(crossings.face)), 2)[kept]
    low, high = crossings.edge[piercing].T
    own = faces[face]
    first = np.argmax((own == low[:, None]) | (own == high[:, None]), axis=1)
    wraps = (first == 0) & (own[:, 1] != low) & (own[:, 1] != high)
    side = 3 * row[face] + np.where(wraps, 2, first)
    forward = start[side] == low
    along = vertices[high] - vertices[low]
    through = area_normals(vertices, faces[crossings.face[piercing]])
    # Going along a side into a solid raises the winding number by one.
    jump = -np.sign(np.einsum("ki,ki->k", along, through)) * np.where(forward, 1.0, -1.0)
    length = np.maximum(np.einsum("ki,ki->k", along, along), np.finfo(float).tiny)
    part = np.einsum("ki,ki->k", crossings.point[piercing] - vertices[low], along) / length
    part = np.clip(np.where(forward, part, 1 - part), 0.0, 1.0)

    begins, known = _at_starts(start, end, np.bincount(side, jump, len(start)), sheets, cusps)
    at = side_start[side] + part[:, None] * (side_end - side_start)[side]
    sums = begins[:, None] * _along(side_start, side_end)
    sums += summed(side, jump[:, None] * _along(at, side_end[side]), len(start))
    sums = sums.reshape(count, 3, 5).sum(axis=1)

    # The winding number after each jump; before the first it is that of the corner.
    order = np.lexsort((part, side))
    run = np.cumsum(jump[order])
    new = np.concatenate([[True], np.diff(side[order]) > 0])[: len(order)]
    before = np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))
    after = begins[side[order]] + run - (run[before] - jump[order][before])
    deep = np.bincount(side[order][np.abs(after) > 1] // 3, minlength=count) > 0
    deep |= (np.abs(begins) > 1).reshape(count, 3).any(axis=1)
    return sums, known.reshape(count, 3).all(axis=1), deep


def _at_starts(start, end, total_jump, sheets: Sheets, cusps: Cusps):
    """The winding number on the outer side at the start of each side, and where it is known.

    It is the corner's, or that of the side's other end without the jumps between. At a cusp a
    corner has one number for each of its sides; there it comes from the side before or after, over
    the segments that end in the corner, or from the triangle on the other side of the edge.
    """
    trusted = np.ones(len(sheets.winding), bool)
    trusted[cusps.vertices] = False
    begins = np.where(trusted[start], sheets.winding[start], sheets.winding[end] - total_jump)
    known = trusted[start] | trusted[end]
    sides = np.arange(len(start)).reshape(-1, 3)
    before, after = (np.roll(sides, shift, axis=1).ravel() for shift in (1, -1))
    for _ in range(2):
        for other, value in (
            (before, begins[before] + total_jump[before] - cusps.jump),
            (after, begins[after] + cusps.jump[after] - total_jump),
        ):
            begins = np.where(known, begins, value)
            known = known | known[other]
        if known.all():
            break
        _ask_neighbours(start, end, begins, total_jump, known)
    return begins, known


def _ask_neighbours(start, end, begins, total_jump, known) -> None:
    lost = np.flatnonzero(~known)
    size = max(start.max(), end.max()) + 1
    order = np.argsort(start * size + end)
    reverse = end[lost] * size + start[lost]
    at = np.searchsorted((start * size + end)[order], reverse)
    twin = order[np.minimum(at, len(order) - 1)]
    there = (start[twin] == end[lost]) & (end[twin] == start[lost])
    # A neighbour that is in no overlap is not among the sides: nothing overlaps along the edge.
    begins[lost] = np.where(there, begins[twin] + total_jump[twin], 0.0)
    known[lost] = ~there | known[twin]
