"""Shapes all of whose intersections are folds, told without their contours.

Most frames of a motion crease elbows and armpits and no more. With folds left out nothing of such a
shape counts, and to learn so takes far less than to measure it: triangles that are near each other
at rest need not be looked at, and those are nearly all whose boxes meet. Of a posed body's 54,000
pairs of triangles some hundreds are left, none of which intersects.

What is left out here is left out there, too. Every region of overlap within a connected part is
bounded by a contour, unless the winding number is not zero all over the part; a region none of
whose contours counts does not count (`exact.py`). So nothing counts where no pair of triangles that
intersects does, and the winding number at every part's root is zero.
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

# After so many shapes that collide the next one is measured at once: a descent's.
_COLLIDING = 2


@dataclass(frozen=True)
class AtRest:
    """What the rest surface tells of a layout.

    Attributes:
        layout: of the triangles.
        rest: the surface at rest.
        asked: whether it was asked for.
        clusters, groups: which of these are near each other; None: it is not told.
    """

    layout: Layout
    rest: Any
    asked: bool = False
    clusters: Any = None
    groups: Any = None


def expect_folds(faces: Int[np.ndarray, "F 3"], count: int, calm: bool) -> None:
    """Say of the last shape of these faces whether nothing counted: the next one may be like it."""
    manifold = manifold_of(faces, count)
    mesh = prepared(manifold.faces, len(manifold.part))
    mesh.collided = 0 if calm else mesh.collided + 1


def only_folds(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    exclusions: Exclusions,
    surely: bool = False,
) -> bool:
    """Whether nothing of a surface's overlap counts, as far as pairs of triangles tell.

    Args:
        vertices, faces: a mesh that can be measured.
        exclusions: what does not count.
        surely: look, even if it takes longer than to measure or is not to be expected.

    Returns:
        Never true where the volume that counts is above zero. Not always true where it is zero:
        not where what touches would count, or where holes were closed.
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
        # Of those that are left few intersect, and only of these it is asked exactly.
        left = np.flatnonzero(~known.clusters.near_faces(f, g))
        f, g = _intersecting(predicates, mesh.topology, layout, t[left], u[left])
        if _count(exclusions, manifold, rules, f, g).any():
            return False
    once = np.ones(manifold.num_parts, np.int64)
    return not roots_of(mesh.topology, manifold, predicates, rules, once)[1].any()


def _at_rest(mesh: Prepared, layout: Layout, manifold: Manifold, rest, surely: bool):
    """What is known of the layout; None where nothing is, and the first time it is asked for."""
    known = mesh.at_rest
    if known is None or known.layout is not layout or known.rest != rest:
        known = mesh.at_rest = AtRest(layout, rest)
        if not surely:
            return None  # it takes longer than to measure a mesh
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


def _count(
    exclusions: Exclusions, manifold: Manifold, rules, f: Int[np.ndarray, "N"], g
) -> Bool[np.ndarray, "N"]:
    """Which pairs of faces that intersect count, wholly or by their contour."""
    first, second = (manifold.part[manifold.faces[x, 0]] for x in (f, g))
    whole, judged = rules(first, second).T
    at = np.flatnonzero(judged)
    counts = whole.copy()
    beside = manifold.beside
    counts[at] |= pair_weights(exclusions, beside[f[at]], beside[g[at]]) > 0
    return counts


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
