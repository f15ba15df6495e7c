"""One mesh measured: volume, gradient and labels, exactly or by rays."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.boundary import boundary_gradient, vertex_gradient
from spt_jax.overlap.caps import Closed, Hole, closed_surface, holes_of, open_sheets
from spt_jax.overlap.curvature import Curvature
from spt_jax.overlap.exact import ExactOverlap
from spt_jax.overlap.exclusions import (
    NOTHING,
    ContourDecisions,
    Exclusions,
    decide_by_contours,
    included_intervals,
)
from spt_jax.overlap.labels import add_labels_without_rays, triangle_labels
from spt_jax.overlap.rays.beam import Beam, Rays, aim
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import Overlaps, find_overlaps
from spt_jax.overlap.surface import ExactSurface, regions_of
from spt_jax.overlap.triangles.manifold import Manifold, manifold_of
from spt_jax.overlap.triangles.near_triangles import Entangled

Directions = tuple[tuple[float, float, float], ...]
Gradient = Literal["boundary", "vertex", "unit"]
Rule = Literal["vertex", "triangle"]

# Of a mesh, in units in the last place of its largest coordinate. In float32 a body that stands 14
# km from the origin is this small: its triangles are as large as the rounding.
LEAST_EXTENT = 1024

# Of the largest coordinate: volumes beyond would overflow, or vanish.
LEAST_SIZE, MOST_SIZE = 1e-100, 1e100

# Where the exact sums do not close, which no closed mesh has been seen to do.
_FALLBACK_RAYS = 512


class Unmeasurable(ValueError):
    """A mesh has no surface that could be measured; the message says why."""


class OpenSheets(Unmeasurable):
    """It has a part that is an open sheet, which encloses nothing."""


class Sampling(NamedTuple):
    """How a mesh is measured: exactly (`rays=None`) or by rays, and the directions of the beams."""

    rays: Rays
    directions: Directions


@dataclass(frozen=True)
class Probe:
    """What one beam found.

    Attributes:
        beam: the rays.
        overlaps: the overlaps that are included.
        everything: all overlaps.
        crossings: of rays with triangles.
    """

    beam: Beam
    overlaps: Overlaps
    everything: Overlaps
    crossings: int

    @property
    def volume(self) -> float:
        """E_d: the overlap lengths on the rays times the screen area of a ray."""
        return self.overlaps.size * self.beam.ray_area

    @property
    def total_volume(self) -> float:
        """The same with all overlaps, the excluded ones too."""
        return self.everything.size * self.beam.ray_area


@dataclass(frozen=True)
class Measurement:
    """One mesh measured.

    Attributes:
        vertices, faces: the mesh.
        sampling: how it is measured.
        exclusions: what is excluded.
        rounding: machine epsilon of the numbers that the vertices came in.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    sampling: Sampling
    exclusions: Exclusions
    rounding: float

    @cached_property
    def surface(self) -> ExactSurface:
        """What intersects, found from the triangles.

        Raises:
            Unmeasurable: too much does to be listed.
        """
        try:
            merged = not self.exclusions.any
            return ExactSurface(self.vertices, self.faces, self.rounding, merged=merged)
        except Entangled as tangle:
            raise Unmeasurable(str(tangle)) from None

    @property
    def manifold(self) -> Manifold:
        """The surface closed and cut into sheets."""
        return manifold_of(self.faces, len(self.vertices))

    @cached_property
    def closed(self) -> Closed:
        """The surface with fans in place of its holes."""
        return closed_surface(self.manifold, self.vertices, self.faces)

    @property
    def holes(self) -> list[Hole]:
        """The boundary loops, which fans close."""
        return holes_of(self.manifold, self.vertices)

    @cached_property
    def overlap(self) -> ExactOverlap:
        """The included overlap, from the triangles alone."""
        return ExactOverlap(self.surface, self.exclusions)

    @cached_property
    def everything(self) -> ExactOverlap:
        """All overlap, excluded or not."""
        if not self.exclusions.any:
            return self.overlap
        return ExactOverlap(self.surface)

    @cached_property
    def curvature(self) -> Curvature:
        """Second derivatives of the included volume, where it is exact."""
        return Curvature(self.overlap)

    @property
    def exact(self) -> bool:
        """Whether the volume is exact: no rays were asked for, and all exact sums close."""
        return self.sampling.rays is None and self.overlap.sound

    @cached_property
    def beams(self) -> list[Probe]:
        """Every beam of the sampling, cast through the mesh; none where it is measured exactly."""
        if self.exact:
            return []
        found = [self._along(direction) for direction in self.sampling.directions]
        if self.exclusions.any:
            beside = np.append(self.closed.beside, -1)
            named = [
                replace(probe.everything, ends=beside[all_.ends], around=beside[all_.around])
                for probe in found
                for all_ in [probe.everything]
            ]
            counted = included_intervals(self.exclusions, self._contour_decisions, named)
            found = [
                replace(probe, overlaps=probe.everything.only(kept))
                for probe, kept in zip(found, counted, strict=True)
            ]
        return found

    def _along(self, direction: tuple[float, float, float]) -> Probe:
        rays = self.sampling.rays if self.sampling.rays is not None else _FALLBACK_RAYS
        vertices, faces, _ = self.closed
        beam, points = aim(vertices, np.array(direction), rays)
        crossings = cast(beam, points, faces, simple_rays=False)
        overlaps = find_overlaps(beam, points, faces, crossings)
        return Probe(beam, overlaps, overlaps, crossings.met)

    @property
    def _contour_decisions(self) -> ContourDecisions:
        (layer,) = self.surface.layers(None)
        region, count = regions_of(self.surface, layer)
        of_face = np.full(len(self.faces), -1)
        of_face[self.surface.manifold.beside[layer.shares.faces]] = region
        return decide_by_contours(self.exclusions, of_face, count, self.surface.pairs)

    @property
    def volumes(self) -> list[float]:
        """The included overlap volume, as each beam measures it."""
        if self.exact:
            return [self.overlap.volume] * len(self.sampling.directions)
        return [found.volume for found in self.beams]

    @property
    def volume(self) -> float:
        """The included overlap volume: exact, or the mean over the beams."""
        return float(np.mean(self.volumes))

    @property
    def total_volume(self) -> float:
        """The overlap volume with what is left out."""
        if self.exact:
            return self.everything.volume
        return float(np.mean([found.total_volume for found in self.beams]))

    @property
    def intersecting_pairs(self) -> int:
        """The number of face pairs that intersect and count."""
        return self.overlap.intersecting_pairs

    @property
    def total_intersecting_pairs(self) -> int:
        """The number of face pairs that intersect."""
        return self.surface.count_pairs(self.surface.listed)

    def labels(self, rule: Rule) -> Int[np.ndarray, "V"]:
        """The labels of the vertices, of the included overlaps.

        By each vertex itself, or by Algorithm 1's triangle rule over all beams.
        """
        if rule == "vertex":
            return np.sign(self.overlap.winding).astype(np.int8)
        overlaps = [found.overlaps for found in self.beams]
        vertices, faces, _ = self.closed
        label = triangle_labels(faces, overlaps, len(vertices))[: len(self.vertices)]
        if self.exact:
            add_labels_without_rays(label, self.faces, *self.overlap.areas())
            label = self.surface.of_given(label)
        return label

    def gradient(self, kind: Gradient, rule: Rule) -> Float[np.ndarray, "V 3"]:
        """The boundary integral, or the paper's Eq. 9 ("vertex") or Eq. 10 ("unit")."""
        if kind != "boundary":
            label = self.labels(rule)
            return vertex_gradient(self.vertices, self.faces, label, unit=kind == "unit")
        if self.exact:
            # What the volume is where its sums are below zero: constant.
            below = self.overlap.signed_volume < 0
            return np.zeros(self.vertices.shape) if below else self.overlap.gradient()
        vertices, faces, _ = self.closed
        total = np.zeros(vertices.shape)
        directions = np.array([found.beam.direction for found in self.beams])
        for found in self.beams:
            total += boundary_gradient(vertices, faces, found.beam, found.overlaps, directions)
        own, loops = total[: len(self.vertices)], self.manifold.loops
        for loop, force in zip(loops, total[len(own) :], strict=False):
            own[loop] += force / len(loop)
        return own


def measure(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sampling: Sampling,
    exclusions: Exclusions = NOTHING,
    rounding: float = float(np.finfo(np.float64).eps),
) -> Measurement:
    """Measure a mesh; beyond its intersections, each quantity is computed when it is first read.

    Args:
        vertices: positions, in any unit.
        faces: indices of each triangle's corners.
        sampling: exactly or by rays.
        exclusions: what is excluded.
        rounding: machine epsilon of the numbers that the vertices came in.

    Raises:
        OpenSheets: a hole that is too large to be closed.
        Unmeasurable: a coordinate that is not finite, a face out of range, coordinates whose cubes
            overflow or vanish, a mesh so far from the origin that rounding has eaten its shape, or
            so crumpled that its intersections are too many to be listed.
    """
    check_usable(vertices, faces, rounding)
    reason = open_sheets(manifold_of(faces, len(vertices)), vertices)
    if reason is not None:
        raise OpenSheets(reason)
    found = Measurement(vertices, faces, sampling, exclusions, rounding)
    if sampling.rays is None or exclusions.any:
        _ = found.surface  # rays alone need none
    return found


def check_usable(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rounding: float
) -> None:
    """Refuse what cannot be measured.

    Raises:
        Unmeasurable: as `measure`, but for a mesh so crumpled that it cannot be listed.
    """
    reason = _unusable(vertices, faces, rounding)
    if reason is not None:
        raise Unmeasurable(reason)


def _unusable(vertices, faces, rounding: float) -> str | None:
    if not np.isfinite(vertices).all():
        wrong = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
        return (
            f"vertices must be finite: got NaN or infinity in {wrong} of {len(vertices)}; "
            "remove or restore them."
        )
    if faces.size == 0:
        return None
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        return (
            f"faces must index into vertices: got index {low if low < 0 else high} for "
            f"{len(vertices)} vertices; indices are 0-based."
        )
    largest = np.abs(vertices).max()
    if not (largest == 0 or LEAST_SIZE < largest < MOST_SIZE):
        return (
            f"vertices must be of a size whose cube is a number: got coordinates up to "
            f"{largest:.3g}, where {LEAST_SIZE:.0e} to {MOST_SIZE:.0e} can be measured; take "
            "another unit."
        )
    extent = np.ptp(vertices.T.copy(), axis=1).max()
    if 0 < extent < LEAST_EXTENT * rounding * largest:
        return (
            f"vertices must not be farther from the origin than rounding allows: got a mesh of "
            f"size {extent:.3g} at coordinates of {largest:.3g}; subtract its center, or take "
            "float64."
        )
    return None
