"""V_0, V_out and V_in: Algorithm 1's rule, by triangles (paper, section 3.2)."""

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.rays.closed_form import ClosedForm
from spt_jax.rays.levels import Overlaps
from spt_jax.rays.sheets import Sheets

CLEAR, OUT, INSIDE = 0, 1, -1


def triangle_labels(
    faces: Int[np.ndarray, "F 3"], overlaps: list[Overlaps], num_vertices: int
) -> Int[np.ndarray, "V"]:
    """Each vertex takes the class of the triangles around it: +1 V_out, -1 V_in, 0 V_0.

    The paper appends a triangle's corners to a set at every crossing and does not say what a
    vertex is that lands in several. Here V_out goes before V_in and both go before V_0, so the
    penalty vanishes only when no ray sees an overlap. A vertex that no ray reaches is V_0.
    """
    label = np.zeros(num_vertices, np.int8)
    for value in (INSIDE, OUT):
        for found in overlaps:
            label[faces[found.ends[found.class_sign == value]]] = value
    return label


def triangle_labels_without_rays(
    faces: Int[np.ndarray, "F 3"],
    sheets: Sheets,
    closed: ClosedForm,
    counted: Bool[np.ndarray, "R"],
) -> Int[np.ndarray, "V"]:
    """The same rule, as if a ray went through every point of every triangle."""
    kept = counted[sheets.region[sheets.faces]]
    corners = faces[sheets.faces[kept]]
    winding = sheets.winding[corners]
    # A triangle cut between its corners has the class of what is cut off it.
    part = closed.share[kept].sum(axis=1)
    touched = ~winding.any(axis=1)
    label = np.zeros(len(sheets.winding), np.int8)
    label[corners[(winding < 0).any(axis=1) | (touched & (part < 0))]] = INSIDE
    label[corners[(winding > 0).any(axis=1) | (touched & (part >= 0))]] = OUT
    return label
