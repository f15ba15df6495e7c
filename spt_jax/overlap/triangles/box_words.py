"""Boxes of triangles as whole numbers, three coordinates to a word.

A box is compared as two words, not as six numbers. Three coordinates of 20 bits, each with a guard
bit above it, make a word of 63 bits:

    | guard | x, 20 bits | guard | y, 20 bits | guard | z, 20 bits |

With the guards of the minuend set, one subtraction compares three coordinates, because a field that
would fall below zero borrows its own guard, and no other field's:

    high 7, other's low 5:  1 0111 - 0101 = 1 0010   the guard stands: high >= low
    high 7, other's low 9:  1 0111 - 1001 = 0 1110   it is gone:       high <  low

Two boxes meet where all six guards stand after two subtractions (`boxes_meet`). Coordinates are
rounded outwards to whole numbers, so boxes that meet are never missed; some that are apart by less
than a step are kept, and fall to the next test.

Boxes that are known to be near each other are compared in words of half the bytes (`Short`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from spt_jax.overlap.arrays.columns import cross
from spt_jax.overlap.triangles.pair_layout import CLUSTER, Layout

# A coordinate of a box takes 20 bits and a guard bit, three to a word: two subtractions of words
# do the six comparisons of two boxes, and a pair gathers four numbers instead of twelve.
_FIELD = 21
STEPS = (1 << (_FIELD - 1)) - 3  # one more for what is rounded up, and one for empty slots
GUARDS = sum(1 << (_FIELD * k + _FIELD - 1) for k in range(3))
# The same in half the bytes for boxes that are known to be near each other: 9 bits of a coordinate,
# counted round, and a guard bit. The sign of a difference is its highest bit but the guard.
_SHORT_FIELD = 10
_SHORT_MASK = (1 << (_SHORT_FIELD - 1)) - 1
_SHORT_GUARDS = np.uint32(sum(1 << (_SHORT_FIELD * k + _SHORT_FIELD - 1) for k in range(3)))
SHORT_SIGNS = np.uint32(sum(1 << (_SHORT_FIELD * k + _SHORT_FIELD - 2) for k in range(3)))
# Clusters so many times as large as the usual one are compared in long words.
_LARGE = 5
# So many pairs of boxes are sampled to decide whether most only touch.
_SAMPLE = 256


@dataclass(frozen=True)
class Boxes:
    """Boxes as whole numbers (3, C), and as words; and those around every `CLUSTER` of them."""

    low: Int[np.ndarray, "3 C"]
    high: Int[np.ndarray, "3 C"]
    low_word: Int[np.ndarray, "C"]
    high_word: Int[np.ndarray, "C"]
    around: "Boxes | None" = None


@dataclass(frozen=True)
class Short:
    """Boxes in short words, for the triangles of clusters that meet; and clusters too large."""

    low: UInt32[np.ndarray, "S"]
    high: UInt32[np.ndarray, "S"]
    large: Bool[np.ndarray, "C"]


@dataclass(frozen=True)
class Slots:
    """The triangles in their slots: corners, and boxes as whole numbers and as words."""

    corner: Float[np.ndarray, "3 3 S"]  # axis, corner, slot
    extent: Float[np.ndarray, "S"]
    low: Int[np.ndarray, "3 S"]
    high: Int[np.ndarray, "3 S"]
    low_word: Int[np.ndarray, "S"]
    high_word: Int[np.ndarray, "S"]
    span: float  # the longest side of the box around all


@dataclass(frozen=True)
class Shape(Slots):
    """The same with area normals."""

    normal: Float[np.ndarray, "3 S"]
    length: Float[np.ndarray, "S"]  # of the normal


def slots_of(points, layout: Layout) -> Slots:
    """The triangles in a layout, and their boxes."""
    corner = points.take(layout.corners, axis=1)
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    extent = (high - low).sum(axis=0)
    base = low.min(axis=1, keepdims=True)
    span = float((high - base).max())
    scale = STEPS / span if span > 0 else 0.0
    # Rounding down keeps the order of any two coordinates, so boxes that meet still do; one more
    # step, and so do boxes that are apart by rounding.
    low = ((low - base) * scale).astype(np.int64)
    high = ((high - base) * scale).astype(np.int64) + 1
    low[:, layout.empty] = STEPS + 2  # above every other, also one that spans the mesh
    high[:, layout.empty] = 0
    return Slots(corner, extent, low, high, word(low), word(high) | GUARDS, span)


def shape_of(points, layout: Layout) -> Shape:
    """The same with area normals, which take a third of the time."""
    slots = slots_of(points, layout)
    a, b, c = slots.corner[:, 0], slots.corner[:, 1], slots.corner[:, 2]
    normal = cross(b - a, c - a)
    normal *= layout.sense
    normal[:, layout.empty] = 0.0
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    return Shape(**vars(slots), normal=normal, length=length)


def short_words(shape: Slots, clusters: Boxes) -> Short:
    """The triangles' boxes in short words.

    Two coordinates of triangles in clusters that meet differ by two clusters' extents at most. So
    the sign of their difference is known of any steps of which that is less than 256.
    """
    extent = (clusters.high - clusters.low).max(axis=0)
    usual = np.median(extent[extent >= 0]) if (extent >= 0).any() else 0  # below 0 where empty
    large = extent > _LARGE * usual
    most = int(extent[~large].max(initial=0))
    shift = max((2 * most + 2).bit_length() - (_SHORT_FIELD - 2), 0)
    low, high = (
        _short_word((field.astype(np.uint32) >> np.uint32(shift)) & np.uint32(_SHORT_MASK))
        for field in (shape.low, shape.high)
    )
    return Short(low, high | _SHORT_GUARDS, large)


def _short_word(field):
    return (field[0] << 2 * _SHORT_FIELD) | (field[1] << _SHORT_FIELD) | field[2]


def around(low, high):
    """The boxes around every `CLUSTER` boxes."""
    count = low.shape[1] // CLUSTER
    while low.shape[1] > count:
        low = np.minimum(low[:, ::2], low[:, 1::2])
        high = np.maximum(high[:, ::2], high[:, 1::2])
    return low, high


def joined(low, high, around: Boxes | None = None) -> Boxes:
    """Boxes with their words."""
    return Boxes(low, high, word(low), word(high) | GUARDS, around)


def word(field):
    """Three coordinates in one number."""
    return (((field[0] << _FIELD) | field[1]) << _FIELD) | field[2]


def boxes_meet(low, high, other_low, other_high):
    """Whether boxes meet: a guard bit survives where the high end is not below the low one."""
    first = high - other_low
    first &= other_high - low
    first &= GUARDS
    return first == GUARDS


def touching_share(shape: Shape, t, u) -> float:
    """What part of some pairs of triangles have boxes that share no more than a side.

    Args:
        t, u: their slots; some are looked at.
    """
    step = max(len(t) // _SAMPLE, 1)
    some, others = t[::step], u[::step]
    # The high ends are one step above where they are.
    over = shape.high.take(some, axis=1) - shape.low.take(others, axis=1)
    under = shape.high.take(others, axis=1) - shape.low.take(some, axis=1)
    return float((np.minimum(over, under).min(axis=0) == 1).mean())
