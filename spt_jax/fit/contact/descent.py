"""One descent: squares linearised anew at each place, the overlap by its cuts."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from spt_jax.fit.contact.cuts import Cuts
from spt_jax.fit.contact.places import Place

# It ends where the model promises to take away no more than this (1 is a keypoint that is off by
# its expected error) and this part of the total, or where so many looks in a row took away no more.
_ATOL, _RTOL = 2e-2, 2e-3
_CRAWL = 8

# Added to J'J, per squared radian and squared metre: what nothing else says anything about stays.
_STIFFNESS = 0.1

# How strongly a step is held, likewise, after the first that made things worse, how much less at
# most after one that went as the model said (Nielsen 1999, "Damping parameter in Marquardt's
# method"); and beyond the last the place is one that no step leaves. The squares' own curvature as
# the metric would hold back what they know best as much as what they do not: without a prior the
# search then crawls.
_HELD, _LESS, _STUCK = 1.0, 1 / 3, 1e7


#: Measures a place.
Look = Callable[[Any, float], Place | None]


class Ended(NamedTuple):
    """Where a descent ended.

    Attributes:
        place: the best one.
        converged: whether there was nothing left to gain there.
    """

    place: Place
    converged: bool


def descend(look: Look, place: Place, cuts: Cuts, weight: float, margin: float, most: int) -> Ended:
    """Minimise the terms and a weight times the overlap.

    Args:
        look: what measures a place, given variables and a margin; None where that cannot be done.
        place: where to start, measured with this margin.
        cuts: what is known of the overlap; learns more.
        weight: of the overlap, per cm^3.
        margin: how far apart parts are pushed, in metres.
        most: places that are measured at most.
    """
    held, more, total = 0.0, 2.0, place.total(weight)
    cuts.learn(place.vector, place.energy, place.gradient, place.vector, place.energy)
    eye, totals = np.eye(place.vector.shape[1]), [total]
    for _ in range(most):
        proximal = np.broadcast_to((_STIFFNESS + held) * eye, place.squares.curvature.shape)
        step, gain = cuts.step(place.vector, place.squares, proximal, weight)
        # A held step always promises little; only a free one shows that nothing is left to gain.
        little = _ATOL + _RTOL * total
        if held <= _HELD and not gain > little:
            return Ended(place, True)
        ahead = look(place.vector + step, margin)
        gained = -np.inf if ahead is None else total - ahead.total(weight)
        if ahead is not None and gained > 0:
            place, total, more = ahead, ahead.total(weight), 2.0
            held *= max(_LESS, 1 - (2 * gained / max(gain, gained) - 1) ** 3)
            held = held if held > _HELD * _LESS else 0.0
        else:
            held, more = max(held * more, _HELD), 2 * more
        if ahead is not None:
            cuts.learn(ahead.vector, ahead.energy, ahead.gradient, place.vector, place.energy)
        totals.append(total)
        crawls = len(totals) > _CRAWL and totals[-_CRAWL - 1] - total <= little
        if crawls or held > _STUCK:
            return Ended(place, True)
    return Ended(place, False)
