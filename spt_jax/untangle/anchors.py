"""What of a body is to stay where it was in a motion: standing feet, and contact that is wanted.

An anchor is a weighted sum of vertices: the middle of a foot, or the difference of two vertices in
contact. In each frame its displacement in cm, squared and weighed, is part of the cost of a
correction, linearised anew wherever the search has come to: a leg that turns at hip and knee keeps
its foot in place to first order alone.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from spt_jax.body import AbstractBody
from spt_jax.untangle.corrections import Corrections, Frames, corrected, posed
from spt_jax.untangle.descent import CENTIMETRE
from spt_jax.untangle.frame_cuts import Ties

# Vertices of a foot whose middle is kept.
_OF_A_FOOT = 24

# A frame is linearised anew once it moved by this, in cm (rms).
_MOVED = 0.1


class Anchors(NamedTuple):
    """Sums of vertices that are to stay, and how strongly in each frame.

    Attributes:
        vertices: those that any anchor uses, numbers in one body.
        sums: of each anchor the weight of every person's such vertices.
        weight: of each frame and anchor, per cm^2 of squared displacement; 0 where it is free.
    """

    vertices: tuple[int, ...]
    sums: Float[np.ndarray, "A P S"]
    weight: Float[np.ndarray, "T A"]

    def at(self, frames: Int[np.ndarray, "N"]) -> "Anchors":
        """Those of some frames."""
        return self._replace(weight=self.weight[frames])


def anchors_of(
    body: AbstractBody,
    frames: Frames,
    feet: np.ndarray,
    standing: Float[np.ndarray, "T P K"],
    contacts: Int[np.ndarray, "C 2"],
    kept: Float[np.ndarray, "T C"],
) -> Anchors:
    """The anchors of a motion.

    Args:
        body: the body.
        frames: the motion.
        feet: (K, V) of bool, which vertices are of each foot.
        standing: what the squared displacement of each person's feet weighs.
        contacts: pairs of vertices, numbered through all people.
        kept: what the squared change of each pair's difference weighs.
    """
    soles = [_some(np.flatnonzero(foot)) for foot in feet]
    person, vertex = np.divmod(contacts, body.num_vertices)
    used = np.unique(np.concatenate([np.zeros(0, np.int64), *soles, vertex.ravel()]))
    sums = np.zeros((frames.people * len(soles) + len(contacts), frames.people, len(used)))
    for k in range(frames.people * len(soles)):
        of, foot = divmod(k, len(soles))
        sums[k, of, np.searchsorted(used, soles[foot])] = 1 / len(soles[foot])
    for k in range(len(contacts)):
        at = np.searchsorted(used, vertex[k])
        sums[frames.people * len(soles) + k, person[k], at] = 1.0, -1.0
    weight = np.concatenate([standing.reshape(len(frames.pose), -1), kept], axis=1)
    return Anchors(tuple(used.tolist()), sums, weight)


def _some(indices: Int[np.ndarray, "N"]) -> Int[np.ndarray, "S"]:
    return indices[np.unique(np.linspace(0, len(indices) - 1, _OF_A_FOOT).astype(int))]


def close_pairs(
    body: AbstractBody, frames: Frames, pairs: Int[np.ndarray, "C 2"], distance: float
) -> Float[np.ndarray, "T C"]:
    """1 in frames in which two vertices are as near to each other as that, in metres, else 0."""
    if not len(pairs):
        return np.zeros((len(frames.pose), 0))
    parts = []
    for count, batch in frames.batches():
        vertices = np.asarray(posed(body, batch))[:count]
        apart = np.linalg.norm(vertices[:, pairs[:, 0]] - vertices[:, pairs[:, 1]], axis=-1)
        parts.append(apart <= distance)
    return np.concatenate(parts).astype(np.float64)


@eqx.filter_jit
def _values_and_slopes(body, frames: Frames, turn, sums):
    """Where each anchor is, and the derivative by the turns."""

    def place(turn, pose, shape, translation):
        points = body(corrected(pose, turn), shape, translation).vertices
        return jnp.einsum("aps,psc->ac", sums, points)

    def both(turn, pose, shape, translation):
        arguments = pose, shape, translation
        return place(turn, *arguments), jax.jacfwd(place)(turn, *arguments)

    return jax.lax.map(lambda x: both(*x), (turn, *frames))


class Anchored:
    """The anchors of a window, linearised where its frames were last."""

    def __init__(self, corrections: Corrections, anchors: Anchors):
        self._corrections, self._anchors = corrections, anchors
        held = np.flatnonzero(anchors.weight.any(axis=1)) if anchors.vertices else np.zeros(0, int)
        self._frame, self._place = held, np.zeros((len(held), corrections.size))
        if len(held):
            self._body = corrections.body.at_vertices(np.array(anchors.vertices))
            self._first, self._slope = self._measured(held, self._place)
            self._height = np.zeros_like(self._first)

    def look(self, vectors: Float[np.ndarray, "T N"]) -> None:
        """Linearise anew where frames have moved."""
        there = vectors[self._frame]
        moved = np.flatnonzero(np.linalg.norm(there - self._place, axis=1) > _MOVED)
        if len(moved):
            place, slope = self._measured(self._frame[moved], there[moved])
            self._place[moved], self._slope[moved] = there[moved], slope
            said = np.einsum("facn,fn->fac", slope, there[moved])
            self._height[moved] = (place - self._first[moved]) - said

    def _measured(self, frame, vectors):
        places, slopes = [], []
        sums = jnp.asarray(self._anchors.sums, self._corrections.frames.pose.dtype)
        turns = self._corrections.turns(vectors)
        for _, frames, turn in self._corrections.batches(frame, turns):
            found = _values_and_slopes(self._body, frames, turn, sums)
            places.append(np.asarray(found[0], np.float64))
            slopes.append(np.asarray(found[1], np.float64).reshape(*found[0].shape, -1))
        place = np.concatenate(places)[: len(frame)] / CENTIMETRE
        slope = np.concatenate(slopes)[: len(frame)] / CENTIMETRE
        return place, self._corrections.slopes(slope)

    def ties(self) -> Ties:
        """One row for each axis of an anchor that has a weight."""
        if not len(self._frame):
            return Ties.none(self._corrections.size)
        weight = np.repeat(self._anchors.weight[self._frame][..., None], 3, axis=-1)
        chosen = weight > 0
        frame = np.broadcast_to(self._frame[:, None, None], weight.shape)[chosen]
        return Ties(frame, self._slope[chosen], self._height[chosen], weight[chosen])
