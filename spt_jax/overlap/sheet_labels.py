"""Labels of a mesh some of whose parts are open sheets, which have no inside of their own.

What such a mesh overlaps cannot be measured as a whole, but the place of each vertex is known:
those of its solids by what the solids do to each other, as without the sheets, and those of the
sheets by whether they lie in a solid.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from spt_jax.overlap.caps import holes_of
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.labels import PENETRATING
from spt_jax.overlap.measure import Rule, Sampling, check_usable, measure
from spt_jax.overlap.sheets import SheetInSolids
from spt_jax.overlap.triangles.manifold import manifold_of


@dataclass(frozen=True, eq=False)
class RestOfSome:
    """Distances along a rest surface between some of its faces, by their number among these.

    Attributes:
        whole: the rest surface.
        faces: which faces.
    """

    whole: Any
    faces: Int[np.ndarray, "K"]

    @property
    def distance(self) -> float:
        """As the whole's."""
        return self.whole.distance

    def between_faces(self, f, g) -> Float[np.ndarray, "N"]:
        """Distance along the rest surface between triangles."""
        return self.whole.between_faces(self.faces[f], self.faces[g])

    def near(self, f, g, exact: bool = False) -> Bool[np.ndarray, "N"]:
        """Whether they are folds of each other."""
        return self.whole.near(self.faces[f], self.faces[g], exact)

    def overlap_at_rest(self, f, g) -> Bool[np.ndarray, "N"]:
        """Whether the connected parts of two triangles lie in each other at rest."""
        return self.whole.overlap_at_rest(self.faces[f], self.faces[g])


def labels_beside_sheets(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    rule: Rule,
    sampling: Sampling,
    exclusions: Exclusions,
    rounding: float,
) -> Int8[np.ndarray, "V"]:
    """The labels of a mesh with open sheets; those of the sheets are penetrating or clear.

    What is excluded is so among the solids; the labels of sheets depend only on where they lie.

    Raises:
        Unmeasurable: its solids cannot be measured, or have sheets' vertices that are not finite.
    """
    check_usable(vertices, faces, rounding)
    sheet = _faces_of_sheets(vertices, faces)
    solid = np.flatnonzero(~sheet)
    label = np.zeros(len(vertices), np.int8)
    if not len(solid):
        return label
    of_solids, own = np.unique(faces[solid], return_inverse=True)
    of_sheets, other = np.unique(faces[sheet], return_inverse=True)
    own, other = own.reshape(-1, 3), other.reshape(-1, 3)
    points = np.concatenate([vertices[of_solids], vertices[of_sheets]])
    both = np.concatenate([own, other + len(of_solids)])
    found = SheetInSolids(points.astype(np.float64), both, len(own), rounding)
    label[of_sheets[found.winding[len(of_solids) :] != 0]] = PENETRATING
    alone = measure(vertices[of_solids], own, sampling, _among(exclusions, solid), rounding)
    label[of_solids] = alone.labels(rule)
    return label


def _faces_of_sheets(vertices, faces) -> Bool[np.ndarray, "F"]:
    manifold = manifold_of(faces, len(vertices))
    open_parts = [hole.part for hole in holes_of(manifold, vertices) if not hole.is_closed]
    part = manifold.part[manifold.faces[:, 0]]
    found = np.zeros(len(faces), bool)
    found[manifold.beside[np.isin(part, open_parts)]] = True
    return found


def _among(exclusions: Exclusions, faces: Int[np.ndarray, "K"]) -> Exclusions:
    groups, rest = exclusions.groups, exclusions.rest
    if groups is not None:
        groups = np.frombuffer(groups, np.int64)[faces].tobytes()
    return exclusions._replace(
        groups=groups, rest=None if rest is None else RestOfSome(rest, faces)
    )
