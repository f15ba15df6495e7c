"""Contact that is to be kept: which patches of a body touch, and how far apart they were.

Two parts are in contact where vertices of theirs come near each other and are no fold, which the
rest surface says. A patch is wider than what is near: where a hand is deep in a thigh, what comes
to lie on the thigh once the two are apart is the middle of the palm, not the edge that is near the
thigh's surface now.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from spt_jax._contact import as_rows, contact_of_rows
from spt_jax._query import as_vertices
from spt_jax.body import AbstractBody
from spt_jax.overlap.nearest import nearest_points
from spt_jax.rest.surface import RestSurface

# How much farther than what is near a patch reaches, in metres.
_AROUND = 0.04

# Joints with less of the surface than this, fingers and toes, are one part with the hand or foot:
# fingers lie beside each other in every pose.
_SMALL = 0.007

# Of how many pairs there is room in one program; a pose with more takes the next multiple.
_ROOM = 16

Patches = list[tuple[Int[np.ndarray, "A"], Int[np.ndarray, "B"]]]


def find_contacts(
    body: AbstractBody,
    vertices: Float[Array, "V 3"] | Float[np.ndarray, "V 3"],
    *,
    distance: float = 0.02,
) -> Patches:
    """Patches of different parts of a posed body that are near each other or intersect.

    A part is the triangles that follow one joint (`body.part_groups`); fingers and toes belong to
    their hand or foot. Any two parts that have vertices within the distance of each other, which
    are no fold by `body.rest_surface`, give one pair of patches: the triangles of either part that
    are no farther from such a vertex than the distance and 4 cm.

    Args:
        body: whose faces, parts and rest surface are meant.
        vertices: of the posed body, in metres.
        distance: in metres.

    Returns:
        Pairs of patches as `contact_penalty` takes them, ordered by their parts; empty where
        nothing is near.

    Raises:
        ValueError: vertices of another shape or not finite; a distance that is negative or not
            finite.
        TypeError: vertices not float32 or float64.

    Differentiation: none; it runs outside jit.

    Example:
        >>> from spt_jax import find_contacts, load_body, load_mocap
        >>> body, mocap = load_body(), load_mocap()
        >>> pose = body.pose_from_smpl(mocap.pose[mocap.names.index("crawl/0092")])
        >>> pairs = find_contacts(body, body(pose).vertices)
        >>> parts = {tuple(int(body.part_groups[p[0]]) for p in pair) for pair in pairs}
        >>> len(parts) == len(pairs) > 0
        True
    """
    places = np.asarray(as_vertices(vertices), np.float64)
    if places.shape != (body.num_vertices, 3):
        raise ValueError(
            f"vertices must be those of one posed body, ({body.num_vertices}, 3): got shape "
            f"{places.shape}; find the contacts of each pose by itself."
        )
    if not np.isfinite(places).all():
        raise ValueError(
            f"vertices must be finite: got {int(np.sum(~np.isfinite(places)))} values that are not."
        )
    if not 0 <= distance < np.inf:
        raise ValueError(f"distance must be finite and not negative: got {distance!r}.")
    return Parts(body, places, body.rest_surface).contacts(places, distance)


class Parts:
    """The parts of a body, and what is the same in all of its poses."""

    def __init__(self, body: AbstractBody, vertices: Float[np.ndarray, "V 3"], rest: RestSurface):
        self.faces = np.asarray(body.faces, np.int64)
        self._rest = rest
        self._group = _parts(body, vertices)
        # A face of each vertex says of which part it is; a vertex without one is of none.
        self._face = np.full(body.num_vertices, -1, np.int64)
        self._face[self.faces] = np.arange(len(self.faces))[:, None]

    def near(
        self, vertices: Float[np.ndarray, "V 3"], distance: float
    ) -> tuple[Int[np.ndarray, "N 2"], Int[np.ndarray, "N 2"]]:
        """Pairs of vertices of different parts that are near and no fold, and their parts.

        The first part is the one with the lower number.
        """
        used = np.flatnonzero(self._face >= 0)
        pairs = used[KDTree(vertices[used]).query_pairs(distance, output_type="ndarray")]
        parts = self._group[self._face[pairs]]
        apart = parts[:, 0] != parts[:, 1]
        pairs, parts = pairs[apart], parts[apart]
        fold = self._rest.near(self._face[pairs[:, 0]], self._face[pairs[:, 1]])
        pairs, parts = pairs[~fold], parts[~fold]
        order = np.argsort(parts, axis=1)
        return np.take_along_axis(pairs, order, 1), np.take_along_axis(parts, order, 1)

    def contacts(self, vertices: Float[np.ndarray, "V 3"], distance: float) -> Patches:
        """One pair of patches for each two parts that are near."""
        pairs, parts = self.near(vertices, distance)
        of_face = self._group
        found: Patches = []
        for two in np.unique(parts, axis=0):
            own = pairs[(parts == two).all(axis=1)]
            patches = []
            for side in (0, 1):
                faces = np.flatnonzero(of_face == two[side])
                seeds = KDTree(vertices[np.unique(own[:, side])])
                away = seeds.query(vertices[self.faces[faces]])[0].min(axis=1)
                patches.append(faces[away <= distance + _AROUND])
            found.append((patches[0], patches[1]))
        return found


def _parts(body: AbstractBody, vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "F"]:
    """The part of each face: the joint that it follows, or, of small ones, the next above."""
    groups = np.asarray(body.part_groups, np.int64)
    a, b, c = vertices[np.asarray(body.faces)].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    people = sum(parent < 0 for parent in body.parents)
    share = people * np.bincount(groups, area, len(body.parents)) / area.sum()
    into = np.arange(len(share))
    for joint, parent in enumerate(body.parents):  # which come before their children
        if parent >= 0 and share[joint] < _SMALL:
            into[joint] = into[parent]
    return into[groups]


class Held(NamedTuple):
    """Contacts of one pose, padded to a number that programs share.

    Attributes:
        rows: as `contact_of_rows` takes them, with padding.
        apart: how far apart each pair was, in metres.
        weight: of the squared distance beyond that, per cm^2.
    """

    rows: Int[Array, "R 3"]
    apart: Float[Array, " K"]
    weight: Float[Array, ""]


def held_contacts(
    body: AbstractBody,
    vertices: Float[np.ndarray, "V 3"],
    contacts: Any,
    distance: float,
    weight: float,
    rest: RestSurface | None,
    *,
    dtype: Any,
) -> Held | None:
    """The contacts of a pose that are to be kept; None without any.

    Args:
        body: the body.
        vertices: of the pose given.
        contacts: "found", or pairs of patches.
        distance: pairs farther apart than that are no contact.
        weight: of the squared distance, per cm^2.
        rest: the surface by which folds are recognized; None for the body's own.
        dtype: of the search.
    """
    faces = np.asarray(body.faces, np.int64)
    if is_found(contacts):
        contacts = Parts(body, vertices, rest or body.rest_surface).contacts(vertices, distance)
    patches, apart = [], []
    for first, second in contacts:
        pair = np.unique(np.asarray(first)), np.unique(np.asarray(second))
        away = nearest_points(vertices, faces, *pair).distance
        if away <= distance:
            patches.append(pair)
            apart.append(away)
    if not patches or not weight:
        return None
    rows = as_rows(patches, faces)
    room = -(-len(patches) // _ROOM) * _ROOM
    which, corners = np.split(rows, 2)
    more = (1 << int(len(which) - 1).bit_length()) - len(which)  # few sizes, few programs
    padded = [
        np.pad(x, ((0, more), (0, 0)), constant_values=v) for x, v in ((which, -1), (corners, 0))
    ]
    given = np.zeros(room)
    given[: len(apart)] = apart
    return Held(
        jnp.asarray(np.concatenate(padded), np.int32),
        jnp.asarray(given, dtype),
        jnp.asarray(weight, dtype),
    )


def contact_cost(vertices: Float[Array, "V 3"], held: Held, margin: float) -> Float[Array, ""]:
    """The weighed squares of how far pairs are beyond where they were, or beyond the margin, cm^2.

    Where they were nearer than the margin, as where they intersected, they are held at the margin:
    there they touch, and the overlap of the surface moved outwards by half of it ends.
    """
    limits = jnp.maximum(held.apart, jnp.asarray(margin, held.apart.dtype))
    squares = contact_of_rows(vertices, held.rows, len(held.apart), limits)
    return held.weight * squares * 1e4


def is_found(contacts: Any) -> bool:
    """Whether contacts are to be found; ValueError for another word."""
    if isinstance(contacts, str) and contacts != "found":
        raise ValueError(f"contacts must be 'found', pairs of patches or None: got {contacts!r}.")
    return isinstance(contacts, str)
