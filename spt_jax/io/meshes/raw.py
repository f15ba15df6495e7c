"""What a reader hands over: a file's own vertices and triangles, and how to write them again."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Rewrite = Callable[[Float[np.ndarray, "V 3"]], bytes]


class UnreadableError(ValueError):
    """Why a file is no mesh of its format; the caller adds the file's name."""


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A mesh as its file has it, before seams are closed.

    Attributes:
        vertices: positions, in the file's order, faces refer to them.
        faces: triangles; polygons of more corners are cut already.
        double: whether the file holds positions in more than single precision.
        extras: what the file says beside the shape, such as "texture coordinates".
        notes: what a reader of the file should know of how it was read, one sentence each.
        rewrite: the file's content with other positions for the vertices and all else as it was;
            None where that cannot be done.
        dropped: what `rewrite` leaves out all the same.
        companions: files that the file names, such as material libraries, relative to its folder.
        lines: how many lines or curves the file has; they are no surface, and left out.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    double: bool = False
    extras: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    rewrite: Rewrite | None = None
    dropped: tuple[str, ...] = ()
    companions: tuple[str, ...] = ()
    lines: int = 0


def checked_corners(corners: list[int] | np.ndarray, count: int) -> Int[np.ndarray, "C"]:
    """Vertex indices as an array, once each names one of `count` vertices.

    Raises:
        UnreadableError: one does not.
    """
    try:
        indices = np.asarray(corners, np.int64).reshape(-1)
    except OverflowError:
        raise UnreadableError("a face names a vertex of a number beyond all bounds") from None
    wrong = (indices < 0) | (indices >= count)
    if wrong.any():
        raise UnreadableError(
            f"a face must name vertices that there are: got index {indices[wrong][0]} for {count} "
            "vertices, counted from 0"
        )
    return indices


def crossing_notes(crossed: int, short: int = 0) -> tuple[str, ...]:
    """What there is to say of polygons that no triangles stand for as they should."""
    notes = []
    if crossed:
        notes.append(
            f"{crossed} polygon{'s' if crossed > 1 else ''} cross themselves, so that no triangles "
            "cover them; they are cut somehow"
        )
    if short:
        notes.append(f"{short} face{'s' if short > 1 else ''} of fewer than three corners left out")
    return tuple(notes)


def holds_double(values: np.ndarray) -> bool:
    """Whether numbers read from a text have more digits than single precision can hold.

    Nine significant digits say a float32 exactly; one more says a float64.
    """
    values = values[np.isfinite(values) & (values != 0)]
    if not values.size:
        return False
    size = np.clip(np.floor(np.log10(np.abs(values))), -290, 290)
    digits = values * 10.0 ** (8 - size)
    return bool((np.abs(digits - np.rint(digits)) > 1e-4).any())
