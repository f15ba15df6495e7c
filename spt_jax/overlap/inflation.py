"""The surface moved outwards, as `spt_jax._geometry.inflate` does, and forces on it pulled back.

In NumPy, for the host: all triangles' normals and angles are taken once, and of the derivative only
what belongs to vertices with a force on them, which is a few hundredths of a body.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.arrays.vectors import dot
from spt_jax.overlap.triangles.faces_cache import FacesCache

# A vertex moves at most this many distances. A box's corner needs 1.73, a cone of 39 degrees at its
# tip needs 3; the needles beyond would shoot far out of the mesh and into its other parts.
FARTHEST = 3.0

# How sharply the triangle that requires the largest move of a vertex is preferred to the others.
# The largest of several numbers has no derivative where they are equal, as at every vertex of a
# flat or box-shaped side; the logarithm of a mean of exponentials has. It falls short of the
# largest by log(1 / share) / 8192 at most: 0.04 % where that triangle has a twentieth of the angle.
SHARPNESS = 8192.0

# exp of less is nothing beside 1.
_NOTHING = -40.0


@dataclass(frozen=True)
class _Fans:
    """The corners of a list of faces, corner times face count plus face, vertex by vertex.

    Attributes:
        vertex: of each corner.
        used: the vertices that have any.
        order: their corners, one vertex's after the other's.
        begin: where each of these vertices' corners begin.
    """

    vertex: Int[np.ndarray, "F3"]
    used: Int[np.ndarray, "U"]
    order: Int[np.ndarray, "F3"]
    begin: Int[np.ndarray, "U"]


def _fans(faces: Int[np.ndarray, "F 3"], count: int) -> _Fans:
    vertex = faces.T.ravel()
    lengths = np.bincount(vertex, minlength=count)
    used = np.flatnonzero(lengths)
    begin = np.cumsum(lengths[used]) - lengths[used]
    return _Fans(vertex, used, np.argsort(vertex, kind="stable"), begin)


_known = FacesCache(_fans)


class Inflated:
    """A surface moved outwards by a distance.

    Attributes:
        vertices: the moved ones.

    Args:
        vertices: positions, finite.
        faces: indices of each triangle's corners, at least one.
        distance: how far; negative deflates.
        rounding: machine epsilon of the numbers that the vertices came in.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        distance: float,
        rounding: float,
    ):
        # Component by component, (3, ...): sums along a short last axis take ten times as long.
        self._faces, self._distance, self._least = faces, distance, 16 * rounding
        self._fans = _known.of(faces, len(vertices))
        self._triangles(np.ascontiguousarray(vertices.T))
        count, at = len(vertices), self._fans.vertex
        total = np.stack([np.bincount(at, (self._angle * n).ravel(), count) for n in self._normal])
        self._direction, self._length = _unit(total, self._least)
        cosine = np.zeros_like(self._angle)
        for x, n in zip(self._direction, self._normal, strict=True):
            cosine += x.take(at).reshape(3, -1) * n
        self._cosine = np.where(self._angle > 0, cosine, 1.0)
        self._smooth_largest(1 / np.maximum(self._cosine, 1 / FARTHEST), count)
        self.vertices = vertices + (distance * self._mitre * self._direction).T

    def _triangles(self, points) -> None:
        """Unit normals (3, F), by component, and angles (3, F), by corner; zero without an area."""
        corners = points.take(self._fans.vertex, axis=1).reshape(3, 3, -1)
        along = np.empty_like(corners)
        for k in range(3):
            np.subtract(corners[:, (k + 1) % 3], corners[:, k], out=along[:, k])
        scale = max(along.max(initial=0.0), -along.min(initial=0.0))
        self._scale = scale if np.finfo(np.float64).tiny < scale < np.inf else np.inf
        along *= 1 / self._scale
        self._along = along
        self._normal, self._area = _unit(cross(along[:, 0], along[:, 1]), self._least)
        self._facing = np.stack([-(along[:, k] * along[:, k - 1]).sum(axis=0) for k in range(3)])
        self._angle = np.arctan2(self._area, self._facing)
        self._angle[:, self._area == 0] = 0.0

    def _smooth_largest(self, needed, count: int) -> None:
        """How many distances each vertex moves: a smooth maximum over its corners."""
        fans, weight = self._fans, self._angle.ravel()
        needed = needed.ravel()
        largest = np.ones(count)
        largest[fans.used] = np.maximum.reduceat(needed.take(fans.order), fans.begin)
        below = SHARPNESS * (needed - largest.take(fans.vertex))
        near = np.flatnonzero(below > _NOTHING)
        above = np.exp(below.take(near))
        total = np.bincount(fans.vertex, weight, count)
        mean = np.bincount(fans.vertex.take(near), above * weight.take(near), count)
        self._solid = (mean > 0) & (total > 0)
        self._mean, self._total = (np.where(self._solid, x, 1.0) for x in (mean, total))
        smooth = largest + np.log(self._mean / self._total) / SHARPNESS
        self._mitre = np.where(self._solid, smooth, 1.0)
        self._above = np.zeros(len(below))
        self._above[near] = above
        self._above = self._above.reshape(3, -1)

    def pulled_back(self, forces: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """What forces on the moved vertices are on those given: the transposed derivative."""
        x, y, z = (forces != 0).T
        moved = x | y | z
        if not moved.any():
            return forces
        a, b, c = (moved.take(corner) for corner in self._faces.T)
        touched = np.flatnonzero(a | b | c)
        corners = self._faces[touched].T
        hit, count = moved[corners], len(forces)
        normal, angle = self._normal[:, touched], self._angle[:, touched]
        cosine, above = self._cosine[:, touched], self._above[:, touched]
        # To each vertex's mitre and direction, and from there to its corners.
        of_mitre = self._distance * dot(forces, self._direction.T) * self._solid
        of_direction = self._distance * self._mitre * forces.T
        share = above * angle / self._mean[corners]
        slope = (cosine > 1 / FARTHEST) & (angle > 0) & hit
        of_cosine = np.where(slope, -of_mitre[corners] * share / cosine**2, 0.0)
        of_angle = above / self._mean[corners] - 1 / self._total[corners]
        of_angle *= of_mitre[corners] * hit / SHARPNESS
        at = corners.ravel()
        of_direction += np.stack([np.bincount(at, (of_cosine * n).ravel(), count) for n in normal])
        of_normal = (of_cosine * self._direction[:, corners]).sum(axis=1)
        # The direction is the normalized sum of angle times normal.
        across = of_direction - self._direction * (self._direction * of_direction).sum(axis=0)
        of_sum = across / np.where(self._length > 0, self._length, np.inf)
        of_sum = of_sum[:, corners] * hit
        of_angle += (of_sum * normal[:, None]).sum(axis=0)
        of_normal += (angle * of_sum).sum(axis=1)
        of_corner = self._through_triangles(touched, of_normal, of_angle)
        back = np.stack([np.bincount(at, part.ravel(), count) for part in of_corner])
        return forces + back.T

    def _through_triangles(self, touched, of_normal, of_angle):
        """From some triangles' normals and angles to their corners, (3, 3, T)."""
        normal, along = self._normal[:, touched], self._along[:, :, touched]
        area, facing = self._area[touched], self._facing[:, touched]
        solid = area > 0
        safe = np.where(solid, area, 1.0)
        square = safe**2 + facing**2
        of_angle = np.where(solid, of_angle, 0.0)
        of_area = (of_angle * facing / square).sum(axis=0)
        of_facing = -of_angle * safe / square
        across = of_normal - normal * (normal * of_normal).sum(axis=0)
        of_cross = np.where(solid, across / safe + of_area * normal, 0.0)
        of_along = -of_facing * along[:, [2, 0, 1]] - (of_facing * along)[:, [1, 2, 0]]
        of_along[:, 0] += cross(along[:, 1], of_cross)
        of_along[:, 1] += cross(of_cross, along[:, 0])
        of_along *= 1 / self._scale
        return of_along[:, [2, 0, 1]] - of_along


def _unit(vectors, least: float):
    """Directions and lengths of the columns, of about unit size; zero where rounding decides."""
    x, y, z = vectors
    length = np.sqrt(x * x + y * y + z * z)
    length[length <= least] = 0.0
    return vectors * (1 / np.where(length > 0, length, np.inf)), length
