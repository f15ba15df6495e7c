"""What papers report between two meshes, such as a hand and an object: exact, not by voxels."""

from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax._groups import within_groups
from spt_jax._query import as_mesh
from spt_jax._result import Result
from spt_jax.overlap.depth import distances
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.measure import Sampling, measure


class BetweenMeshes(Result):
    """How far two meshes are in each other; lengths in their unit, volumes in its cube.

    Attributes:
        volume: of their intersection. Where one of them overlaps itself, what is inside it twice
            counts twice.
        intersecting_pairs: the number of face pairs, one of each, that intersect.
        depth: of each vertex of the first mesh inside the second one, how far the surface of that
            is; 0 of the others.
        other_depth: of each vertex of the second mesh, likewise.
        contact: which vertices of the first mesh lie inside the second one, or touch it.

    Example:
        >>> import trimesh
        >>> from spt_jax.metrics import between_meshes
        >>> box, ball = trimesh.creation.box(), trimesh.creation.icosphere(radius=0.3)
        >>> found = between_meshes(ball.vertices, ball.faces, box.vertices, box.faces)
        >>> found.is_free, bool(abs(found.volume - ball.volume) < 1e-12), found.contact_ratio
        (False, True, 1.0)
    """

    volume: float
    intersecting_pairs: int
    depth: Float[np.ndarray, "V"]
    other_depth: Float[np.ndarray, "W"]
    contact: Bool[np.ndarray, "V"]

    @property
    def is_free(self) -> bool:
        """Whether no faces intersect and nothing of one is in the other."""
        return self.intersecting_pairs == 0 and not self.volume > 0

    @property
    def volume_in_cubic_centimeters(self) -> float:
        """Of meshes in metres, the volume in cm^3."""
        return 1e6 * self.volume

    @property
    def largest_depth(self) -> float:
        """The penetration depth: of the deepest vertex of either mesh."""
        return float(max(self.depth.max(initial=0.0), self.other_depth.max(initial=0.0)))

    @property
    def mean_depth(self) -> float:
        """Of the vertices of the first mesh inside the second one; 0 without any."""
        inside = self.depth > 0
        return float(self.depth[inside].mean()) if inside.any() else 0.0

    @property
    def contact_ratio(self) -> float:
        """The share of the first mesh's vertices that lie inside the second one, or touch it."""
        return float(self.contact.mean())

    def as_dict(self) -> dict[str, Any]:
        """All numbers as JSON types, without those of each vertex."""
        return {
            "is_free": self.is_free,
            "volume": self.volume,
            "volume_in_cubic_centimeters": self.volume_in_cubic_centimeters,
            "intersecting_pairs": self.intersecting_pairs,
            "largest_depth": self.largest_depth,
            "mean_depth": self.mean_depth,
            "contact_ratio": self.contact_ratio,
        }


def between_meshes(
    vertices: Float[Array, "V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    other_vertices: Float[Array, "W 3"] | np.ndarray,
    other_faces: Int[Array, "G 3"] | np.ndarray,
    *,
    contact_distance: float = 0.005,
) -> BetweenMeshes:
    """Intersection volume, penetration depth and contact of two closed meshes.

    The volume is the exact one of their solids, the integral of the product of their winding
    numbers. Papers estimate it by voxels, mostly of 5 mm or 1 cm, which depends on where the grid
    lies (`benchmarks/between_meshes.py`). Depths are measured at the
    vertices, from each one inside to the nearest place of the other surface.

    Args:
        vertices, faces: the first mesh, such as a hand; triangles counter-clockwise seen from
            outside. Holes that `self_intersection_penalty` closes, such as a wrist's, are closed.
        other_vertices, other_faces: the second one, such as an object.
        contact_distance: a vertex this near to the other surface, in the unit, touches it.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`; more than one mesh; a distance that
            is negative or not finite; meshes that cannot be measured.

    Differentiation: none; for use outside jit. `self_intersection_penalty` of both as one mesh,
    with `ignore_groups=within_groups(2)`, has the volume's gradient.
    """
    if not (isinstance(contact_distance, (int, float, np.number)) and contact_distance >= 0):
        raise ValueError(
            f"contact_distance must be finite and not negative: got {contact_distance!r}."
        )
    points, corners = _one("vertices", vertices, faces)
    others, other_corners = _one("other_vertices", other_vertices, other_faces)
    joined = np.concatenate([points, others])
    triangles = np.concatenate([corners, other_corners + len(points)])
    groups = np.repeat(np.arange(2), [len(corners), len(other_corners)]).astype(np.int64)
    exclusions = Exclusions(groups.tobytes(), within_groups(2))
    rounding = max(_rounding(vertices), _rounding(other_vertices))
    found = measure(joined, triangles, Sampling(None, ((0.0, 0.0, 1.0),)), exclusions, rounding)
    volume, pairs = float(found.volume), int(found.intersecting_pairs)
    near, depth = distances(points, others[other_corners]), np.zeros(len(points))
    other_depth = np.zeros(len(others))
    if pairs or volume > 0:
        inside = found.labels("vertex") != 0
        first, second = inside[: len(points)], inside[len(points) :]
        depth[first] = near[first]
        other_depth[second] = distances(others[second], points[corners])
    touches = (near <= contact_distance) | (depth > 0)
    return BetweenMeshes(volume, pairs, depth, other_depth, touches)


def _one(name: str, vertices: Any, faces: Any):
    checked, _ = as_mesh(vertices, faces)
    if checked.ndim != 2:
        raise ValueError(f"{name} must have shape (V, 3): got {tuple(checked.shape)}.")
    return np.asarray(vertices, np.float64), np.asarray(faces, np.int64)


def _rounding(vertices: Any) -> float:
    dtype = np.asarray(vertices).dtype
    return float(np.finfo(dtype).eps)
