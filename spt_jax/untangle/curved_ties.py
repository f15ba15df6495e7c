"""The least cost of a correction over cuts and anchors, whose places are no linear functions.

A foot or a pair in contact moves in proportion to the turns of the joints only as long as they are
small. A step that moves two arms by 4 cm takes them 4 mm off what their tangents say: at a weight
of 3,000 per cm^2 that costs 480 where 9 were foreseen, more than all else that is asked of the
correction, and the next step pays it back and lets the bodies collide again. With the ties taken
for planes, steps went to and fro between contact and freedom, and the search ended at whichever
place happened to be free: contact beside a colliding frame was 24 to 30 mm off with weights of 100
and more, where a weight of 20 left 1.6 mm.

Anchors cost a hundredth of what overlaps do. So they are linearised anew, step by step while the
cuts stay what they are, until they cost what was said; and where a step made things worse, or gains
far less than it should, the tied frames are held to where they were (Levenberg and Marquardt).
Without the hold, the steps run away: residuals stay where contact and freedom exclude each other.
"""

import numpy as np
from jaxtyping import Float

from spt_jax.untangle.anchors import Anchored
from spt_jax.untangle.frame_cuts import FrameCuts, Prior

# Steps with the same cuts, at the most.
_STEPS = 12

# A step is taken where it gains so much of what it should. It is the last one where nothing is held
# or little was gained, and the ties cost little more than was said: parts of the whole cost.
_GOOD, _SMALL = 0.25, 0.03

# Ties of no more than this weight may cost what they like after a step that is taken: the next
# round comes closer. Standing feet and contact weigh so much unless told otherwise; coming close at
# once changes nothing there but where the search ends (a backflip's largest second difference: 1.5
# times the motion's for 1.14), while at 3,000 contact is 6 mm off for 0.3 without it.
_LIGHT = 20.0

# How much more tightly frames are held after a step that is not taken, and less after one that is.
_TIGHTER, _LOOSER = 4.0, 0.25


def anchored_minimum(
    cuts: FrameCuts,
    known: Prior,
    weight: Float[np.ndarray, "T"],
    anchored: Anchored,
    vectors: Float[np.ndarray, "T N"],
    hold: Float[np.ndarray, "T"],
) -> Float[np.ndarray, "T N"]:
    """The correction that costs least over prior, cuts and anchors, as far as found from a place.

    Args:
        cuts, known: the cuts and the prior.
        weight: what the cuts of each frame weigh.
        anchored: the anchors; afterwards linearised where the correction is.
        vectors: where the search has come to.
        hold: the stiffness at first of what holds a frame, if anything has to.

    Returns:
        `FrameCuts.minimum` where nothing is anchored; else what costs no more than `vectors`.
    """

    def rest_of(place) -> float:
        return known.cost(place) + float(weight @ cuts.reach(place) ** 2)

    anchored.look(vectors)
    ties = anchored.ties()
    if not len(ties.frame):
        return cuts.minimum(known, weight, ties)
    light = ties.weight.max() <= _LIGHT
    unit = np.zeros_like(hold)
    unit[ties.frame] = hold[ties.frame]
    held, place, before = np.zeros_like(hold), vectors, rest_of(vectors) + ties.cost(vectors)
    for _ in range(_STEPS):
        found = cuts.minimum(known.held(held, place), weight, ties)
        rest, said = rest_of(found), ties.cost(found)
        anchored.look(found)
        fresh = anchored.ties()
        true = fresh.cost(found)
        gain = before - rest - true
        if gain < _GOOD * (before - rest - said):
            held = np.maximum(_TIGHTER * held, unit)
            continue
        place, before, ties = found, rest + true, fresh
        settled = not held.any() or gain <= _SMALL * before
        if settled and (light or true - said <= _SMALL * (rest + said)):
            break
        held = np.where(held > unit, _LOOSER * held, 0.0)
    anchored.look(place)
    return place
