"""Pairs of triangles that share no vertex: those that may intersect, and those that may touch.

By boxes first (`pair_boxes.py`), then by the planes of either (`pair_planes.py`), to rounding, and
at last by signs that are exact.

Solids that touch have thousands of pairs whose boxes share no more than a side: all of a lattice's
that stand on each other. To decide each of them by signs that vanish costs more than all else.
But the push that decides such signs (`predicates.py`) orders the vertices along each axis, too,
those in one place by their pushes; and boxes of ranks in that order are those of the pushed
surface, which has no contact. So where most boxes only touch, they are compared by rank: solids
that touch are separated as groups, as if they were a meter apart.
"""

from functools import cached_property
from itertools import chain

import numpy as np
from jaxtyping import Bool, Int

from spt_jax.overlap.arrays.pieces import parts_of_size, pieces
from spt_jax.overlap.triangles.box_words import STEPS, Boxes, Shape, touching_share
from spt_jax.overlap.triangles.common_corners import apart, are_common
from spt_jax.overlap.triangles.contacts import Contacts, contacts_of
from spt_jax.overlap.triangles.fans import around_vertices, facing
from spt_jax.overlap.triangles.pair_boxes import (
    Pairs,
    across_groups,
    boxes_of,
    near_groups,
    near_pairs,
    ranked,
    within_clusters,
)
from spt_jax.overlap.triangles.pair_layout import Layout, Prepared
from spt_jax.overlap.triangles.pair_planes import not_apart
from spt_jax.overlap.triangles.predicates import Predicates
from spt_jax.overlap.triangles.warm_pairs import Left, keep, left_of, nearest

# Upper bound on face pairs that the plane of neither face separates. A mesh with more is noise, and
# the list would exhaust memory: a body of 24,540 triangles has 1,800, with joints turned by 2 rad
# at random 16,000, with every vertex moved by 5 mm at random 200,000, by 20 mm, a triangle's size,
# 2,300,000.
_MOST_PAIRS, _MOST_PAIRS_EACH = 2_000_000, 20
# Of so many pairs at least, this part has to touch for ranks to be worth three sorts.
_MANY, _TOUCHING = 1024, 0.1


class Entangled(ValueError):
    """A mesh is so crumpled that its triangles' pairs cannot be listed."""


class NearTriangles:
    """Pairs of triangles near each other, of one shape of a mesh.

    Args:
        mesh: what is known of the faces, and of the last shapes.
        predicates: the signs.
        reach: how near to a triangle a vertex lies on it.
        touching: only pairs with one of these faces are wanted; all if not given.
    """

    def __init__(
        self,
        mesh: Prepared,
        predicates: Predicates,
        reach: float,
        touching: Bool[np.ndarray, "F"] | None = None,
    ):
        self._mesh, self._predicates, self._reach = mesh, predicates, reach
        self._touching = touching
        self._near: list[Int[np.ndarray, "2 _"]] | None = None
        self._left = None
        if touching is None:
            points, scale = predicates.points, predicates.scale
            near = nearest(mesh, points, scale)
            self._left = left_of(mesh, near, points)
            if self._left is None:
                self._left = keep(mesh, near, points, scale, self._boxes[:3])

    @cached_property
    def layout(self) -> Layout:
        """The triangles in their slots."""
        return self._boxes[0] if self._left is None else self._left.layout

    @cached_property
    def _boxes(self) -> tuple[Layout, Shape, Boxes, Pairs]:
        """The layout, triangles and clusters in it, and the pairs of groups that meet."""
        return near_groups(self._mesh, self._predicates.points)

    def around_vertices(self):
        """Candidates (row, slot) whose triangles share the one vertex that is not on the edge."""
        topology = self._mesh.topology
        if self._left is not None:
            vertex = self._left.vertex
        else:
            vertex = np.flatnonzero(~facing(topology, *self._boxes[:2])[0])
        return around_vertices(self._predicates.points, topology, self.layout, vertex)

    def straddling(self) -> Pairs:
        """Slots of the pairs each of which has corners on both sides of the other's plane.

        Raises:
            Entangled: they are too many to be listed.
        """
        if self._left is not None:
            return self._still(self._left)
        found, self._near = self._found(self._by_place(), by_rank=False)
        if self._near is None:
            return self._found(self._by_rank(), by_rank=True)[0]
        return found

    def _still(self, left: Left) -> Pairs:
        """The same of what an earlier shape left to look at."""
        self._limit(left.pairs.shape[1])
        parts = (left.pairs[:, part] for part in pieces(left.pairs.shape[1], 1))
        found = [self._straddling(*self._parted(*part)) for part in parts]
        a, b = left.groups
        if len(a):
            layout = left.layout
            shape, clusters = boxes_of(self._predicates.points, layout)[:2]
            within = within_clusters(layout, shape, a[a == b])
            across = across_groups(layout, shape, clusters, [(a, b)])
            for t, u in parts_of_size(chain(within, across)):
                t, u, _ = not_apart(left.layout, shape, t, u, 0.0)
                found.append(self._straddling(*self._parted(t, u)))
        return found

    @cached_property
    def contacts(self) -> Contacts:
        """The corners of triangles that lie on others."""
        near, (layout, shape) = self._near, self._boxes[:2]
        if near is None:
            # They were separated by rank, or were known to be.
            near = (self._not_apart(t, u)[2] for t, u in self._by_place())
        return contacts_of(layout, shape, near, self._reach)

    def _by_place(self):
        """Pairs whose boxes meet."""
        layout, shape, clusters, groups = self._boxes
        if self._touching is not None:
            return near_pairs(layout, shape, clusters, groups, self._touching)
        across = across_groups(layout, shape, clusters, groups)
        return parts_of_size(chain(within_clusters(layout, shape), across))

    def _by_rank(self):
        """Pairs whose boxes meet once vertices are moved along their pushes."""
        layout = self._boxes[0]
        shape, clusters, groups = ranked(self._boxes[1], layout, self._predicates.ranks)
        if self._touching is not None:
            return near_pairs(layout, shape, clusters, groups, self._touching)
        across = across_groups(layout, shape, clusters, groups)
        return parts_of_size(chain(within_clusters(layout, shape), across))

    def _found(self, pairs, by_rank: bool):
        """The straddling ones, and those with a corner in the other's plane; None if given up."""
        found, near, seen = [], [], 0
        shape, few = self._boxes[1], self._predicates.points.shape[1] < STEPS
        for t, u in pairs:
            if by_rank:
                # Nobody asks which corners lie in planes, so what common corners tell comes first.
                t, u = self._parted(t, u)
            elif few and len(t) >= _MANY and touching_share(shape, t, u) > _TOUCHING:
                return found, None
            t, u, in_plane = self._not_apart(t, u)
            near.append(in_plane)
            seen += len(t)
            self._limit(seen)
            found.append(self._straddling(*((t, u) if by_rank else self._parted(t, u))))
        return found, near

    def _limit(self, seen: int) -> None:
        count = len(self.layout.slot)
        most = _MOST_PAIRS + _MOST_PAIRS_EACH * count
        if seen > most:
            raise Entangled(
                "vertices must be a surface whose triangles mostly lie apart: got more than "
                f"{most:,} pairs of {count:,} triangles that are near each other; look for "
                "coordinates that exploded or collapsed."
            )

    def _not_apart(self, t, u):
        return not_apart(*self._boxes[:2], t, u, self._reach)

    def _parted(self, t, u):
        """The pairs without those that a plane through common corners keeps apart."""
        corners = [self.layout.corners.take(x, axis=1) for x in (t, u)]
        if len(t) < _MANY or not are_common(self._predicates, *corners):
            return t, u
        kept = np.flatnonzero(~apart(self._predicates, *corners))
        return t[kept], u[kept]

    def _straddling(self, t, u):
        return straddling(self._predicates, self.layout, t, u)


def straddling(
    predicates: Predicates, layout: Layout, t: Int[np.ndarray, "N"], u: Int[np.ndarray, "N"]
) -> tuple[Int[np.ndarray, "M"], Int[np.ndarray, "M"]]:
    """Those of some pairs of slots each of which has corners on both sides of the other's plane."""
    corners, count = layout.corners, predicates.points.shape[1]
    for turn in (0, 1):
        x, y = (t, u) if turn else (u, t)
        plane, corner = corners.take(y, axis=1), corners.take(x, axis=1)
        key = y * count + corner
        side, _ = predicates.volume(plane, corner, key, if_alike=True)
        kept = np.flatnonzero(np.abs(side.sum(axis=0)) < 3)
        t, u = t[kept], u[kept]
    return t, u
