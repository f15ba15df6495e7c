"""One mesh through all of its beams: volume, gradient and labels, for `host.py` and `report.py`."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.rays.beam import Beam, Rays, aim
from spt_jax.rays.boundary import boundary_gradient, vertex_gradient
from spt_jax.rays.crossings import cast
from spt_jax.rays.density import aim_at_sheets
from spt_jax.rays.exclusions import NOTHING, Exclusions, counted_intervals, counted_labels
from spt_jax.rays.labels import triangle_labels
from spt_jax.rays.levels import Overlaps, find_overlaps
from spt_jax.rays.sheets import Map, Sheets, find_sheets

Directions = tuple[tuple[float, float, float], ...]
Value = Literal["volume", "ratio"]
Gradient = Literal["boundary", "vertex", "unit"]
Rule = Literal["vertex", "triangle"]


class Sampling(NamedTuple):
    """How a mesh is sampled: the directions of the beams and the rays of each."""

    rays: Rays
    directions: Directions


@dataclass(frozen=True)
class Probe:
    """What one beam found.

    Attributes:
        beam: the rays.
        overlaps: the overlaps that count.
        everything: those and the ones that are left out.
        crossings: of rays with triangles.
        open_rays: rays that met a hole and were left out.
    """

    beam: Beam
    overlaps: Overlaps
    everything: Overlaps
    crossings: int
    open_rays: int

    @property
    def volume(self) -> float:
        """E_d: the overlap lengths on the rays times the screen area of a ray."""
        return float(self.overlaps.length.sum()) * self.beam.ray_area

    @property
    def total_volume(self) -> float:
        """The same of all overlaps, those counted that are left out."""
        return float(self.everything.length.sum()) * self.beam.ray_area


@dataclass(frozen=True)
class Measurement:
    """One mesh measured: all that its beams found, and what its triangles tell by themselves."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    sampling: Sampling
    exclusions: Exclusions
    map_tasks: Map

    @cached_property
    def sheets(self) -> Sheets:
        """The triangles that bound overlaps, found without beams."""
        directions = np.array(self.sampling.directions)
        return find_sheets(self.vertices, self.faces, directions, self.map_tasks)

    @cached_property
    def beams(self) -> list[Probe]:
        """Every beam of the sampling, cast through the mesh."""
        if self.sampling.rays == "auto":
            _ = self.sheets  # once, before the beams go to several threads
        found = list(self.map_tasks(self._along, self.sampling.directions))
        if self.exclusions.any:
            counted = counted_intervals(
                self.exclusions, self.sheets, [probe.everything for probe in found]
            )
            found = [
                Probe(p.beam, p.everything.only(kept), p.everything, p.crossings, p.open_rays)
                for p, kept in zip(found, counted, strict=True)
            ]
        return found

    def _along(self, direction: tuple[float, float, float]) -> Probe:
        rays, towards = self.sampling.rays, np.array(direction)
        if isinstance(rays, str):
            beam, points = aim_at_sheets(self.vertices, self.faces, towards, self.sheets)
        else:
            beam, points = aim(self.vertices, towards, rays)
        crossings = cast(beam, points, self.faces, simple_rays=False)
        overlaps = find_overlaps(beam, points, self.faces, crossings)
        return Probe(beam, overlaps, overlaps, crossings.met, crossings.open_rays)

    @property
    def volume(self) -> float:
        """The overlap volume that counts: the mean of the beams' own."""
        return float(np.mean([found.volume for found in self.beams]))

    @property
    def total_volume(self) -> float:
        """The overlap volume with what is left out."""
        return float(np.mean([found.total_volume for found in self.beams]))

    def labels(self, rule: Rule) -> Int[np.ndarray, "V"]:
        """V_0, V_out and V_in of the overlaps that count.

        By each vertex itself, or by Algorithm 1's triangle rule over all beams.
        """
        if rule == "vertex":
            return counted_labels(self.exclusions, self.sheets, self.faces)
        overlaps = [found.overlaps for found in self.beams]
        return triangle_labels(self.faces, overlaps, len(self.vertices))

    def gradient(self, kind: Gradient, rule: Rule) -> Float[np.ndarray, "V 3"]:
        """The boundary integral, or the paper's Eq. 9 ("vertex") or Eq. 10 ("unit")."""
        if kind == "boundary":
            directions = np.stack([found.beam.direction for found in self.beams])
            shares = [
                boundary_gradient(self.vertices, self.faces, p.beam, p.overlaps, directions)
                for p in self.beams
            ]
            return np.sum(shares, axis=0)
        label = self.labels(rule)
        return vertex_gradient(self.vertices, self.faces, label, unit=kind == "unit")


def measure(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sampling: Sampling,
    exclusions: Exclusions = NOTHING,
    map_tasks: Map = map,
) -> Measurement:
    """A mesh to be measured; the work is done when something is asked of the result."""
    return Measurement(vertices, faces, sampling, exclusions, map_tasks)


def usable(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether the mesh can be measured: every coordinate finite, every index in range."""
    return bool(
        np.isfinite(vertices).all()
        and (faces.size == 0 or (faces.min() >= 0 and faces.max() < len(vertices)))
    )


def probe(vertices, faces, sampling, map_directions=map):  # shims while others move over
    return measure(vertices, faces, sampling, map_tasks=map_directions).beams


def volume(beams):
    return float(np.mean([b.volume for b in beams]))


def labels(faces, num_vertices, beams):
    return triangle_labels(faces, [b.overlaps for b in beams], num_vertices)


def gradient(vertices, faces, beams, kind):
    if kind != "boundary":
        return vertex_gradient(
            vertices, faces, labels(faces, len(vertices), beams), unit=kind == "unit"
        )
    directions = np.stack([found.beam.direction for found in beams])
    shares = [boundary_gradient(vertices, faces, p.beam, p.overlaps, directions) for p in beams]
    return np.sum(shares, axis=0)
