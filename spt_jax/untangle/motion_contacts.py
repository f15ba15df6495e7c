"""Contact in a motion: which patches touch in which frames, and by which of their vertices.

Patches of two parts that touch for a while, frame after frame, are one contact. It is tied by one
pair of vertices, those that are nearest in the frame in which the two are nearest: where the skin
slides along, the pair keeps the difference that it had in each frame.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from spt_jax._contact import as_rows
from spt_jax.body import AbstractBody, BodyGroup
from spt_jax.rest.surface import RestSurface
from spt_jax.untangle.anchors import close_pairs
from spt_jax.untangle.contacts import Parts, is_found
from spt_jax.untangle.corrections import Frames, faces_of, posed
from spt_jax.untangle.motion_input import as_contacts


def as_motion_contacts(contacts: Any, body: AbstractBody, people: int) -> Any:
    """The word "found", a list of pairs of patches, or an array of pairs of vertices.

    Raises:
        TypeError, ValueError: something else.
    """
    if is_found(contacts):
        return contacts
    if isinstance(contacts, (list, tuple)) and contacts and np.ndim(contacts[0][0]):
        as_rows(contacts, faces_of(body, people))
        return [tuple(np.unique(np.asarray(patch)) for patch in pair) for pair in contacts]
    return as_contacts(contacts, body, people)


def kept_contacts(
    body: AbstractBody,
    frames: Frames,
    contacts: Any,
    distance: float,
    rest: RestSurface,
    colliding: np.ndarray,
    reach: int,
) -> tuple[Int[np.ndarray, "C 2"], Float[np.ndarray, "T C"]]:
    """Pairs of vertices that are to stay beside each other, and 1 in frames in which they are.

    Args:
        body, frames: the motion.
        contacts: as `as_motion_contacts` returns them.
        distance: what is farther apart is no contact, in metres.
        rest: of all people, by which folds are recognized.
        colliding: of each frame, whether it collides.
        reach: frames farther than that from all that collide do not move, and are not looked at.
    """
    if isinstance(contacts, np.ndarray):
        return contacts, close_pairs(body, frames, contacts, distance)
    near = np.convolve(colliding, np.ones(2 * reach + 1), "same") > 0
    looked = np.flatnonzero(near)
    runs: dict[Any, list[list[tuple[int, tuple[int, int], float]]]] = {}
    touches = _Touches(body, frames.people, contacts, distance, rest)
    at = 0
    for count, batch in frames.at(looked).batches():
        for vertices in np.asarray(posed(body, batch), np.float64)[:count]:
            frame, at = int(looked[at]), at + 1
            for key, pair, apart in touches(vertices):
                own = runs.setdefault(key, [])
                if not own or own[-1][-1][0] != frame - 1:
                    own.append([])
                own[-1].append((frame, pair, apart))
    chosen = [run for own in runs.values() for run in own]
    pairs = np.array([min(run, key=lambda one: one[2])[1] for run in chosen], np.int64)
    touching = np.zeros((len(frames.pose), len(chosen)))
    for k, run in enumerate(chosen):
        touching[[frame for frame, *_ in run], k] = 1.0
    return pairs.reshape(-1, 2), touching


class _Touches:
    """What touches in one frame: a key, the two nearest vertices, and how far apart they are."""

    def __init__(self, body, people, contacts, distance, rest):
        self._distance, self._rest = distance, rest
        self._body = body if people == 1 else BodyGroup(body, people)
        faces = faces_of(body, people)
        self._parts: Parts | None = None
        self._patches = None
        if not is_found(contacts):
            self._patches = [[np.unique(faces[patch]) for patch in pair] for pair in contacts]

    def __call__(self, vertices):
        if self._patches is not None:
            for key, (first, second) in enumerate(self._patches):
                apart, at = map(np.asarray, KDTree(vertices[second]).query(vertices[first]))
                one = int(apart.argmin())
                if apart[one] <= self._distance:
                    yield key, (int(first[one]), int(second[at[one]])), float(apart[one])
            return
        if self._parts is None:
            self._parts = Parts(self._body, vertices, self._rest)
        pairs, parts = self._parts.near(vertices, self._distance)
        apart = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        order = np.lexsort((apart, parts[:, 1], parts[:, 0]))
        two, first = np.unique(parts[order], axis=0, return_index=True)
        for key, row in zip(map(tuple, two.tolist()), order[first], strict=True):
            yield key, tuple(pairs[row].tolist()), float(apart[row])
