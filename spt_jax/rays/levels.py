"""Counters along each ray, the overlap they enclose, and its derivative by depth.

The counter after a crossing is the winding number w of the gap that follows it (Algorithm 1,
lines 16-18, for any depth). A gap counts phi(w) = max(w - 1, 0) + max(-w, 0) times: nothing
outside and once inside, once where two parts overlap, twice where three do, once where the
surface is inside out.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.rays.beam import Beam, ScreenPoints
from spt_jax.rays.crossings import Crossings

# A triangle seen edge-on is a line on the screen. Narrower than this, in pixels, rounding decides
# which rays hit it and at which of its depths, and nothing on such a ray can be told.
_NARROWEST = 1e-5

# Overlaps thinner than this part of the mesh's depth are no overlaps: where a ray grazes a
# silhouette, the order of two crossings at one depth is a matter of rounding.
_THINNEST = 1e-7


@dataclass(frozen=True)
class Overlaps:
    """The crossings that bound overlapped gaps, and what they enclose.

    Attributes:
        face: the triangle that is crossed.
        barycentric: of the point where the ray crosses it.
        class_sign: sign(w_out), the crossing's class: +1 on V_out, -1 on V_in, 0 where the gaps
            on both of its sides count alike (never, but for gaps too thin to count).
        length: the sum over gaps of phi(w) * length of the whole beam; times the area of a ray
            this is the overlap volume.
    """

    face: Int[np.ndarray, "K"]
    barycentric: Float[np.ndarray, "K 3"]
    class_sign: Int[np.ndarray, "K"]
    length: float


def winding_numbers(crossings: Crossings) -> Int[np.ndarray, "N"]:
    """The winding number of the gap behind every crossing."""
    # Every ray's signs sum to zero, so one sum over all rays serves each of them.
    return np.cumsum(crossings.sign)


def find_overlaps(
    beam: Beam, points: ScreenPoints, faces: Int[np.ndarray, "F 3"], crossings: Crossings
) -> Overlaps:
    """The overlapped gaps of a beam, measured exactly where it matters.

    Only the few per cent of crossings that bound an overlapped gap get barycentric coordinates
    and an exact depth; the rest were only sorted.
    """
    winding = winding_numbers(crossings)
    gap = np.flatnonzero(winding >> 1)  # all but 0 and 1
    if len(gap):
        hit_edge_on = _edge_on(points, faces)[crossings.face]
        if hit_edge_on.any():
            gap = gap[~np.isin(crossings.ray[gap], crossings.ray[hit_edge_on])]
    weight = np.maximum(winding[gap] - 1, -winding[gap])

    # Adjacent overlapped gaps form a run; crossings gap and gap + 1 bound each gap.
    new_run = np.concatenate([[True], np.diff(gap) > 1])[: len(gap)]
    run = np.cumsum(new_run) - 1
    bounds = np.zeros(len(winding) + 1, bool)
    bounds[gap] = bounds[gap + 1] = True
    crossing = np.flatnonzero(bounds)
    start = np.searchsorted(crossing, gap)
    face = crossings.face[crossing]
    barycentric = _barycentric(beam, points, faces[face], crossings.ray[crossing])
    depth = np.einsum("kc,kc->k", barycentric, points.depth[faces[face]])

    length = depth[start + 1] - depth[start]
    thinnest = max(2 * crossings.depth_quantum, _THINNEST * np.ptp(points.depth))
    if len(gap):
        weight = weight * (np.bincount(run, weight * length)[run] > thinnest)
    # d(overlap)/d(depth): the gap in front of a crossing grows, the one behind it shrinks.
    by_depth = np.bincount(start + 1, weight, len(crossing)) - np.bincount(
        start, weight, len(crossing)
    )
    class_sign = (-crossings.sign[crossing] * by_depth).astype(np.int64)
    return Overlaps(face, barycentric, class_sign, float(weight @ length))


def _edge_on(points: ScreenPoints, faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, "F"]:
    x0, x1, x2 = points.column[faces.T]
    y0, y1, y2 = points.row[faces.T]
    twice_area = np.abs((x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0))
    size = np.abs(x1 - x0) + np.abs(y1 - y0) + np.abs(x2 - x0) + np.abs(y2 - y0)
    return twice_area <= _NARROWEST * size


def _barycentric(
    beam: Beam, points: ScreenPoints, corners: Int[np.ndarray, "K 3"], ray: Int[np.ndarray, "K"]
) -> Float[np.ndarray, "K 3"]:
    row, column = np.divmod(ray, beam.shape[1])
    x0, x1, x2 = points.column[corners.T] - column
    y0, y1, y2 = points.row[corners.T] - row
    weights = np.stack([x1 * y2 - y1 * x2, x2 * y0 - y2 * x0, x0 * y1 - y0 * x1])
    total = weights.sum(axis=0)
    weights /= np.where(total != 0, total, 1.0)
    np.clip(weights, 0.0, 1.0, out=weights)
    # A triangle with no area on the screen was crossed by rounding alone: take its centre.
    whole = weights.sum(axis=0)
    return np.where(whole > 0, weights / np.where(whole > 0, whole, 1.0), 1.0 / 3.0).T
