"""Counters along each ray and the overlaps that they enclose.

The counter after a crossing is the winding number w of the gap that follows it (Algorithm 1,
lines 16-18, for any depth). A gap counts w (w - 1) / 2 times: not at all outside and inside one
solid, once where two overlap or where the surface is inside out, three times where three overlap,
so that every pair of solids counts once where it overlaps.

Crossing a sheet inwards, from w_out to w_out + 1, adds w_out to that. So it is the sum of l - 1
over the levels l = 2, 3, ... with w >= l, and of 1 - l over l = 0, -1, ... with w < l: the overlap
of a ray is a sum of intervals, one level each, which count |l - 1| times, and every crossing whose
w_out = l - 1 is not zero ends exactly one of them. An interval belongs to four sheets: the two
that bound it, and the two that open and close the solid around it, which bound the interval one
level down.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.beam import Beam, ScreenPoints
from spt_jax.overlap.rays.crossings import Crossings

# A triangle seen edge-on is a line on the screen. Narrower than this, in pixels, rounding decides
# which rays hit it and at which of its depths, and nothing on such a ray can be determined.
NARROWEST = 1e-5

# Overlaps thinner than this part of the mesh's depth are no overlaps: where a ray grazes a
# silhouette, the order of two crossings at one depth is a matter of rounding.
THINNEST = 1e-7


@dataclass(frozen=True)
class Overlaps:
    """The overlapped intervals on the rays of a beam.

    Attributes:
        ray: the ray's number, as in `Beam.locate`.
        ends: the triangles that each interval begins and ends at.
        around: the triangles that open and close the solid around it, outside which it has one
            level less; -1 for an interval inside out, which has none.
        barycentric: of the two points where the ray crosses `ends`.
        outer: w_out at both ends, which is the interval's level less one; its sign is their label,
            +1 penetrating and -1 inverted.
        length: from end to end. The interval counts |w_out| times.
    """

    ray: Int[np.ndarray, "N"]
    ends: Int[np.ndarray, "N 2"]
    around: Int[np.ndarray, "N 2"]
    barycentric: Float[np.ndarray, "N 2 3"]
    outer: Int[np.ndarray, "N"]
    length: Float[np.ndarray, "N"]

    @property
    def size(self) -> float:
        """The lengths, each as often as it counts: times the area of a ray, the overlap volume."""
        return float((np.abs(self.outer) * self.length).sum())

    def only(self, kept: Bool[np.ndarray, "N"]) -> "Overlaps":
        """Some of the intervals."""
        if kept.all():
            return self
        return replace(self, **{name: value[kept] for name, value in vars(self).items()})


def winding_numbers(crossings: Crossings) -> Int[np.ndarray, "N"]:
    """The winding number of the gap behind every crossing."""
    # Every ray's signs sum to zero, so one sum over all rays serves each of them.
    return np.cumsum(crossings.sign)


def find_overlaps(
    beam: Beam, points: ScreenPoints, faces: Int[np.ndarray, "F 3"], crossings: Crossings
) -> Overlaps:
    """The overlapped intervals of a beam, measured exactly where it matters.

    Only the few per cent of crossings that bound an interval get barycentric coordinates and an
    exact depth; the rest were only sorted.
    """
    # A crossing's level is the larger of the winding numbers on its two sides.
    level = winding_numbers(crossings) + (crossings.sign < 0)
    found = np.flatnonzero(level != 1)
    if len(found):
        hit_edge_on = _edge_on(points, faces, crossings.face)
        if hit_edge_on.any():
            found = found[~np.isin(crossings.ray[found], crossings.ray[hit_edge_on])]
    levels, ray = level[found], crossings.ray[found]
    # Along a ray the crossings of one level open and close in turn.
    lowest = levels.min(initial=0)
    order = np.argsort(ray * (levels.max(initial=0) - lowest + 1) + levels - lowest, kind="stable")
    pair = found[order].reshape(-1, 2)
    levels = levels[order[::2]]

    ends = crossings.face[pair]
    barycentric = _barycentric(beam, points, faces[ends.ravel()], crossings.ray[pair.ravel()])
    depth = np.einsum("kc,kc->k", barycentric, points.depth[faces[ends.ravel()]]).reshape(-1, 2)
    length = depth[:, 1] - depth[:, 0]

    # Intervals within an outermost one, of level 2 or 0, form a run with it.
    outermost = np.zeros(len(level), bool)
    outermost[pair[(levels == 2) | (levels == 0), 0]] = True
    run = np.cumsum(outermost)[pair[:, 0]]
    thinnest = max(2 * crossings.depth_quantum, THINNEST * np.ptp(points.depth))
    kept = np.bincount(run, length)[run] > thinnest if len(run) else np.zeros(0, bool)
    return Overlaps(
        ray=crossings.ray[pair[:, 0]],
        ends=ends,
        around=_around(level, crossings.face, pair[:, 0], levels),
        barycentric=barycentric.reshape(-1, 2, 3),
        outer=levels - 1,
        length=length,
    ).only(kept)


def _around(level, face, opens, levels) -> Int[np.ndarray, "N 2"]:
    around = np.full((len(opens), 2), -1)
    for inner in np.unique(levels[levels > 1]):
        rows = np.flatnonzero(levels == inner)
        # To rise to a level a ray has to pass the one below, so the nearest crossings of that
        # level before and after, on whichever ray, are on the same one.
        below = np.flatnonzero(level == inner - 1)
        close = np.searchsorted(below, opens[rows])
        around[rows] = face[below[np.stack([close - 1, close], axis=1)]]
    return around


def _edge_on(
    points: ScreenPoints, faces: Int[np.ndarray, "F 3"], hit: Int[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Which crossings are with triangles that are lines on the screen."""
    met = np.zeros(len(faces), bool)
    met[hit] = True
    met = np.flatnonzero(met)
    x0, x1, x2 = points.column[faces[met].T]
    y0, y1, y2 = points.row[faces[met].T]
    twice_area = np.abs((x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0))
    size = np.abs(x1 - x0) + np.abs(y1 - y0) + np.abs(x2 - x0) + np.abs(y2 - y0)
    narrow = np.zeros(len(faces), bool)
    narrow[met[twice_area <= NARROWEST * size]] = True
    return narrow[hit]


def _barycentric(
    beam: Beam, points: ScreenPoints, corners: Int[np.ndarray, "K 3"], ray: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K 3"]:
    row, column = beam.locate(ray)
    x0, x1, x2 = points.column[corners.T] - column
    y0, y1, y2 = points.row[corners.T] - row
    weights = np.stack([x1 * y2 - y1 * x2, x2 * y0 - y2 * x0, x0 * y1 - y0 * x1])
    total = weights.sum(axis=0)
    weights /= np.where(total != 0, total, 1.0)
    np.clip(weights, 0.0, 1.0, out=weights)
    # A triangle with no area on the screen was crossed by rounding alone: take its center.
    whole = weights.sum(axis=0)
    return np.where(whole > 0, weights / np.where(whole > 0, whole, 1.0), 1.0 / 3.0).T
