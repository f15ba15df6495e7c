"""Fields of an opened pose file, checked as they are read, and kept in mind for writing."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from spt_jax.io.poses.containers import Container, Unread
from spt_jax.io.poses.rotations import Form, form_of

Way = tuple[Any, ...]
"""The keys from the root of a file's tree to a value in it."""

# Beyond these a number is none of a body's: angles in radians, however often they wind, and the
# numbers of matrices and quaternions; shape coefficients; positions in metres, or in millimetres.
MOST_RADIANS = 1e4
MOST_SHAPE = 1e4
MOST_METRES = 1e9
_GENDERS = {"m": "male", "f": "female", "n": "neutral"}


class UnknownStructureError(ValueError):
    """A file that was read and holds poses in no structure that is known, or no poses."""


class Block(NamedTuple):
    """Rotations that stand together in a file.

    Attributes:
        way: of their array.
        index: which part of it they are; () for all.
        form: how they are written.
        joints: which rows of a track's pose they are.
        rows: which frames of it; None for all.
    """

    way: Way
    index: tuple[Any, ...]
    form: Form
    joints: tuple[int, ...]
    rows: slice | None = None


class Source:
    """An opened file: its values by the way to them, each checked, and which were used."""

    def __init__(self, container: Container):
        self.container, self.tree = container, container.tree
        self.file = os.fspath(container.path)
        self.stem = container.path.stem
        self.used: set[Way] = set()
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        """Keep a sentence about what was decided or left out, once."""
        if text and text not in self.notes:
            self.notes.append(text)

    def get(self, way: Way) -> Any:
        """The value there; None where there is none."""
        node = self.tree
        for key in way:
            try:
                node = node[key]
            except (KeyError, IndexError, TypeError, ValueError):
                return None
        return node

    def first(self, at: Way, names: Iterable[str]) -> Way | None:
        """The way to the first of some fields that the file has."""
        inner = self.get(at)
        if not isinstance(inner, Mapping):
            return None
        return next(((*at, name) for name in names if inner.get(name) is not None), None)

    def numbers(
        self, way: Way, index: tuple[Any, ...] = (), most: float = MOST_RADIANS
    ) -> np.ndarray:
        """An array of finite numbers of a body's size, in double precision.

        Raises:
            ValueError: it is none; the message names file and field.
        """
        self.used.add(way)
        value, name = self.get(way), spelt(way)
        if isinstance(value, Unread):
            raise ValueError(f"{name} in {self.file!r} cannot be read: {value}")
        array = self._array(value, name)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} must hold numbers: got {array.dtype} in {self.file!r}")
        try:
            array = array[index]
        except IndexError:
            raise ValueError(
                f"{name} must hold an entry {index}: got shape {array.shape} in {self.file!r}; the "
                "file contradicts itself"
            ) from None
        with np.errstate(over="ignore", invalid="ignore"):
            numbers = np.asarray(array, np.float64)
        within = np.abs(numbers) <= most
        if not within.all():
            place = tuple(int(i) for i in np.argwhere(~within)[0])
            rule = "be finite" if not np.isfinite(numbers[place]) else f"be within {most:g} of zero"
            raise ValueError(
                f"{name} must {rule}: got {numbers[place]:g} at {place} in {self.file!r}; it is "
                "damaged, or in another unit"
            )
        return numbers

    def _array(self, value: Any, name: str) -> np.ndarray:
        if isinstance(value, Mapping | str) or value is None:
            raise ValueError(
                f"{name} must hold numbers: got {type(value).__name__} in {self.file!r}"
            )
        try:
            array = np.asarray(value)
            if array.dtype.hasobject:  # arrays in a list, or in an array of objects
                array = np.stack([np.asarray(x, np.float64) for x in np.ravel(array)]).reshape(
                    *array.shape, *np.shape(np.ravel(array)[0])
                )
            return array
        except (TypeError, ValueError, IndexError, OverflowError) as error:
            raise ValueError(
                f"{name} must hold numbers: got other things, or rows of different lengths, in "
                f"{self.file!r} ({' '.join(str(error).split())[:80]})"
            ) from None

    def rotations(
        self,
        way: Way,
        joints: Sequence[int],
        *,
        index: tuple[Any, ...] = (),
        frames: int | None = None,
        forms: Sequence[Form] = (),
        rows: slice | None = None,
    ) -> tuple[Float[np.ndarray, "N J 3"], Block] | None:
        """Frames of rotations, and where they stand; None where the array has no such shape.

        Args:
            way, index: of the array.
            joints: which rows of a track's pose they are.
            frames: how many frames there are, where that is known.
            forms: those that are possible; where none are given, the shape decides.
            rows: which frames of the track they are.

        Raises:
            ValueError: they are none.
        """
        values = self.numbers(way, index)
        try:
            form = form_of(values, len(joints), frames, forms)
            if form is None:
                return None
            shaped = values.reshape(-1, len(joints), *form.tail)
            if not len(shaped):
                raise ValueError("must hold at least one frame: got none")
            self.note(form.note)
            return form.decode(shaped), Block(way, index, form, tuple(joints), rows)
        except ValueError as error:
            raise ValueError(f"{spelt(way)} {error} in {self.file!r}") from None

    def gender(self, way: Way | None, index: int | None = None) -> str | None:
        """ "male", "female" or "neutral"; None where the file says none of them."""
        if way is None:
            return None
        self.used.add(way)
        value = self.get(way)
        if index is not None and not isinstance(value, str | bytes):
            value = np.asarray(value, object).ravel()[index] if index < np.size(value) else None
        value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
        text = value.decode("latin1") if isinstance(value, bytes) else str(value)
        text = text.strip().lower().removeprefix("b'").strip("'\"")
        found = _GENDERS.get(text[:1]) if text in _GENDERS or text in _GENDERS.values() else None
        if found is None and value is not None:
            self.note(f"{spelt(way)} is left out: it is none of male, female, neutral")
        return found

    def frame_rate(self, way: Way | None) -> float | None:
        """Frames a second, where the file says how many."""
        if way is None:
            return None
        value = self.numbers(way, most=1e5)
        if value.size != 1 or not value.item() > 0:
            raise ValueError(
                f"{spelt(way)} must be one positive number of frames a second: got "
                f"{np.array2string(value, threshold=4)} in {self.file!r}"
            )
        return float(value.item())

    def shape(self, way: Way | None, frames: int, index: tuple[Any, ...] = ()) -> Any:
        """Shape coefficients (B,) or (frames, B)."""
        if way is None:
            return None
        values = self.numbers(way, index, MOST_SHAPE)
        if values.ndim == 2 and len(values) == 1 and frames != 1:
            values = values[0]
        if values.ndim not in (1, 2) or (values.ndim == 2 and len(values) != frames):
            raise ValueError(
                f"{spelt(way)} must have shape (B,) or ({frames}, B): got {values.shape} in "
                f"{self.file!r}"
            )
        return values

    def translation(self, way: Way | None, frames: int, index: tuple[Any, ...] = ()) -> Any:
        """Positions (frames, 3), in metres."""
        if way is None:
            return None
        values = self.numbers(way, index, MOST_METRES)
        if values.ndim == 3 and values.shape[1] == 1:
            values = values[:, 0]
        if values.shape not in ((3,), (1, 3), (frames, 3)):
            raise ValueError(
                f"{spelt(way)} must have shape (3,) or ({frames}, 3): got {values.shape} in "
                f"{self.file!r}"
            )
        return np.broadcast_to(values, (frames, 3)).copy()

    def unused(self) -> list[str]:
        """The names of the fields that stand beside those that were used, and were not."""
        found: dict[str, None] = {}
        used = {way[:k] for way in self.used for k in range(len(way) + 1)}
        for way in used:
            node = self.get(way)
            if isinstance(node, Mapping) and way not in self.used:
                found |= {
                    str(key): None
                    for key in node
                    if isinstance(key, str) and (*way, key) not in used
                }
        return sorted(found)


def spelt(way: Way) -> str:
    """A way as messages say it: "person 3, pose"."""
    names = [key if isinstance(key, str) else f"[{key}]" for key in way]
    return ".".join(names).replace(".[", "[") or "the array"
