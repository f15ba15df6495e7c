"""The intersection report: what the penalty sees on one mesh, for people and for files."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int, Int8

from spt_jax._exclusions import as_exclusions
from spt_jax._mesh_check import one_mesh
from spt_jax._query import as_choice, as_directions, as_rays
from spt_jax._result import Result
from spt_jax.overlap.caps import Hole, holes_in_words
from spt_jax.overlap.labels import count_labels
from spt_jax.overlap.measure import Rule, Sampling, measure
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface


class IntersectionReport(Result):
    """How much of a mesh is in self-intersection; printing it shows a table.

    Attributes:
        volume: the included overlap volume, in the cube of the mesh's unit: the mean over the
            directions.
        total_volume: the same including folds and ignored groups.
        solid_volume: what the surface encloses, each overlap counted as often as it is covered:
            the integral of the winding number.
        directions: of the beams, unit vectors.
        volumes: the overlap volume that each direction gives; all the same where no rays were
            needed.
        labels: +1 penetrating, -1 inverted, 0 clear, as from `classify_vertices`.
        intersecting_pairs: the number of face pairs that intersect and count; faces that only touch
            do not intersect.
        total_intersecting_pairs: the same including folds and ignored groups.
        rays: as requested: None (exact), rays along the longer side of each screen, or
            (rows, columns).
        crossings: of rays with triangles, for each beam; none where no rays were needed.
        exact: whether the volume is exact. False with `rays`, and where the exact sums were found
            not to close, which no closed mesh has been seen to do: then 512 rays are cast.
        holes: the boundary loops that were closed by fans to the mean of their vertices, the
            largest first: how many edges each has, its length, and its size, the area of a disk
            with that perimeter against that of the part around it.

    Example:
        >>> import trimesh
        >>> from spt_jax import intersection_report
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.3, 0.2]))
        >>> report = intersection_report(pair.vertices, pair.faces)
        >>> report.is_free, report.num_penetrating, report.as_dict()["num_inverted"]
        (False, 2, 0)
    """

    volume: float
    total_volume: float
    solid_volume: float
    directions: tuple[tuple[float, float, float], ...]
    volumes: tuple[float, ...]
    labels: Int8[np.ndarray, "V"]
    intersecting_pairs: int
    total_intersecting_pairs: int
    rays: Rays
    crossings: tuple[int, ...]
    exact: bool
    holes: tuple[Hole, ...] = ()

    @property
    def num_penetrating(self) -> int:
        """The number of vertices inside another part of the surface (V_out)."""
        return count_labels(self.labels).penetrating

    @property
    def num_inverted(self) -> int:
        """The number of vertices where the surface is inside out (V_in)."""
        return count_labels(self.labels).inverted

    @property
    def num_clear(self) -> int:
        """The number of vertices in no self-intersection (V_0)."""
        return count_labels(self.labels).clear

    @property
    def ratio(self) -> float:
        """The fraction of the vertices in self-intersection (paper, Eq. 11)."""
        return count_labels(self.labels).ratio

    @property
    def is_free(self) -> bool:
        """Whether no faces intersect and no parts overlap, apart from what is excluded."""
        return not (self.intersecting_pairs or self.volume > 0)

    def as_dict(self) -> dict[str, Any]:
        """Everything but the labels, as JSON types; volumes in the cube of the mesh's unit."""
        return {
            "is_free": self.is_free,
            "volume": self.volume,
            "exact": self.exact,
            "total_volume": self.total_volume,
            "intersecting_pairs": self.intersecting_pairs,
            "total_intersecting_pairs": self.total_intersecting_pairs,
            "solid_volume": self.solid_volume,
            "ratio": self.ratio,
            "num_penetrating": self.num_penetrating,
            "num_inverted": self.num_inverted,
            "num_clear": self.num_clear,
            "holes": [
                {"edges": hole.edges, "length": hole.length, "size": hole.size}
                for hole in self.holes
            ],
            "rays": list(self.rays) if isinstance(self.rays, tuple) else self.rays,
            "beams": [
                {"direction": list(d), "volume": v, "crossings": n}
                for d, v, n in zip(self.directions, self.volumes, self.crossings, strict=False)
            ],
        }

    def __rich__(self):
        from rich.table import Table

        solid = self.solid_volume
        share = f", {self.volume / solid:.3%} of the solid" if solid > 0 else ""
        # A mesh does not say what its unit is, so the cube is of "the unit", never of a metre.
        table = Table.grid(padding=(0, 2))
        table.add_row("overlap volume", f"{self.volume:.4g} unit³{share}")
        counted, pairs = self.intersecting_pairs, self.total_intersecting_pairs
        if self.total_volume != self.volume or counted != pairs:
            table.add_row("with what is excluded", f"{self.total_volume:.4g} unit³")
        table.add_row("solid volume", f"{self.solid_volume:.4g} unit³")
        if self.holes:
            table.add_row("holes closed", holes_in_words(len(self.holes), self.holes[0], "unit"))
        table.add_row("ratio (Eq. 11)", f"{self.ratio:.3%} of {len(self.labels)} vertices")
        table.add_row(
            "vertices",
            f"{self.num_penetrating} penetrating, {self.num_inverted} inverted, "
            f"{self.num_clear} clear",
        )
        ignored = f", {pairs - counted} more excluded" if pairs > counted else ""
        table.add_row("intersecting pairs", f"{counted}{ignored}")
        for direction, volume, crossings in zip(
            self.directions, self.volumes, self.crossings, strict=False
        ):
            axis = _axis_name(direction)
            table.add_row(f"along {axis}", f"{volume:.4g} unit³, {crossings:,} crossings")
        return table


def intersection_report(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    *,
    rays: Rays = None,
    directions: Any = 3,
    rule: Rule = "vertex",
    face_groups: Int[Array, "F"] | np.ndarray | None = None,
    ignore_groups: Any = (),
    rest_surface: RestSurface | None = None,
) -> IntersectionReport:
    """What the penalty sees on one mesh: volume, ratio, labels, and how far to trust them.

    The numbers are those of `self_intersection_penalty` and `classify_vertices`, measured in
    float64 whatever the dtype of the vertices. Where rays are cast, the spread between directions
    shows the error of the volume. Holes are closed and listed; `check_mesh` says more about them.

    Args:
        vertices: positions of one mesh, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        rays, directions: as in `self_intersection_penalty`.
        rule: how the vertices are labelled, as in `classify_vertices`.
        face_groups, ignore_groups, rest_surface: what is excluded, as in
            `self_intersection_penalty`.

    Returns:
        The report; `print` shows it as a table, `as_dict()` is ready for JSON.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`, and ValueError for a batch or for
            vertices that are not finite or a hole that is too large to be closed.

    Differentiation: none; for use outside jit.

    Example:
        >>> import trimesh
        >>> from spt_jax._report import intersection_report
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.5, 0.5]))
        >>> report = intersection_report(pair.vertices, pair.faces)
        >>> print(f"{report.volume:.2f} of {report.solid_volume:.2f}")
        0.10 of 2.00
        >>> report.num_penetrating
        2
    """
    given, triangles = one_mesh(vertices, faces)
    points, triangles = np.asarray(given, np.float64), triangles.astype(np.int64)
    sampling = Sampling(as_rays(rays), as_directions(directions))
    exclusions = as_exclusions(face_groups, ignore_groups, rest_surface, triangles)
    wanted = as_choice("rule", rule, Rule)
    rounding = float(np.finfo(given.dtype).eps)
    found = measure(points, triangles, sampling, exclusions, rounding)
    return IntersectionReport(
        volume=found.volume,
        total_volume=found.total_volume,
        solid_volume=_solid_volume(*found.closed[:2]),
        directions=sampling.directions,
        volumes=tuple(found.volumes),
        labels=found.labels(wanted),
        intersecting_pairs=found.intersecting_pairs,
        total_intersecting_pairs=found.total_intersecting_pairs,
        rays=sampling.rays,
        crossings=tuple(beam.crossings for beam in found.beams),
        exact=found.exact,
        holes=tuple(sorted(found.holes, key=lambda hole: -hole.size)),
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
