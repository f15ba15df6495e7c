"""What results have in common: JSON, and how they print."""

import abc
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# Of a batch of poses arrays, of one mesh plain numbers, which have what is used of arrays.
if TYPE_CHECKING:
    Numbers: TypeAlias = Array
    Counts: TypeAlias = Array
else:
    Numbers = Float[Array, "*batch"] | float
    Counts = Int[Array, "*batch"] | int


class Result(eqx.Module):
    """A result that `print` shows as a table and `as_dict` turns into JSON types."""

    @abc.abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """The numbers of the result as JSON types, without its large arrays."""

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=88, color_system=None, force_terminal=False, force_jupyter=False)
        with console.capture() as capture:
            console.print(self)
        return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())

    def __rich__(self) -> Any:
        from rich.table import Table

        table = Table.grid(padding=(0, 2))
        for name, value in _rows(self.as_dict(), ""):
            table.add_row(name, value)
        return table


class Overlap(Result):
    """How much of a surface is in self-intersection.

    Attributes:
        volume: the included overlap volume, in the cube of the unit: without folds, unless they
            count.
        total_volume: the same with folds.
        ratio: the fraction of the vertices in included overlaps (paper, Eq. 11).
        intersecting_pairs: the number of face pairs that intersect and count; faces that only touch
            do not intersect.
        total_intersecting_pairs: the same with folds.

    Example:
        >>> from spt_jax import Overlap
        >>> print(Overlap(0.5, 0.5, 0.25, 12, 12))
        is free                   False
        volume                    0.5
        total volume              0.5
        ratio                     0.25
        intersecting pairs        12
        total intersecting pairs  12
    """

    volume: Numbers
    total_volume: Numbers
    ratio: Numbers
    intersecting_pairs: Counts
    total_intersecting_pairs: Counts

    @property
    def is_free(self) -> Bool[np.ndarray, "*batch"] | bool:
        """Whether no faces intersect and no parts overlap, apart from what is excluded."""
        free = (np.asarray(self.intersecting_pairs) == 0) & ~(np.asarray(self.volume) > 0)
        return free if free.ndim else bool(free)

    def as_dict(self) -> dict[str, Any]:
        """All numbers as JSON types."""
        return {
            "is_free": plain(self.is_free),
            "volume": plain(self.volume),
            "total_volume": plain(self.total_volume),
            "ratio": plain(self.ratio),
            "intersecting_pairs": plain(self.intersecting_pairs),
            "total_intersecting_pairs": plain(self.total_intersecting_pairs),
        }


def plain(value: Any) -> Any:
    """An array or a number as JSON types: a number, or nested lists of numbers."""
    return np.asarray(value).tolist()


def _rows(content: dict[str, Any], indent: str) -> list[tuple[str, str]]:
    rows = []
    for name, value in content.items():
        heading = indent + name.replace("_", " ")
        if isinstance(value, dict):
            rows += [(heading, ""), *_rows(value, indent + "  ")]
        elif isinstance(value, list):
            shown = ", ".join(_said(entry) for entry in value[:8])
            rows.append((heading, shown + (", ..." if len(value) > 8 else "")))
        else:
            rows.append((heading, _said(value)))
    return rows


def _said(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
