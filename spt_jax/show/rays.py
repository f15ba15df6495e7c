"""What a beam of parallel rays meets, as images: one pixel a ray."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from spt_jax.io.mesh_files import as_mesh_arrays
from spt_jax.overlap.rays.beam import Beam, ScreenPoints, on_lattice
from spt_jax.overlap.rays.crossings import Crossings, cast
from spt_jax.overlap.rays.levels import find_overlaps, winding_numbers
from spt_jax.show.framing import View, frame

_MOST_RAYS = 4096


class RayImages(NamedTuple):
    """A beam's count of crossings and length of overlap, ray by ray, as seen: top row first.

    Attributes:
        crossings: of each ray with triangles.
        overlap: length of each ray within overlaps, counted once for every pair of solids that
            overlap there, in the mesh's unit.
        ray_area: area of screen that one ray stands for.
    """

    crossings: Int[np.ndarray, "rows columns"]
    overlap: Float[np.ndarray, "rows columns"]
    ray_area: float

    @property
    def volume(self) -> float:
        """The overlap volume that this beam measures."""
        return float(self.overlap.sum()) * self.ray_area


@dataclass(frozen=True)
class BeamCast:
    """One beam through a mesh: all its crossings, and each ray's overlap length."""

    beam: Beam
    points: ScreenPoints
    faces: Int[np.ndarray, "F 3"]
    crossings: Crossings
    overlap: Float[np.ndarray, "rays"]

    def depths(self, chosen: Int[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """How far along its ray each chosen crossing is, from the mesh's nearest point."""
        row, column = self.beam.locate(self.crossings.ray[chosen])
        corners = self.faces[self.crossings.face[chosen]]
        x = self.points.column[corners] - column[:, None]
        y = self.points.row[corners] - row[:, None]
        # Twice the areas opposite each corner, seen from the ray: its barycentric coordinates.
        weight = np.roll(x, -1, 1) * np.roll(y, -2, 1) - np.roll(x, -2, 1) * np.roll(y, -1, 1)
        depth = np.einsum("kc,kc->k", weight, self.points.depth[corners]) / weight.sum(axis=1)
        return depth - self.points.depth.min()


def ray_images(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    *,
    view: View = "front",
    rays: int = 256,
) -> RayImages:
    """Crossings and overlap length of every ray of one beam, as images.

    The sum of the lengths times the area of a ray is the overlap volume as this beam measures it.

    Args:
        vertices: positions, in any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        view: where the rays come from, as in `render_mesh`; "auto" is "front" here.
        rays: how many along the longer side of the mesh's outline, up to 4096.

    Returns:
        RayImages(crossings, overlap, ray_area), rows from the top.

    Raises:
        TypeError: rays is not a whole number.
        ValueError: arrays that do not make a mesh, an unknown view, rays out of 1 to 4096.

    Differentiation: none; NumPy in, NumPy out.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax.show import ray_images
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.5, 0.0, 0.0]))
        >>> images = ray_images(pair.vertices, pair.faces, view=(0.0, 0.0))
        >>> print(np.unique(images.crossings), f"{images.overlap.max():.2f}, {images.volume:.2f}")
        [0 2 4] 1.00, 0.50
    """
    found = cast_beam(vertices, faces, view, rays)
    shape = found.beam.shape
    count = np.bincount(found.crossings.ray, minlength=found.beam.num_rays)
    return RayImages(
        count.reshape(shape)[::-1], found.overlap.reshape(shape)[::-1], found.beam.ray_area
    )


def cast_beam(vertices: Any, faces: Any, view: View, rays: int) -> BeamCast:
    """A beam of square pixels that looks at the mesh as a picture's camera does.

    Raises:
        TypeError, ValueError: as `ray_images`.
    """
    if not isinstance(rays, (int, np.integer)) or isinstance(rays, bool):
        raise TypeError(f"rays must be a whole number: got {rays!r}.")
    if not 1 <= rays <= _MOST_RAYS:
        raise ValueError(f"rays must be from 1 to {_MOST_RAYS} a side: got {rays!r}.")
    points, triangles, labels = as_mesh_arrays(vertices, faces)
    axes = frame([points], triangles, [labels], view, 1.0).axes
    axes = axes * [[1.0], [1.0], [-1.0]]  # a beam's third axis is where its rays go
    extent = np.ptp(points @ axes[:2].T, axis=0).max()
    pixel = np.full(2, extent / rays if extent > 0 else 1.0)
    beam, screen = on_lattice(points, axes, pixel)
    crossings = cast(beam, screen, triangles)
    overlaps = find_overlaps(beam, screen, triangles, crossings)
    counted = np.abs(overlaps.outer) * overlaps.length
    length = np.bincount(overlaps.ray, counted, minlength=beam.num_rays)
    return BeamCast(beam, screen, triangles, crossings, length)


class RayProfile(NamedTuple):
    """One ray, crossing by crossing.

    Attributes:
        depth: of each crossing along the ray, from the mesh's nearest point.
        counter: the winding number behind each crossing.
        label: of each crossing: +1 penetrating, -1 inverted, 0 clear.
    """

    depth: Float[np.ndarray, "N"]
    counter: Int[np.ndarray, "N"]
    label: Int[np.ndarray, "N"]


def profile(found: BeamCast, ray: int) -> RayProfile:
    """The counter along one ray (paper, Algorithm 1), and the label of each of its crossings."""
    chosen = np.flatnonzero(found.crossings.ray == ray)
    counter = winding_numbers(found.crossings)[chosen]
    # The winding number outside a sheet is the smaller of those on its two sides.
    outside = np.minimum(counter, counter - found.crossings.sign[chosen])
    return RayProfile(found.depths(chosen), counter, np.sign(outside))
