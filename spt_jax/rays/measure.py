"""One mesh through all of its beams: volume, gradient and labels, for `host.py` and `report.py`."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.rays.beam import Beam, Rays, aim
from spt_jax.rays.boundary import boundary_gradient, vertex_gradient
from spt_jax.rays.crossings import cast
from spt_jax.rays.labels import triangle_labels
from spt_jax.rays.levels import Overlaps, find_overlaps

Directions = tuple[tuple[float, float, float], ...]
Value = Literal["volume", "ratio"]
Gradient = Literal["boundary", "vertex", "unit"]


class Sampling(NamedTuple):
    """How a mesh is sampled: the directions of the beams and the rays of each."""

    rays: Rays
    directions: Directions


@dataclass(frozen=True)
class Probe:
    """What one beam found: the overlaps on its rays and their volume."""

    beam: Beam
    overlaps: Overlaps
    crossings: int
    open_rays: int

    @property
    def volume(self) -> float:
        """E_d: the overlap lengths on the rays times the screen area of a ray."""
        return float(self.overlaps.length.sum()) * self.beam.ray_area


# map(function, directions); the caller may bring one that uses several threads.
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def probe(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sampling: Sampling,
    map_directions: Map = map,
) -> list[Probe]:
    """Cast every beam of the sampling through the mesh."""

    def along(direction: tuple[float, float, float]) -> Probe:
        beam, points = aim(vertices, np.array(direction), sampling.rays)
        crossings = cast(beam, points, faces, simple_rays=False)
        overlaps = find_overlaps(beam, points, faces, crossings)
        return Probe(beam, overlaps, crossings.met, crossings.open_rays)

    return list(map_directions(along, sampling.directions))


def volume(probes: list[Probe]) -> float:
    """The overlap volume: the mean of the beams' own."""
    return float(np.mean([found.volume for found in probes]))


def labels(
    faces: Int[np.ndarray, "F 3"], num_vertices: int, probes: list[Probe]
) -> Int[np.ndarray, "V"]:
    """V_0, V_out and V_in by Algorithm 1's triangle rule over all beams."""
    return triangle_labels(faces, [found.overlaps for found in probes], num_vertices)


def gradient(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    probes: list[Probe],
    kind: Gradient,
) -> Float[np.ndarray, "V 3"]:
    """The boundary integral, or the paper's Eq. 9 ("vertex") or Eq. 10 ("unit")."""
    if kind == "boundary":
        directions = np.stack([found.beam.direction for found in probes])
        shares = [
            boundary_gradient(vertices, faces, found.beam, found.overlaps, directions)
            for found in probes
        ]
        return np.sum(shares, axis=0)
    label = labels(faces, len(vertices), probes)
    return vertex_gradient(vertices, faces, label, unit=kind == "unit")


def usable(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether the mesh can be measured: every coordinate finite, every index in range."""
    return bool(
        np.isfinite(vertices).all()
        and (faces.size == 0 or (faces.min() >= 0 and faces.max() < len(vertices)))
    )
