"""Distances along a surface at rest: what tells a fold from a collision."""

from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from spt_jax.arguments import check_indices
from spt_jax.surface_paths import MOST_PIECES, SurfacePaths, surface_paths


class RestSurface:
    """How far apart triangles lie along a mesh at rest, and which of them are near.

    The distance of two triangles is the length of the shortest path along edges from a corner of
    one to a corner of the other: 0 where they share a vertex, infinite between parts that share
    none. On the embedded body it is 6 % longer than the shortest way over the surface itself
    between their corners (median from 0.2 to 0.4 m; 14 % at the 95th percentile).

    Distances are looked up in a table of shortest paths from 512 seeds, each as far as possible
    from those before, which is made when first asked for: 1.1 s and 50 MB for the embedded body.
    Equal contents share one table and compare equal, so a RestSurface built again is no new option
    to `jax.jit`.

    Attributes:
        distance: triangles nearer than this are near each other, in the vertices' unit.
        num_faces: how many triangles there are, over all copies.

    Args:
        rest_vertices: positions of the mesh at rest, where it does not overlap itself.
        faces: indices of each triangle's corners.
        distance: 0.3 m tells arms from the trunk and keeps armpits, elbows and fingers together.

    Raises:
        TypeError: an array has the wrong kind of dtype or is traced; distance is no number.
        ValueError: a shape that is not (V, 3) or (F, 3); a vertex that is not finite; an index out
            of range; a distance that is negative or not finite; more than 512 pieces.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax.rest_surface import RestSurface
        >>> ball = trimesh.creation.icosphere(subdivisions=3)
        >>> rest = RestSurface(ball.vertices, ball.faces, distance=1.0)
        >>> z = ball.triangles_center[:, 2]
        >>> poles = np.array([z.argmax()]), np.array([z.argmin()])
        >>> bool(2.7 < rest.between_faces(*poles)[0] < 3.14)  # half the way round
        True
        >>> rest.near(*poles, exact=True)
        array([False])
    """

    distance: float
    num_faces: int
    _paths: SurfacePaths
    _copies: int

    def __init__(self, rest_vertices: Any, faces: Any, distance: float = 0.3):
        reach = _as_distance(distance)
        paths = surface_paths(*_as_surface(rest_vertices, faces))
        if paths.pieces > MOST_PIECES:
            raise ValueError(
                f"the rest mesh must have at most {MOST_PIECES} pieces: got {paths.pieces}; merge "
                "vertices at the same place, and make scenes of many bodies with copies()."
            )
        self._set(paths, reach, copies=1)

    def _set(self, paths: SurfacePaths, distance: float, copies: int) -> None:
        # Set once, through object: what hashes must not change.
        values = {"_paths": paths, "distance": distance, "_copies": copies}
        values["num_faces"] = copies * len(paths.faces)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be set: a RestSurface does not change; make another.")

    def _key(self) -> tuple[Any, float, int]:
        return self._paths.content, self.distance, self._copies

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RestSurface) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        copies = f", copies={self._copies}" if self._copies > 1 else ""
        return f"RestSurface({self.num_faces} faces, distance={self.distance}{copies})"

    def within(self, distance: float) -> "RestSurface":
        """The same surface with another `distance`; the table is shared.

        Example:
            >>> from spt_jax.body import load_body
            >>> load_body().rest_surface.within(0.2).distance
            0.2
        """
        return self._derived(_as_distance(distance), self._copies)

    def copies(self, count: int) -> "RestSurface":
        """The rest surface of `count` such meshes whose faces follow each other, as in a scene.

        Faces of different copies are infinitely far apart; the table is shared.

        Raises:
            ValueError: `count` is not a positive whole number.

        Example:
            >>> from spt_jax.body import load_body
            >>> load_body().rest_surface.copies(3).num_faces
            73620
        """
        if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
            raise ValueError(f"count must be a positive whole number: got {count!r}.")
        return self._derived(self.distance, self._copies * int(count))

    def has_faces(self, faces: Any) -> bool:
        """Whether these are the faces of the rest mesh, or of its copies one after the other."""
        own, given = self._paths.faces, np.asarray(faces)
        if given.shape != (self.num_faces, 3):
            return False
        copies = given.reshape(self._copies, len(own), 3)
        step = len(self._paths.content.vertices)
        return all(np.array_equal(copy - k * step, own) for k, copy in enumerate(copies))

    def _derived(self, distance: float, copies: int) -> "RestSurface":
        other = object.__new__(RestSurface)
        other._set(self._paths, distance, copies)
        return other

    def between_faces(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
    ) -> Float[np.ndarray, "N"]:
        """About how far apart two triangles lie, symmetric, from two look-ups a pair.

        Paths over each one's nearest seed bound the distance from both sides; this is the middle.
        On the embedded body it is 8 mm off on average and 50 mm at most (1.5 million pairs), and
        50,000 pairs take 1.0 ms; on icospheres of 162 and 642 vertices it is a quarter of an edge
        off on average and 1.2 edges at most. Triangles that share a vertex may get more than 0.
        """
        lower, upper = self._bounds(f, g)
        lower += upper
        lower *= np.float32(0.5)
        return lower

    def near(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"], exact: bool = False
    ) -> Bool[np.ndarray, "N"]:
        """Whether triangles lie nearer than `distance` to each other.

        Args:
            f, g: the pairs, as indices of faces.
            exact: decide by the distance itself, not by `between_faces`. Bounds over the nearest
                seeds decide most pairs, bounds over all seeds most of the rest, shortest paths
                the last; their answers are kept. 3,000 pairs from 0.1 to 0.5 m apart on the
                embedded body take about 9 ms at first and 0.7 ms again, and of 180,000 none is
                wrong; by `between_faces`, 1.3 % of them would be.
        """
        if not exact:
            return self.between_faces(f, g) < self.distance
        lower, upper = self._bounds(f, g)
        slack = self._paths.slack
        near = upper < self.distance - slack
        undecided = np.flatnonzero(~near & (lower < self.distance + slack))
        if len(undecided):
            f, g = (x[undecided] % len(self._paths.faces) for x in (f, g))
            near[undecided] = self._paths.near(f, g, self.distance)
        return near

    def _bounds(self, f, g):
        if self._copies == 1:
            return self._paths.bounds(f, g)
        (person, f), (other, g) = (np.divmod(x, len(self._paths.faces)) for x in (f, g))
        lower, upper = self._paths.bounds(f, g)
        apart = person != other
        lower[apart] = upper[apart] = np.inf
        return lower, upper


def _as_surface(rest_vertices: Any, faces: Any):
    for name, given in (("rest_vertices", rest_vertices), ("faces", faces)):
        if isinstance(given, Tracer):
            raise TypeError(
                f"{name} must be known when traced: got a traced array; make the RestSurface (or "
                "take body.rest_surface) outside jit, grad and vmap, and pass it in as an option."
            )
    vertices, corners = np.asarray(rest_vertices), np.asarray(faces)
    if not np.issubdtype(vertices.dtype, np.floating):
        raise TypeError(
            f"rest_vertices must be floating-point: got {vertices.dtype}; convert them with "
            "rest_vertices.astype('float32')."
        )
    if not np.issubdtype(corners.dtype, np.integer):
        raise TypeError(f"faces must be whole numbers: got {corners.dtype}; use int32 indices.")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(
            f"rest_vertices must have shape (V, 3): got {vertices.shape}; a batch shares one rest "
            "mesh."
        )
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"faces must have shape (F, 3): got {corners.shape}; use triangles.")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise ValueError(
            f"rest_vertices must be finite: got {vertices[row].tolist()} in row {row}; drop or "
            "repair such vertices."
        )
    check_indices(corners, len(vertices))
    return vertices.astype(np.float64), corners.astype(np.int64)


def _as_distance(distance: Any) -> float:
    if isinstance(distance, bool) or not isinstance(
        distance, (int, float, np.integer, np.floating)
    ):
        raise TypeError(
            f"distance must be a number: got {distance!r}; pass a float, in the vertices' unit."
        )
    if not 0 <= distance < np.inf:
        raise ValueError(
            f"distance must be finite and not negative: got {distance!r}; 0.3 m suits a body."
        )
    return float(distance)
