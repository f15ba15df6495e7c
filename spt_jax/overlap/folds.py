"""Shapes all of whose intersections are folds, recognized without their contours.

Most frames of a motion crease elbows and armpits and do nothing else. With folds excluded, the
whole overlap of such a shape is excluded, and finding that out takes far less time than measuring
it: triangles that are near each other at rest need not be examined, and nearly all triangles whose
boxes meet are near. Of a posed body's 54,000 pairs of triangles a few hundred remain, and none of
them intersects.

The result is the same as that of a measurement. Every region of overlap within a connected part is
bounded by a contour, unless the winding number is nonzero all over the part; and a region is
excluded if all of its contours are (`exact.py`). So the included volume is zero if every pair of
triangles that intersects is excluded and the winding number at every part's root is zero.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.exclusions import Exclusions, pair_weights, part_rules
from spt_jax.overlap.triangles.manifold import Manifold, manifold_of
from spt_jax.overlap.triangles.near_triangles import straddling
from spt_jax.overlap.triangles.pair_boxes import (
    across_groups,
    near_boxes,
    parts_of_size,
    within_clusters,
)
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout, Prepared, Topology, prepared
from spt_jax.overlap.triangles.pairs import decided
from spt_jax.overlap.triangles.predicates import Predicates
from spt_jax.overlap.triangles.winding import roots_of

# After this many shapes in a row that collide, the next one is measured without this check: it is
# probably another step of the same descent.
_COLLIDING = 2


@dataclass(frozen=True)
class AtRest:
    """What the rest surface says about a layout.

    Attributes:
        layout: of the triangles.
        rest: the surface at rest.
        asked: whether it has been computed; it is computed when it is asked for a second time.
        clusters, groups: which of these are near each other; None if the rest surface has other
            faces.
    """

    layout: Layout
    rest: Any
    asked: bool = False
    clusters: Any = None
    groups: Any = None


def expect_folds(faces: Int[np.ndarray, "F 3"], count: int, calm: bool) -> None:
    """Record whether the last shape of these faces had no included overlap, as the next may not."""
    manifold = manifold_of(faces, count)
    mesh = prepared(manifold.faces, len(manifold.part))
    mesh.collided = 0 if calm else mesh.collided + 1


def only_folds(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    exclusions: Exclusions,
    surely: bool = False,
) -> bool:
    """Whether all of a surface's overlap is excluded, as far as pairs of triangles show.

    Args:
        vertices, faces: a mesh that can be measured.
        exclusions: what is excluded.
        surely: check even if that takes longer than measuring, or is not expected to succeed.

    Returns:
        Never true if the included volume is above zero. It may be false if that volume is zero:
        where parts touch, and where holes were closed.
    """
    if exclusions.rest is None:
        return False
    manifold = manifold_of(faces, len(vertices))
    mesh = prepared(manifold.faces, len(manifold.part))
    if manifold.num_fans or (mesh.collided >= _COLLIDING and not surely):
        return False
    predicates = Predicates(manifold.place(vertices), manifold.faces, manifold.part)
    layout, slots, clusters, pairs = near_boxes(mesh, predicates.points)
    known = _at_rest(mesh, layout, manifold, exclusions.rest, surely)
    if known is None:
        return False
    rules = part_rules(exclusions, manifold)
    far = [(a[kept], b[kept]) for a, b in pairs for kept in [~known.groups.near(a, b)]]

    def wanted(c, d):
        return ~known.clusters.near(c, d)

    own = [a[a == b] for a, b in far]
    found = [within_clusters(layout, slots, a) for a in own if len(a)]
    found.append(across_groups(layout, slots, clusters, far, wanted))
    for t, u in parts_of_size(pair for some in found for pair in some):
        t, u = straddling(predicates, layout, t, u)
        f, g = (manifold.beside[layout.face[x]] for x in (t, u))
        # Few of those that remain intersect; only they are decided exactly.
        left = np.flatnonzero(~known.clusters.near_faces(f, g))
        f, g = _intersecting(predicates, mesh.topology, layout, t[left], u[left])
        if _included(exclusions, manifold, rules, f, g).any():
            return False
    once = np.ones(manifold.num_parts, np.int64)
    return not roots_of(mesh.topology, manifold, predicates, rules, once)[1].any()


def _at_rest(mesh: Prepared, layout: Layout, manifold: Manifold, rest, surely: bool):
    """What is known of the layout; None if nothing is, and the first time that it is asked for."""
    known = mesh.at_rest
    if known is None or known.layout is not layout or known.rest != rest:
        known = mesh.at_rest = AtRest(layout, rest)
        if not surely:
            return None  # computing it takes longer than measuring one mesh
    if not known.asked:
        filled = np.ones(len(layout.face), bool)
        filled[layout.empty] = False
        sets = None
        if rest.has_faces(manifold.given):
            by_cluster = manifold.beside[layout.face].reshape(-1, CLUSTER)
            sets = rest.near_sets(by_cluster, filled.reshape(-1, CLUSTER))
        groups = None if sets is None else sets.joined(CLUSTER).tabulated()
        known = mesh.at_rest = AtRest(layout, rest, True, sets, groups)
    return known if known.clusters is not None else None


def _included(
    exclusions: Exclusions, manifold: Manifold, rules, f: Int[np.ndarray, "N"], g
) -> Bool[np.ndarray, "N"]:
    """Which pairs of faces that intersect are included, wholly or by their contour."""
    first, second = (manifold.part[manifold.faces[x, 0]] for x in (f, g))
    whole, judged = rules(first, second).T
    at = np.flatnonzero(judged)
    included = whole.copy()
    beside = manifold.beside
    included[at] |= pair_weights(exclusions, beside[f[at]], beside[g[at]]) > 0
    return included


def _intersecting(predicates: Predicates, topology: Topology, layout: Layout, t, u):
    """Faces that intersect, of pairs of slots that share no vertex."""
    # Every edge of either against the other, whichever triangle it belongs to first.
    row = topology.row.reshape(-1, 3).take(layout.face[np.concatenate([t, u])], axis=0).ravel()
    slot = np.repeat(np.concatenate([u, t]), 3)
    row, slot, *_ = decided(predicates, topology, layout, row, slot)
    first, second = topology.edge_faces[row].T
    both = np.flatnonzero(second >= 0)
    face = layout.face[slot]
    return np.concatenate([first, second[both]]), np.concatenate([face, face[both]])
