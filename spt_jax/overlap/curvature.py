"""Second derivatives of the included overlap volume, in closed form.

The gradient is a sum over triangles of the area normal n times the integral S_t of w_out lambda_t
over the triangle (`triangles/closed_form.py`). With the vertices it changes by n' S_t + n S_t'. n
is a polynomial; w_out is constant but across the intersection contours, so that by Reynolds'
theorem

    S_t' = sum over the contour's segments of their jump of w times the integral of lambda_t times
           the velocity at which the segment moves across itself, over the triangle,

which in space is the velocity of the other triangle against this one along the other's normal, over
the sine of the angle between the two. What counts with a share s of its contour's length has
d(s V) = s dV + V ds, and the derivative of that by the product rule, with second derivatives of the
lengths.

Exact wherever the volume has second derivatives: everywhere but where surfaces touch, edge meets
edge or vertex meets triangle. There the volume is continuous with its gradient, but for triangles
that lie in each other, and what comes back is the curvature on one side.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import cross, dot, summed
from spt_jax.overlap.exact import ExactOverlap, Judged
from spt_jax.overlap.surface import Layer
from spt_jax.overlap.triangles.moving_contours import MovingContours, Rates


class _Moving(NamedTuple):
    """One layer: its contours, its triangles' sides, and of each face the row among them."""

    layer: Layer
    contours: MovingContours
    corners: Int[np.ndarray, "H 3"]
    ab: Float[np.ndarray, "H 3"]
    ac: Float[np.ndarray, "H 3"]
    row: Int[np.ndarray, "F"]


class Curvature:
    """The Hessian of a surface's overlap volume, as the linear map that it is.

    Symmetric, and zero on rigid motions of all of the surface but for what turns the gradient.

    Args:
        overlap: what was measured; only data of its contours and triangles are kept.
    """

    def __init__(self, overlap: ExactOverlap):
        self._surface = surface = overlap.surface
        self._judged = overlap.judged
        self._weights = None
        if self._judged is not None:
            self._weights = overlap.pair_weights[self._judged.layer.segments]
        self._layers = [self._moving(layer) for layer in overlap.layers]
        self._count = len(surface.points)

    def _moving(self, layer: Layer) -> _Moving:
        surface, shares = self._surface, layer.shares
        faces = surface.manifold.faces
        intersections = surface.intersections.only(layer.counts)
        contours = MovingContours(
            surface.points, surface.topology, intersections, layer.contours, surface.reach
        )
        corners = faces[shares.faces]
        a, b, c = surface.points[corners].transpose(1, 0, 2)
        row = np.full(len(faces), -1)
        row[shares.faces] = np.arange(len(shares.faces))
        return _Moving(layer, contours, corners, b - a, c - a, row)

    def times(self, velocity: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """How fast the gradient changes when the vertices move with this velocity."""
        surface = self._surface
        placed = surface.carried(surface.manifold.place(velocity))
        total = np.zeros((self._count, 3))
        for moving in self._layers:
            if len(moving.layer.shares.faces):
                total += self._of_layer(moving, placed)
        total = surface.shared_out(total / surface.scale)
        return surface.manifold.gather(total, surface.count)

    def _of_layer(self, moving: _Moving, velocity) -> Float[np.ndarray, "X 3"]:
        shares, times = moving.layer.shares, self._surface.times
        at = velocity[moving.corners]
        a, b, c = at.transpose(1, 0, 2)
        turns = cross(b - a, moving.ac) + cross(moving.ab, c - a)
        rates = moving.contours.moving.rates(velocity)
        change = moving.contours.share_rates(rates, moving.row, len(shares.faces), times)
        pull = (
            shares.share[:, :, None] * turns[:, None] + change[:, :, None] * shares.normals[:, None]
        )
        judged = self._judged
        if judged is None or judged.layer is not moving.layer:
            return summed(moving.corners.ravel(), pull.reshape(-1, 3), self._count)
        volume = np.bincount(
            judged.region, np.einsum("kci,kci->k", shares.pull, at), len(judged.volume)
        )
        share, extra = self._of_shares(moving, judged, velocity, rates, volume)
        pull *= judged.share[judged.region][:, None, None]
        pull += share[judged.region][:, None, None] * shares.pull
        return extra + summed(moving.corners.ravel(), pull.reshape(-1, 3), self._count)

    def _of_shares(
        self,
        moving: _Moving,
        judged: Judged,
        velocity: Float[np.ndarray, "X 3"],
        rates: Rates,
        volume: Float[np.ndarray, "R"],
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "X 3"]]:
        """How fast each region's share changes, and the derivative of V ds but for V' ds.

        Args:
            moving, judged: the overlaps.
            velocity: of the vertices.
            rates: of the intersections.
            volume: how fast each region's volume changes.
        """
        mixed = (judged.share > 0) & (judged.share < 1)
        if self._weights is None or not mixed.any():
            return np.zeros(len(volume)), np.zeros((self._count, 3))
        contours, at, count = moving.contours, judged.at, len(volume)
        moves = contours.end_velocities(rates, velocity)
        lengthens = dot(contours.along, moves[:, 1] - moves[:, 0])
        length = np.where(judged.length > 0, judged.length, np.inf)
        over = np.where(mixed[at], self._weights - judged.share[at], 0.0)
        share = np.bincount(at, over * lengthens, count) / length
        total = np.bincount(at, lengthens, count)
        # The forces are V (k - s) / T along the segments of a region's contour.
        each = over / length[at]
        weight = judged.volume[at] * each
        change = volume[at] * each - weight * (total / length)[at]
        change -= np.where(mixed[at], (judged.volume * share / length)[at], 0.0)
        extra = contours.length_curvature(velocity, rates, weight, change, self._count)
        return share, extra
