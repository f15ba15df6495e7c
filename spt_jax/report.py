"""The intersection report: what the penalty sees on one mesh, for people and for files."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int, Int8

from spt_jax.arguments import as_directions, as_rays
from spt_jax.host import parallel_map
from spt_jax.mesh_check import one_mesh
from spt_jax.rays import measure
from spt_jax.rays.beam import Rays
from spt_jax.rays.labels import CLEAR, INSIDE, OUT
from spt_jax.rays.measure import Sampling


@dataclass(frozen=True, eq=False)
class IntersectionReport:
    """How much of a mesh is in self-intersection; printing it shows a table.

    Attributes:
        volume: the overlap volume, in the cube of the mesh's unit: the mean over the directions.
        solid_volume: what the surface encloses, each overlap counted as often as it is covered:
            the integral of the winding number.
        directions: of the beams, unit vectors.
        volumes: the overlap volume that each beam sees.
        labels: 0 on V_0, +1 on V_out, -1 on V_in, as `classify_vertices`.
        rays: rays along the longer side of each screen, or (rows, columns), as asked for.
        crossings: of rays with triangles, for each beam.
        open_rays: rays of each beam that met a hole and were left out.
    """

    volume: float
    solid_volume: float
    directions: tuple[tuple[float, float, float], ...]
    volumes: tuple[float, ...]
    labels: Int8[np.ndarray, "V"]
    rays: Rays
    crossings: tuple[int, ...]
    open_rays: tuple[int, ...]

    @property
    def num_out(self) -> int:
        """Vertices in V_out: within another part of the surface."""
        return int(np.count_nonzero(self.labels == OUT))

    @property
    def num_inside(self) -> int:
        """Vertices in V_in: where the surface is inside out."""
        return int(np.count_nonzero(self.labels == INSIDE))

    @property
    def num_clear(self) -> int:
        """Vertices in V_0: in no self-intersection."""
        return int(np.count_nonzero(self.labels == CLEAR))

    @property
    def ratio(self) -> float:
        """The part of the vertices in self-intersection (paper, Eq. 11)."""
        return 1.0 - self.num_clear / max(len(self.labels), 1)

    @property
    def intersects(self) -> bool:
        """Whether any ray sees an overlap."""
        return self.volume > 0

    def as_dict(self) -> dict[str, Any]:
        """Everything but the labels, as JSON types; volumes in the cube of the mesh's unit."""
        return {
            "volume": self.volume,
            "solid_volume": self.solid_volume,
            "ratio": self.ratio,
            "vertices": {"out": self.num_out, "in": self.num_inside, "clear": self.num_clear},
            "rays": list(self.rays) if isinstance(self.rays, tuple) else self.rays,
            "beams": [
                {"direction": list(d), "volume": v, "crossings": n, "open_rays": o}
                for d, v, n, o in zip(
                    self.directions, self.volumes, self.crossings, self.open_rays, strict=True
                )
            ],
        }

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=88, color_system=None, force_terminal=False)
        with console.capture() as capture:
            console.print(self)
        return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())

    def __rich__(self):
        from rich.table import Table

        solid = self.solid_volume
        share = f", {self.volume / solid:.3%} of the solid" if solid > 0 else ""
        # A mesh does not say what its unit is, so the cube is of "the unit", never of a metre.
        table = Table.grid(padding=(0, 2))
        table.add_row("overlap volume", f"{self.volume:.4g} unit³{share}")
        table.add_row("solid volume", f"{self.solid_volume:.4g} unit³")
        table.add_row("ratio (Eq. 11)", f"{self.ratio:.3%} of {len(self.labels)} vertices")
        table.add_row(
            "vertices", f"{self.num_out} V_out, {self.num_inside} V_in, {self.num_clear} V_0"
        )
        for direction, volume, crossings, lost in zip(
            self.directions, self.volumes, self.crossings, self.open_rays, strict=True
        ):
            axis = _axis_name(direction)
            note = f", [red]{lost} rays through a hole left out[/red]" if lost else ""
            table.add_row(f"along {axis}", f"{volume:.4g} unit³, {crossings:,} crossings{note}")
        return table


def intersection_report(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    *,
    rays: int | tuple[int, int] | str = 512,
    directions: Any = 3,
) -> IntersectionReport:
    """What the penalty sees on one mesh: volume, ratio, classes, and how far to trust them.

    The numbers are those of `self_intersection_penalty` and `classify_vertices`, measured in
    float64 whatever the dtype of the vertices. The spread between directions tells the error of
    the volume; rays through a hole say that the mesh is not closed (`check_mesh` says where to
    begin).

    Args:
        vertices: positions of one mesh, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        rays: rays along the longer side of the screen, or (rows, columns).
        directions: 1, 3 or the rows of a D x 3 array.

    Returns:
        The report; `print` shows it as a table, `as_dict()` is ready for JSON.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`, and ValueError for a batch or for
            vertices that are not finite.

    Differentiation: none; for use outside jit.

    Example:
        >>> import trimesh
        >>> from spt_jax.report import intersection_report
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.0, 0.0]))
        >>> report = intersection_report(pair.vertices, pair.faces, rays=256)
        >>> print(f"{report.volume:.2f} of {report.solid_volume:.2f}, {report.num_out} vertices")
        0.40 of 2.00, 14 vertices
    """
    given, triangles = one_mesh(vertices, faces)
    points, triangles = np.asarray(given, np.float64), triangles.astype(np.int64)
    if not np.isfinite(points).all():
        wrong = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        raise ValueError(
            f"vertices must be finite: got NaN or infinity in {wrong} of {len(points)}; "
            "remove or restore them."
        )
    sampling = Sampling(as_rays(rays), as_directions(directions))
    beams = measure.probe(points, triangles, sampling, parallel_map) if len(triangles) else []
    return IntersectionReport(
        volume=measure.volume(beams) if beams else 0.0,
        solid_volume=_solid_volume(points, triangles),
        directions=sampling.directions,
        volumes=tuple(float(beam.volume) for beam in beams) or (0.0,) * len(sampling.directions),
        labels=measure.labels(triangles, len(points), beams),
        rays=sampling.rays,
        crossings=tuple(b.crossings for b in beams) or (0,) * len(sampling.directions),
        open_rays=tuple(b.open_rays for b in beams) or (0,) * len(sampling.directions),
    )


def _axis_name(direction: tuple[float, float, float]) -> str:
    for k, letter in enumerate("xyz"):
        if abs(direction[k]) == 1:
            return f"{'+' if direction[k] > 0 else '-'}{letter}"
    return " ".join(f"{x:+.2f}" for x in direction)


def _solid_volume(points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    if not len(faces):
        return 0.0
    # From the middle of the mesh: far from the origin the tetrahedra would cancel to nothing.
    a, b, c = (points - points.mean(axis=0))[faces].transpose(1, 0, 2)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)
