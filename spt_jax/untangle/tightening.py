"""The way back: displacements that free a mesh are made smaller while it stays free.

A search goes farther than it must. Each group of vertices that moved together is pulled back
towards where it was, by halving, as far as nothing intersects again; then those that moved least
are put back where they were.
"""

import numpy as np
from jaxtyping import Int

from spt_jax.untangle.places import Place, Places

# Halvings of the way back, and vertices that moved by less than such a share of the largest
# displacement around them are tried where they were.
_TIGHTENINGS = 4
_FADED = (0.1, 0.03)


def tighten(places: Places, place: Place) -> Place:
    """A place where nothing is left, pulled back towards the start while that stays so."""
    start, shift = places.start.vertices, place.vertices - places.start.vertices
    edge, corners = places.start.ends
    moved = (shift != 0).any(axis=1)
    groups = places.surface.groups(moved | places.start.crossed, edge[:, 0], corners[:, 0])
    count = len(groups)
    name = np.full(len(moved), count)
    for k, members in enumerate(groups):
        name[members] = k
    low, high = np.zeros(count + 1), np.ones(count + 1)
    # Parts that something was pushed into, and that then moved, may not have to.
    without = np.ones(count + 1)
    without[:count] = [places.start.crossed[members].any() for members in groups]
    if (without < 1).any() and places.is_freed(
        places.there(start + without[name][:, None] * shift)
    ):
        high = without
    for _ in range(_TIGHTENINGS):
        middle = 0.5 * (low + high)
        there = places.there(start + middle[name][:, None] * shift)
        stuck = np.ones(count + 1, bool)
        if there is not None and (places.is_freed(there) or there.left):
            stuck = np.zeros(count + 1, bool)
            stuck[name[there.crossed]] = True
        low, high = np.where(stuck, middle, low), np.where(stuck, high, middle)
    back = places.there(start + high[name][:, None] * shift)
    if back is not None and places.is_freed(back):
        place = back
    return _narrowed(places, place, groups)


def _narrowed(places: Places, place: Place, groups: list[Int[np.ndarray, "_"]]) -> Place:
    """The same without the vertices that moved least, where that does."""
    start = places.start.vertices
    shift = place.vertices - start
    size = np.linalg.norm(shift, axis=1)
    largest = np.zeros(len(size))
    for members in groups:
        largest[members] = size[members].max()
    for share in _FADED:
        # Continuous: the largest displacement stays, those of this share of it vanish.
        rest = np.maximum(size - share * largest, 0.0) / (1.0 - share)
        scale = rest / np.where(size > 0, size, 1.0)
        there = places.there(start + scale[:, None] * shift)
        if there is not None and places.is_freed(there):
            return there
    return place
