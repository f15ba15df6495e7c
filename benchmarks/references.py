"""Overlap volumes and gradients to compare rays with: very many rays, and the triangles themselves.

The exact one cuts the triangles along their intersections (libigl's interface to CGAL), so that
the class c = sign(w_out) is constant on every piece. Then the overlap's volume and the boundary
integral of c lambda are sums over the pieces without any quadrature. On a body it agrees with
central differences of its own volume to nine digits, and takes 3 s: a third of the time of
4096 x 4096 rays in three directions. Of 74 frames, those rays have the gradient within 2 % in 67;
the others overlap by less than 10 cm^3, and below 1e-10 m^3 the error exceeds 100 %.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import igl
import numpy as np
from igl.copyleft import cgal
from jaxtyping import Float, Int

from spt_jax.arguments import as_directions
from spt_jax.output_files import atomic_write
from spt_jax.overlap import measure

Rays = int | Literal["auto"]
REFERENCE_RAYS = 4096

# Where the winding number of a piece is asked for: so far in front of it, in the mesh's size.
# Small against any piece that weighs anything, large against a double's rounding.
_IN_FRONT = 1e-8

# libigl stops cutting at 1,000 intersections by default.
_NO_CUTOFF = 1_000_000


class Reference(NamedTuple):
    """An overlap's volume, and its derivative with respect to the vertices."""

    volume: float
    gradient: Float[np.ndarray, "V 3"]


Make = Callable[[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]], Reference]


def sampling(rays: Rays) -> measure.Sampling:
    """So many rays in each of three directions."""
    return measure.Sampling(rays, as_directions(3))


def by_rays(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Reference:
    """The mean of three directions at 4096 x 4096 rays, and the boundary gradient."""
    found = measure.measure(vertices, faces, sampling(REFERENCE_RAYS))
    return Reference(found.volume, found.gradient("boundary", "vertex"))


def exact(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Reference:
    """The overlap of a closed mesh by its triangles alone, exact to rounding.

    Args:
        vertices: of a closed, consistently wound mesh.
        faces: its triangles.

    Raises:
        ValueError: a piece of the surface has no whole winding number in front of it: the mesh
            is not closed.
    """
    found = cgal.remesh_self_intersections(vertices, faces, cutoff=_NO_CUTOFF)
    cut, pieces, origin = (np.asarray(found[k]) for k in (0, 1, 3))
    corner = cut[pieces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(normal, axis=1)
    flat = size == 0
    pieces, origin, corner, normal, size = (
        part[~flat] for part in (pieces, origin, corner, normal, size)
    )
    center = corner.mean(axis=1)
    in_front = center + _IN_FRONT * np.ptp(vertices, axis=0).max() * normal / size[:, None]
    winding = np.asarray(igl.winding_number(vertices, faces, in_front))
    if (np.abs(winding - np.rint(winding)) > 1e-3).any():
        raise ValueError(
            "the mesh must be closed: got winding numbers that are not whole; see check_mesh."
        )
    kind = np.rint(winding)

    # Divergence theorem with x / 3: each piece bounds the levels that differ by `kind` across it.
    volume = kind @ np.einsum("ki,ki->k", corner[:, 0] - vertices.mean(axis=0), normal) / 6
    # lambda is affine, so its integral over a piece is the value at the centre times the area.
    weight = _barycentric(vertices[faces[origin]], center)
    force = (kind[:, None] * weight)[:, :, None] * (normal / 2)[:, None, :]
    gradient = np.zeros_like(vertices)
    np.add.at(gradient, faces[origin], force)
    return Reference(float(volume), gradient)


def _barycentric(
    corners: Float[np.ndarray, "K 3 3"], points: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "K 3"]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = corners - points[:, None]
    opposite = np.cross(np.roll(away, -1, axis=1), np.roll(away, -2, axis=1))
    weights = np.einsum("kci,ki->kc", opposite, normal)
    return weights / np.einsum("ki,ki->k", normal, normal)[:, None]


class Kept:
    """References by frame name, kept in an .npz file and made when first asked for."""

    def __init__(self, file: Path, make: Make) -> None:
        self.file, self.make = file, make
        self._found: dict[str, np.ndarray] = {}
        if file.exists():
            with np.load(file, allow_pickle=False) as stored:
                self._found = {key: stored[key] for key in stored.files}

    def has(self, name: str) -> bool:
        """Whether the frame needs no computing."""
        return f"{name} volumes" in self._found

    def of(
        self, name: str, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
    ) -> Reference:
        """The frame's reference, from the file or made and added to it."""
        if not self.has(name):
            made = self.make(vertices, faces)
            self._found[f"{name} volumes"] = np.array(made.volume)
            # float32 halves a file of 30 MB and is 1e-7 off, where 2e-2 is to be told.
            self._found[f"{name} gradient"] = made.gradient.astype(np.float32)
            with atomic_write(self.file) as temporary, temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **self._found)
        # Three volumes, one a direction, in files of earlier versions.
        volume = float(np.mean(self._found[f"{name} volumes"]))
        return Reference(volume, self._found[f"{name} gradient"].astype(np.float64))
