"""The part of a mesh on which the winding numbers at a few of its vertices depend."""

import numpy as np
from jaxtyping import Float, Int

# Rows and columns of the screen: on a body some 1 % of the triangles share both with a vertex.
_CELLS = 1 << 10


def around(
    screen: Float[np.ndarray, "3 V"], faces: Int[np.ndarray, "F 3"], sample: Int[np.ndarray, "S"]
) -> Int[np.ndarray, "K"]:
    """Triangles that may contain a vertex of the sample, by counting those in their boxes."""
    found, some = np.arange(len(faces)), faces
    for x in screen[:2]:
        low, span = x.min(), np.ptp(x)
        # Rounding down keeps the order of any two coordinates.
        cell = ((x - low) * (_CELLS / span if span > 0 else 0.0)).astype(np.int32)
        below = np.zeros(_CELLS + 2, np.int32)
        np.cumsum(np.bincount(cell[sample], minlength=_CELLS + 1), out=below[1:])
        a, b, c = (cell.take(corner) for corner in some.T)
        first, last = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        kept = np.flatnonzero(below[1:].take(last) > below.take(first))
        found, some = found[kept], some.take(kept, axis=0)
    return found


def used_alone(
    screen: Float[np.ndarray, "3 V"], faces: Int[np.ndarray, "F 3"], sample: Int[np.ndarray, "S"]
) -> tuple[Float[np.ndarray, "3 U"], Int[np.ndarray, "F 3"], Int[np.ndarray, "S"]]:
    """The same without the vertices that no triangle uses."""
    used = np.zeros(screen.shape[1], bool)
    used[faces.ravel()] = True
    number = np.cumsum(used) - 1
    return screen[:, used], number.take(faces), number[sample]
