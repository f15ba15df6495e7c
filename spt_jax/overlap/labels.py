"""Labels of vertices, and the triangle rule of the paper's Algorithm 1 (section 3.2)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.rays.levels import Overlaps

# The paper's V_0, V_out and V_in: the sign of the winding number just outside the surface.
CLEAR, PENETRATING, INVERTED = 0, 1, -1

# A triangle with at most this fraction of its area in an overlap only touches it.
_SLIVER = 1e-9


class LabelCounts(NamedTuple):
    """How many vertices have each label."""

    clear: int
    penetrating: int
    inverted: int

    @property
    def ratio(self) -> float:
        """The fraction of the vertices in self-intersection (paper, Eq. 11)."""
        return 1.0 - self.clear / max(sum(self), 1)


def count_labels(label: Int[np.ndarray, "V"]) -> LabelCounts:
    """Count the clear, penetrating and inverted vertices."""
    return LabelCounts(
        *(int(np.count_nonzero(label == value)) for value in (CLEAR, PENETRATING, INVERTED))
    )


def triangle_labels(
    faces: Int[np.ndarray, "F 3"], overlaps: list[Overlaps], num_vertices: int
) -> Int[np.ndarray, "V"]:
    """Each vertex takes the label of the triangles around it.

    The paper adds a triangle's corners to a set at every crossing and does not say how to label a
    vertex that lands in several sets. Here penetrating takes precedence over inverted, and both
    over clear, so the ratio vanishes only if no ray sees an overlap. A vertex that no ray reaches
    is clear.
    """
    label = np.zeros(num_vertices, np.int8)
    for value in (INVERTED, PENETRATING):
        for found in overlaps:
            label[faces[found.ends[np.sign(found.outer) == value]]] = value
    return label


def add_labels_without_rays(
    label: Int[np.ndarray, "V"],
    faces: Int[np.ndarray, "F 3"],
    found: Int[np.ndarray, "H"],
    winding: Int[np.ndarray, "H 3"],
    area: Float[np.ndarray, "H"],
) -> None:
    """Apply the triangle rule to some faces, as if a ray went through every point of them.

    Args:
        label: changed in place.
        faces: of the mesh.
        found: faces that bound overlap regions.
        winding: w_out at their corners.
        area: the integral of w_out over each, as a fraction of its area.
    """
    corners = faces[found]
    # A triangle that is cut between its corners takes the label of the piece that is cut off.
    part = np.where(winding.any(axis=1), 0.0, area)
    inverted, penetrating = np.zeros(len(label), bool), label == PENETRATING
    inverted[corners[(winding < 0).any(axis=1) | (part < -_SLIVER)]] = True
    penetrating[corners[(winding > 0).any(axis=1) | (part > _SLIVER)]] = True
    label[inverted] = INVERTED
    label[penetrating] = PENETRATING
