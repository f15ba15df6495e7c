"""One mesh through all of its beams: volume, gradient and labels, for `host.py` and `report.py`."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.boundary import boundary_gradient, vertex_gradient
from spt_jax.overlap.exclusions import (
    NOTHING,
    Exclusions,
    Rims,
    counted_intervals,
    counted_labels,
    judge_rims,
)
from spt_jax.overlap.labels import add_labels_without_rays, triangle_labels
from spt_jax.overlap.rays.beam import Beam, Rays, ScreenPoints, aim
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.density import aim_at_sheets
from spt_jax.overlap.rays.levels import Overlaps, find_overlaps
from spt_jax.overlap.triangles import closed_form
from spt_jax.overlap.triangles.closed_form import ClosedForm
from spt_jax.overlap.triangles.sheets import Sheets, find_sheets

Directions = tuple[tuple[float, float, float], ...]
Value = Literal["volume", "ratio"]
Gradient = Literal["boundary", "vertex", "unit"]
Rule = Literal["vertex", "triangle"]


# Of a mesh, in units in the last place of its largest coordinate. In float32 a body that stands 14
# km from the origin is this small: its triangles are as large as the rounding.
LEAST_EXTENT = 1024


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

    @cached_property
    def sheets(self) -> Sheets:
        """The triangles that bound overlaps, found without beams."""
        directions = np.array(self.sampling.directions)
        return find_sheets(self.vertices, self.faces, directions)

    @cached_property
    def closed_form(self) -> ClosedForm | None:
        """What is known of the overlaps without rays; None where rays were asked for."""
        if self.sampling.rays != "auto":
            return None
        return closed_form.solve(self.vertices, self.faces, self.sheets)

    @cached_property
    def _rims(self) -> Rims:
        return judge_rims(self.exclusions, self.sheets)

    @cached_property
    def _counted(self) -> Bool[np.ndarray, "R"]:
        if not self.exclusions.any:
            return np.ones(self.sheets.num_regions, bool)
        counted, rimless = self._rims.may_count, self._rims.rimless
        if rimless.any():
            # Only rays tell what they lie in.
            seen = np.zeros(self.sheets.num_regions + 1, bool)
            for found in self.beams:
                seen[self.sheets.region[found.overlaps.ends]] = True
            counted = counted & (~rimless | seen[:-1])
        return counted

    @cached_property
    def _exactly(self) -> Bool[np.ndarray, "R"]:
        if self.closed_form is None:
            return np.zeros(self.sheets.num_regions, bool)
        if not self.exclusions.any:
            return self.closed_form.solved
        # A region that counts in part needs rays: they tell which part.
        exactly = self.closed_form.solved & ~self._rims.undecided
        return closed_form.without_entangled(
            self.vertices, self.faces, self.sheets, self.closed_form, exactly
        )

    @cached_property
    def beams(self) -> list[Probe]:
        """Every beam of the sampling, cast through the mesh; none where none is needed."""
        if self.sampling.rays == "auto" and self._exactly.all():
            return []
        found = [self._along(direction) for direction in self.sampling.directions]
        if self.exclusions.any:
            counted = counted_intervals(
                self.exclusions, self.sheets, self._rims, [probe.everything for probe in found]
            )
            found = [
                replace(probe, overlaps=probe.everything.only(kept))
                for probe, kept in zip(found, counted, strict=True)
            ]
        return found

    def _along(self, direction: tuple[float, float, float]) -> Probe:
        rays, towards = self.sampling.rays, np.array(direction)
        if rays != "auto":
            return self._cast(*aim(self.vertices, towards, rays))
        sheets, by_rays = self.sheets, ~self._exactly
        bounding = sheets.faces[by_rays[sheets.region[sheets.faces]]]
        probe = self._cast(*aim_at_sheets(self.vertices, self.faces, towards, sheets, bounding))
        # Other regions lie behind the same tiles; what is in none was not told from the triangles.
        region = sheets.region[probe.everything.ends]
        own = np.append(by_rays, False)[region]
        mine = own[:, 0] | own[:, 1] | (region < 0).all(axis=1)
        kept = probe.everything.only(mine)
        return replace(probe, overlaps=kept, everything=kept)

    def _cast(self, beam: Beam, points: ScreenPoints) -> Probe:
        crossings = cast(beam, points, self.faces, simple_rays=False)
        overlaps = find_overlaps(beam, points, self.faces, crossings)
        return Probe(beam, overlaps, overlaps, crossings.met, crossings.open_rays)

    @property
    def volumes(self) -> list[float]:
        """The overlap volume that counts, as each beam sees it."""
        exact = 0.0
        if self.closed_form is not None:
            exact = float(self.closed_form.volume[self._exactly & self._counted].sum())
        beams = self.beams
        if not beams:
            return [exact] * len(self.sampling.directions)
        return [exact + found.volume for found in beams]

    @property
    def volume(self) -> float:
        """The overlap volume that counts: the mean of the beams' own."""
        return float(np.mean(self.volumes))

    @property
    def total_volume(self) -> float:
        """The overlap volume with what is left out."""
        exact = 0.0
        if self.closed_form is not None:
            exact = float(self.closed_form.volume[self._exactly].sum())
        return exact + float(np.mean([found.total_volume for found in self.beams] or [0.0]))

    @property
    def crossing_pairs(self) -> int:
        """Pairs of triangles that pass through each other and count."""
        return int(np.count_nonzero(self._rims.collides))

    def labels(self, rule: Rule) -> Int[np.ndarray, "V"]:
        """V_0, V_out and V_in of the overlaps that count.

        By each vertex itself, or by Algorithm 1's triangle rule over all beams.
        """
        if rule == "vertex":
            return counted_labels(self.sheets, self.faces, self._counted)
        overlaps = [found.overlaps for found in self.beams]
        label = triangle_labels(self.faces, overlaps, len(self.vertices))
        if self.closed_form is not None:
            exactly = self._exactly & self._counted
            add_labels_without_rays(label, self.faces, self.sheets, self.closed_form, exactly)
        return label

    def gradient(self, kind: Gradient, rule: Rule) -> Float[np.ndarray, "V 3"]:
        """The boundary integral, or the paper's Eq. 9 ("vertex") or Eq. 10 ("unit")."""
        if kind != "boundary":
            label = self.labels(rule)
            return vertex_gradient(self.vertices, self.faces, label, unit=kind == "unit")
        total = np.zeros(self.vertices.shape)
        if self.closed_form is not None:
            exactly = self._exactly & self._counted
            total += closed_form.gradient(
                self.vertices, self.faces, self.sheets, self.closed_form, exactly
            )
        directions = np.array([found.beam.direction for found in self.beams])
        for found in self.beams:
            total += boundary_gradient(
                self.vertices, self.faces, found.beam, found.overlaps, directions
            )
        return total


def measure(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sampling: Sampling,
    exclusions: Exclusions = NOTHING,
) -> Measurement:
    """A mesh to be measured; the work is done when something is asked of the result."""
    return Measurement(vertices, faces, sampling, exclusions)


def usable(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rounding: float
) -> bool:
    """Whether the mesh can be measured.

    Every coordinate finite, every index in range, and not so far from the origin that rounding has
    eaten the shape.

    Args:
        vertices: positions.
        faces: indices.
        rounding: machine epsilon of the numbers that the vertices came in.
    """
    if not np.isfinite(vertices).all():
        return False
    if faces.size == 0:
        return True
    extent = np.ptp(vertices.T.copy(), axis=1).max()
    far = 0 < extent < LEAST_EXTENT * rounding * np.abs(vertices).max()
    return bool(not far and faces.min() >= 0 and faces.max() < len(vertices))
