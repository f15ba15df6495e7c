"""Vertices that lie on triangles which are not theirs."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.arrays.ranges import unique
from spt_jax.overlap.triangles.box_words import Shape
from spt_jax.overlap.triangles.pair_layout import Layout
from spt_jax.overlap.triangles.pair_planes import dot, heights


@dataclass(frozen=True)
class Contacts:
    """Vertices that lie on triangles which are not theirs, but for rounding.

    Attributes:
        vertex, face: the two.
    """

    vertex: Int[np.ndarray, "T"]
    face: Int[np.ndarray, "T"]

    def only(self, kept: Bool[np.ndarray, "T"]) -> "Contacts":
        """Some of the contacts."""
        return replace(self, **{name: value[kept] for name, value in vars(self).items()})


def contacts_of(
    layout: Layout, shape: Shape, near: Iterable[Int[np.ndarray, "2 _"]], reach: float
) -> Contacts:
    """The corners of triangles that lie on others.

    Args:
        layout, shape: the triangles.
        near: slots, of triangles with a corner in the plane of another, and of these others; in
            parts, each of which is looked at before the next is asked for.
        reach: how near to a triangle a vertex lies on it.
    """
    # As single numbers they sort ten times as fast as by rows.
    count = max(len(layout.slot), 1)
    found = [np.zeros(0, np.int64), *(_on(layout, shape, x, y, reach) for x, y in near)]
    return Contacts(*np.divmod(unique(np.concatenate(found)), count))


def _on(layout: Layout, shape: Shape, x, y, reach: float):
    """Corners of the triangles x that lie on the triangles y: vertex times face count plus face."""
    points, normal = shape.corner.take(x, axis=2), shape.normal.take(y, axis=1)
    length, sense = shape.length.take(y), layout.sense.take(y)
    on = np.abs(heights(shape, points, shape.extent.take(x), y)[0]) <= reach * length
    on &= length > 0
    a, b, c = shape.corner.take(y, axis=2).transpose(1, 0, 2)
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        inward = dot(cross(normal, side)[:, None] * sense, points - start[:, None])
        on &= inward >= -reach * length * np.sqrt(dot(side, side))
    corner, pair = np.nonzero(on)
    return layout.corners[corner, x[pair]] * len(layout.slot) + layout.face[y[pair]]
