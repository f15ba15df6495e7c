"""Sets of triangles that are near each other at rest, so that only folds are possible there.

With R_a(s) the distance of the farthest triangle of set a from seed s, no triangle of a is farther
from one of b than R_a(s) + R_b(s), for any seed. The seed nearest to the middle of either set is a
good one: it shows four in ten of a body's sets of 64 triangles that meet in space to be near, and
more than half of the remaining sets of eight.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.rest.paths import SurfacePaths

# Sets whose distances are looked up together, 4 MB of them.
_AT_ONCE = 1 << 11
# So many sets have a table, of 1 MB.
_FEW = 1 << 10


class NearSets:
    """Sets of a rest surface's faces, as many to each.

    Attributes:
        radius: (N, S), the distance of each set's farthest face from each seed.
        midst: the seed from which that is least.
        person: the copy of the mesh that a set belongs to; -1: to several.
        least: below this, all pairs are near.
    """

    radius: Float[np.ndarray, "N S"]
    midst: Int[np.ndarray, "N"]
    person: Int[np.ndarray, "N"]
    least: Float[np.ndarray, "N"]

    def __init__(
        self,
        paths: SurfacePaths,
        faces: Int[np.ndarray, "N M"],
        filled: Bool[np.ndarray, "N M"],
        distances: Float[np.ndarray, "F"],
    ):
        table, count = paths.table, len(paths.faces)
        self._paths, self._least_of_faces = paths, distances - paths.slack
        step = max(_AT_ONCE // faces.shape[1], 1)
        found = [
            np.where(filled[part, :, None], table.rows[faces[part] % count], 0).max(axis=1)
            for start in range(0, len(faces), step)
            for part in [slice(start, start + step)]
        ]
        radius = np.concatenate(found)
        least = np.where(filled, self._least_of_faces[faces], np.inf).min(axis=1)
        person = faces // max(count, 1)
        low = np.where(filled, person, person.max(initial=0)).min(axis=1)
        high = np.where(filled, person, 0).max(axis=1)
        self._set(radius, np.where(low == high, low, -1), least)

    def _set(self, radius, person, least) -> None:
        self.radius, self.person, self.least = radius, person, least
        self.midst = radius.argmin(axis=1)
        self._flat, self._seeds = radius.reshape(-1), radius.shape[1]
        self._table: np.ndarray | None = None

    def joined(self, size: int) -> "NearSets":
        """Sets of `size` of these sets each, one after the other."""
        found = object.__new__(NearSets)
        found._paths, found._least_of_faces = self._paths, self._least_of_faces
        person = self.person.reshape(-1, size)
        alike = person.min(axis=1) == person.max(axis=1)
        found._set(
            self.radius.reshape(-1, size, self._seeds).max(axis=1),
            np.where(alike, person[:, 0], -1),
            self.least.reshape(-1, size).min(axis=1),
        )
        return found

    def tabulated(self) -> "NearSets":
        """These sets, with a table of what is near where they are few."""
        count = len(self.least)
        if count <= _FEW:
            first, second = (x.ravel() for x in np.indices((count, count)))
            self._table = self.near(first, second)
        return self

    def near(self, a: Int[np.ndarray, "P"], b: Int[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """Pairs of sets all of whose faces are certainly near each other."""
        if self._table is not None:
            return self._table.take(a * len(self.least) + b)
        at_a, at_b = a * self._seeds, b * self._seeds
        of_a, of_b = self.midst.take(a), self.midst.take(b)
        over_a = self._flat.take(at_a + of_a) + self._flat.take(at_b + of_a)
        over_b = self._flat.take(at_a + of_b) + self._flat.take(at_b + of_b)
        near = np.minimum(over_a, over_b) < np.minimum(self.least.take(a), self.least.take(b))
        own = self.person.take(a)
        return near & (own == self.person.take(b)) & (own >= 0)

    def near_faces(self, f: Int[np.ndarray, "P"], g: Int[np.ndarray, "P"]) -> Bool[np.ndarray, "P"]:
        """The same of pairs of faces, over the seeds nearest to each."""
        (person, own), (other, there) = (np.divmod(x, len(self._paths.faces)) for x in (f, g))
        upper = self._paths.bounds(own, there)[1]
        least = np.minimum(self._least_of_faces.take(f), self._least_of_faces.take(g))
        return (upper < least) & (person == other)
