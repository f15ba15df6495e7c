"""V_0, V_out and V_in: Algorithm 1's rule, by triangles (paper, section 3.2)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax.overlap.rays.levels import Overlaps

CLEAR, OUT, INSIDE = 0, 1, -1

# A triangle of which no larger part than this lies in an overlap touches it at most.
_SLIVER = 1e-9


class LabelCounts(NamedTuple):
    """How many vertices have each label."""

    clear: int
    out: int
    inside: int

    @property
    def ratio(self) -> float:
        """The part of the vertices in self-intersection (paper, Eq. 11)."""
        return 1.0 - self.clear / max(sum(self), 1)


def count_labels(label: Int[np.ndarray, "V"]) -> LabelCounts:
    """The vertices of V_0, V_out and V_in."""
    return LabelCounts(*(int(np.count_nonzero(label == value)) for value in (CLEAR, OUT, INSIDE)))


def triangle_labels(
    faces: Int[np.ndarray, "F 3"], overlaps: list[Overlaps], num_vertices: int
) -> Int[np.ndarray, "V"]:
    """Each vertex takes the class of the triangles around it: +1 V_out, -1 V_in, 0 V_0.

    The paper appends a triangle's corners to a set at every crossing and does not say what a
    vertex is that lands in several. Here V_out goes before V_in and both go before V_0, so the
    ratio vanishes only when no ray sees an overlap. A vertex that no ray reaches is V_0.
    """
    label = np.zeros(num_vertices, np.int8)
    for value in (INSIDE, OUT):
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
    """Add what the same rule says of some faces, as if rays went through every point.

    Args:
        label: to be added to.
        faces: of the mesh.
        found: faces that bound overlaps.
        winding: w_out at the corners of these.
        area: the integral of w_out over each, as a part of its area.
    """
    corners = faces[found]
    # A triangle cut between its corners has the class of what is cut off it.
    part = np.where(winding.any(axis=1), 0.0, area)
    inside, out = np.zeros(len(label), bool), label == OUT
    inside[corners[(winding < 0).any(axis=1) | (part < -_SLIVER)]] = True
    out[corners[(winding > 0).any(axis=1) | (part > _SLIVER)]] = True
    label[inside] = INSIDE
    label[out] = OUT
