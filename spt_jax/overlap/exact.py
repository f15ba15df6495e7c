"""The included overlap of a surface: volume, gradient and labels, exactly."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.vectors import summed
from spt_jax.overlap.caps import beside_caps
from spt_jax.overlap.exclusions import NOTHING, Exclusions, pair_weights
from spt_jax.overlap.surface import ExactSurface, Layer, regions_of
from spt_jax.overlap.triangles.closed_form import gradient_of, volumes_of
from spt_jax.overlap.triangles.contours import length_gradient


class Judged(NamedTuple):
    """Overlap regions that are included with a share, which their contours decide.

    Attributes:
        layer: these overlaps.
        region: of each of the layer's triangles.
        at: the region of each of its segments.
        volume: of each region.
        length: of each region's contour.
        share: the part of that length that is included; 1 for a region without a contour.
    """

    layer: Layer
    region: Int[np.ndarray, "H"]
    at: Int[np.ndarray, "S"]
    volume: Float[np.ndarray, "R"]
    length: Float[np.ndarray, "R"]
    share: Float[np.ndarray, "R"]


class ExactOverlap:
    """The included overlap of a surface: volume, gradient and labels.

    Args:
        surface: the surface.
        exclusions: what is excluded.
    """

    def __init__(self, surface: ExactSurface, exclusions: Exclusions = NOTHING):
        self.surface = surface
        self._exclusions = exclusions
        self._layers = surface.layers(exclusions)

    @property
    def sound(self) -> bool:
        """Whether all sums close and all winding numbers fit together."""
        return all(layer.ends.fits and bool(layer.shares.sound.all()) for layer in self._layers)

    @property
    def layers(self) -> list[Layer]:
        """The overlaps included whole and, with exclusions, those that contours decide."""
        return self._layers

    @property
    def _whole(self) -> Layer:
        return self._layers[0]

    @cached_property
    def pair_weights(self) -> Float[np.ndarray, "P"]:
        """The weight of each of the surface's contours: 1 for a collision, 0 for a fold."""
        weight = np.zeros(len(self.surface.pairs))
        weight[self._whole.segments] = 1.0
        for layer in self._layers[1:]:
            on = np.flatnonzero(layer.segments)
            weight[on] = pair_weights(self._exclusions, *self.surface.pairs[on].T)
            if self.surface.manifold.num_fans:
                pairs = self.surface.contours.pair[on]
                weight[on] *= ~beside_caps(self.surface.manifold, *pairs.T)
        return weight * self.surface.proper

    @cached_property
    def judged(self) -> Judged | None:
        """The regions that contours decide; None without exclusions."""
        if len(self._layers) < 2:
            return None
        layer, surface = self._layers[1], self.surface
        region, count = regions_of(surface, layer)
        of_face = np.full(len(surface.manifold.faces), -1)
        of_face[layer.shares.faces] = region
        at = of_face[layer.contours.pair[:, 0]]
        volume = volumes_of(surface.points, surface.manifold.faces, layer.shares, region, count)
        length = layer.contours.length
        total = np.bincount(at, length, count)
        far = np.bincount(at, self.pair_weights[layer.segments] * length, count)
        share = np.where(total > 0, far / np.where(total > 0, total, 1.0), 0.0)
        share[np.bincount(at, minlength=count) == 0] = 1.0
        return Judged(layer, region, at, volume, total, share)

    @property
    def volume(self) -> float:
        """The included overlap volume."""
        return max(self.signed_volume, 0.0)

    @cached_property
    def signed_volume(self) -> float:
        """The sum from which the volume is taken.

        It falls below zero by rounding, or where a part that a fan turned inside out (w = -1) is
        excluded as a fold and another part overlaps it: then only their common overlap remains.
        """
        surface, shares, total = self.surface, self._whole.shares, 0.0
        if len(shares.faces):
            together = np.zeros(len(shares.faces), np.int64)
            faces, times = surface.manifold.faces, surface.times
            total = float(volumes_of(surface.points, faces, shares, together, 1, times)[0])
        if self.judged is not None:
            total += float(self.judged.volume @ self.judged.share)
        return total / surface.scale**3

    def gradient(self) -> Float[np.ndarray, "V 3"]:
        """The derivative of the volume, at the vertices given."""
        surface = self.surface
        faces, count = surface.manifold.faces, len(surface.points)
        total = gradient_of(faces, self._whole.shares, None, count)
        if self.judged is not None:
            total += self._judged_gradient(self.judged)
        total = surface.shared_out(total / surface.scale**2)
        return surface.manifold.gather(total, surface.count)

    def _judged_gradient(self, judged: Judged) -> Float[np.ndarray, "X 3"]:
        """The gradient of the sum of s V over the regions: s dV, and V ds where 0 < s < 1.

        With L the segments' lengths, k their weights (1 for a collision, 0 for a fold) and T the
        sum of L, s is the sum of k L over T, and ds the sum of (k - s) / T dL.
        """
        surface, layer, share = self.surface, judged.layer, judged.share
        faces, count = surface.manifold.faces, len(surface.points)
        total = gradient_of(faces, layer.shares, share[judged.region], count)
        mixed = ((share > 0) & (share < 1))[judged.at]
        if mixed.any():
            at, weight = judged.at[mixed], self.pair_weights[layer.segments][mixed]
            rate = judged.volume[at] * (weight - share[at]) / judged.length[at]
            intersections = surface.intersections.only(layer.counts)
            contours = layer.contours.only(mixed)
            vertex, force = length_gradient(surface.points, faces, intersections, contours, rate)
            total += summed(vertex, force, count)
        return total

    @cached_property
    def winding(self) -> Int[np.ndarray, "V"]:
        """w_out around each vertex given, 0 where its overlap is excluded.

        A vertex at which several sheets meet takes the number that is nearest to zero.
        """
        surface, judged = self.surface, self.judged
        found = surface.labels(self._whole, self._exclusions)
        if judged is not None:
            counting = judged.layer.shares.faces[(judged.share > 0)[judged.region]]
            kept = np.zeros(len(found), bool)
            kept[surface.manifold.faces[counting]] = True
            own = surface.labels(judged.layer, self._exclusions)
            found = np.where(found != 0, found, np.where(kept, own, 0))
        found = surface.with_copies(found)
        if surface.manifold.is_given:
            return found
        given = np.full(surface.count, np.iinfo(np.int64).max)
        order = np.argsort(-np.abs(found[: len(surface.manifold.origin)]), kind="stable")
        given[surface.manifold.origin[order]] = found[order]  # the last one written stays
        return given

    @property
    def intersecting_pairs(self) -> int:
        """How many pairs of the triangles given intersect and are included."""
        return self.surface.count_pairs((self.pair_weights > 0) & self.surface.listed)

    def areas(
        self,
    ) -> tuple[Int[np.ndarray, "H"], Int[np.ndarray, "H 3"], Float[np.ndarray, "H"]]:
        """Faces given that bound included overlaps, w_out at their corners, and its mean."""
        manifold, parts = self.surface.manifold, []
        for layer in self._layers:
            faces = layer.shares.faces
            kept = manifold.kept[faces] >= 0
            if self.judged is not None and layer is self.judged.layer:
                kept &= (self.judged.share > 0)[self.judged.region]
            faces = faces[kept]
            corners = layer.ends.of_vertices()[:, layer.column][manifold.faces[faces]]
            share = 2 * layer.shares.share[kept].sum(axis=1)
            parts.append((manifold.kept[faces], corners, share))
        faces, corners, share = (np.concatenate(x) for x in zip(*parts, strict=True))
        return faces, corners, share
