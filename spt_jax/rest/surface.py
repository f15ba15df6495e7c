"""Distances along a surface at rest, which distinguish a fold from a collision."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.surface import parts_in_each_other
from spt_jax.overlap.triangles.manifold import manifold_of
from spt_jax.rest.arguments import Levels, as_distances, as_number, as_surface
from spt_jax.rest.paths import MOST_PIECES, SurfacePaths, surface_paths
from spt_jax.rest.sets import NearSets
from spt_jax.rest.thickness import local_radii


class RestSurface:
    """How far apart triangles lie along a mesh at rest, and which of them are near.

    What is near depends on where: a pair of triangles is near if its distance is less than that of
    either. Connected parts of the surface that lie in each other at rest, as eyeballs in a head,
    are recognized, too, and their overlaps are excluded.

    The distance of two triangles is the length of the shortest path along edges from a corner of
    one to a corner of the other: 0 where they share a vertex, infinite between parts that share
    none. On the embedded body it is 6 % longer than the shortest way over the surface itself
    between their corners (median from 0.2 to 0.4 m; 14 % at the 95th percentile).

    Distances are looked up in a table of shortest paths from 512 seeds, each as far as possible
    from those before, which is made when first asked for: 1.1 s and 50 MB for the embedded body.
    Equal contents share one table and compare equal, so a RestSurface built again is no new option
    to `jax.jit`.

    Attributes:
        distance: triangles nearer than this are near each other, in the vertices' unit; where it
            differs from face to face, the largest.
        num_faces: how many triangles there are, over all copies.

    Args:
        rest_vertices: positions of the mesh at rest, where it does not overlap itself.
        faces: indices of each triangle's corners.
        distance: one number, or one for each face. 0.3 m separates arms from the trunk and keeps
            armpits and elbows together; fingers want 4 to 5 cm (`body.rest_surface` has both), and
            `local_distances(vertices, faces)` finds some for any mesh.

    Raises:
        TypeError: an array has the wrong kind of dtype or is traced; distance is no number.
        ValueError: a shape that is not (V, 3) or (F, 3); a vertex that is not finite; an index out
            of range; a distance that is negative or not finite; more than 512 pieces.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax.rest.surface import RestSurface
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
    _levels: tuple[float, ...]
    _level: bytes

    def __init__(self, rest_vertices: Any, faces: Any, distance: Any = 0.3):
        vertices, corners = as_surface(rest_vertices, faces)
        reach = as_distances(distance, len(corners))
        paths = surface_paths(vertices, corners)
        if paths.pieces > MOST_PIECES:
            raise ValueError(
                f"the rest mesh must have at most {MOST_PIECES} pieces: got {paths.pieces}; merge "
                "vertices at the same place, and make scenes of many bodies with copies()."
            )
        self._set(paths, reach, copies=1)

    def _set(self, paths: SurfacePaths, reach: Levels, copies: int) -> None:
        # Set once, through object: what hashes must not change.
        values: dict[str, Any] = {"_paths": paths, "distance": max(reach[0]), "_copies": copies}
        values["_levels"], values["_level"] = reach
        values["num_faces"] = copies * len(paths.faces)
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be set: a RestSurface does not change; make another.")

    def _key(self) -> tuple[Any, ...]:
        return self._paths.content, self._levels, self._level, self._copies

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RestSurface) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        copies = f", copies={self._copies}" if self._copies > 1 else ""
        low, high = min(self._levels), max(self._levels)
        distance = f"{high:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        return f"RestSurface({self.num_faces} faces, distance={distance}{copies})"

    @property
    def distances(self) -> Float[np.ndarray, "F"]:
        """The distance of each face, over all copies."""
        return np.tile(np.array(self._levels)[self._level_of_faces], self._copies)

    @property
    def _level_of_faces(self):
        if not self._level:
            return np.zeros(len(self._paths.faces), np.uint8)
        return np.frombuffer(self._level, np.uint8)

    def within(self, distance: Any) -> "RestSurface":
        """The same surface with another `distance`, one or one a face; the table is shared.

        Example:
            >>> from spt_jax.body import load_body
            >>> load_body().rest_surface.within(0.2)
            RestSurface(24540 faces, distance=0.2)
        """
        return self._derived(as_distances(distance, len(self._paths.faces)), self._copies)

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
        return self._derived((self._levels, self._level), self._copies * int(count))

    def has_faces(self, faces: Any) -> bool:
        """Whether these are the faces of the rest mesh, or of its copies one after the other."""
        own, given = self._paths.faces, np.asarray(faces)
        if given.shape != (self.num_faces, 3):
            return False
        copies = given.reshape(self._copies, len(own), 3)
        step = len(self._paths.content.vertices)
        return all(np.array_equal(copy - k * step, own) for k, copy in enumerate(copies))

    def _derived(self, reach: Levels, copies: int) -> "RestSurface":
        other = object.__new__(RestSurface)
        other._set(self._paths, reach, copies)
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
        """Whether triangles lie nearer to each other than the smaller of their distances.

        Or in parts of the surface that lie in each other at rest.

        Args:
            f, g: the pairs, as indices of faces.
            exact: decide by the distance itself, not by `between_faces`. Bounds over the nearest
                seeds decide most pairs, bounds over all seeds most of the rest, shortest paths
                the last; their answers are kept. 3,000 pairs from 0.1 to 0.5 m apart on the
                embedded body take about 9 ms at first and 0.7 ms again, and of 180,000 none is
                wrong; by `between_faces`, 1.3 % of them would be.
        """
        near = self.overlap_at_rest(f, g)
        if len(self._levels) == 1:
            return near | self._nearer(f, g, self.distance, exact)
        level = self._level_of_faces
        of_pair = np.minimum(*(level[x % len(level)] for x in (f, g)))
        for number in np.unique(of_pair):
            at = np.flatnonzero(of_pair == number)
            near[at] |= self._nearer(f[at], g[at], self._levels[number], exact)
        return near

    def _nearer(self, f, g, distance: float, exact: bool):
        if not exact:
            return self.between_faces(f, g) < distance
        lower, upper = self._bounds(f, g)
        slack = self._paths.slack
        near = upper < distance - slack
        undecided = np.flatnonzero(~near & (lower < distance + slack))
        if len(undecided):
            f, g = (x[undecided] % len(self._paths.faces) for x in (f, g))
            near[undecided] = self._paths.near(f, g, distance)
        return near

    @property
    def parts_at_rest(self) -> tuple[Int[np.ndarray, "F"], Int[np.ndarray, "N 2"]]:
        """Of one copy, each face's connected part, and pairs of parts that lie in each other."""
        return _rest_parts(self._paths.content)

    def overlap_at_rest(
        self, f: Int[np.ndarray, "N"], g: Int[np.ndarray, "N"]
    ) -> Bool[np.ndarray, "N"]:
        """Whether the connected parts of two triangles lie in each other at rest.

        They are meant to: eyeballs in a head, teeth in a jaw. Parts of different copies do not.
        """
        part, pairs = self.parts_at_rest
        if not len(pairs):
            return np.zeros(np.broadcast_shapes(np.shape(f), np.shape(g)), bool)
        count = len(part)
        first, second = part[f % count], part[g % count]
        size = int(part.max()) + 1
        low, high = np.minimum(first, second), np.maximum(first, second)
        return (f // count == g // count) & np.isin(low * size + high, pairs @ [size, 1])

    def near_sets(
        self, faces: Int[np.ndarray, "N M"], filled: Bool[np.ndarray, "N M"]
    ) -> NearSets | None:
        """Which of some sets of faces are near each other for sure, all of the one and the other.

        Args:
            faces: of each set.
            filled: which of these entries are faces; the others are not looked at.

        Returns:
            None where even triangles that share a vertex are not near.
        """
        if min(self._levels) <= self._paths.slack or not len(self._paths.faces):
            return None
        return NearSets(self._paths, faces, filled, self.distances)

    def _bounds(self, f, g):
        if self._copies == 1:
            return self._paths.bounds(f, g)
        (person, f), (other, g) = (np.divmod(x, len(self._paths.faces)) for x in (f, g))
        lower, upper = self._paths.bounds(f, g)
        apart = person != other
        lower[apart] = upper[apart] = np.inf
        return lower, upper


def local_distances(rest_vertices: Any, faces: Any, girths: float = 0.8) -> Float[np.ndarray, "F"]:
    """The fold distance of each triangle of any mesh, from the local thickness of the solid.

    The distance is a part of the girth, 2 pi r, of the largest ball that touches the surface there
    from inside; tips and edges are as thick as what they are the tips of (a quarter of the way to
    it is taken from r). A cylinder of radius r has pi r with girths=0.5, which is enough where
    limbs are round and skin slides as it does. Linear blend skinning, and limbs that are flatter
    than round, fold farther: with 0.8, 40 mocap frames and 41 poses of hands on the embedded body
    give the verdicts that `body.rest_surface` gives, with 0.65 three of the frames that only fold
    count, with 0.5 seven.

    An open sheet has no inside: it is as thick as it is large. 24,540 triangles take 0.5 s.

    Args:
        rest_vertices: positions of the mesh at rest, where it does not overlap itself.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        girths: how much of the girth.

    Returns:
        One distance for each triangle, in the vertices' unit, for `RestSurface(rest_vertices,
        faces, distance)` or `rest_surface.within(distance)`.

    Raises:
        TypeError: an array has the wrong kind of dtype or is traced; girths is no number.
        ValueError: an array's shape or an index is wrong, a position is not finite, or girths is
            not finite or negative.

    Example:
        >>> import trimesh
        >>> from spt_jax.rest.surface import RestSurface, local_distances
        >>> torus = trimesh.creation.torus(1.0, 0.2)
        >>> distance = local_distances(torus.vertices, torus.faces, girths=0.5)
        >>> RestSurface(torus.vertices, torus.faces, distance)
        RestSurface(2048 faces, distance=0.62 to 0.628)
    """
    vertices, corners = as_surface(rest_vertices, faces)
    share = as_number("girths", girths, "0.8 suits skinned bodies")
    radius = local_radii(vertices, corners, surface_paths(vertices, corners).graph)
    return 2 * np.pi * share * radius[corners].max(axis=1, initial=0.0)


@functools.lru_cache(maxsize=4)
def _rest_parts(content):
    manifold = manifold_of(content.faces, len(content.vertices))
    of_face = np.zeros(len(content.faces), np.int64)
    of_face[manifold.beside] = manifold.part[manifold.faces[:, 0]]
    return of_face, parts_in_each_other(content.vertices, content.faces)
