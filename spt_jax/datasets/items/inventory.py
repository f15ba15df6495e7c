"""What lies in a folder: the files of a data set, what else there is, and who takes what."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from spt_jax.datasets.items.store import RESERVED, Store


class Item(NamedTuple):
    """A file of a data set, or a folder of files that belong together.

    Attributes:
        name: its path in the folder, with slashes.
        path: the file.
        size: in bytes.
        modified: when it was last changed, in nanoseconds.
    """

    name: str
    path: Path
    size: int
    modified: int


class Inventory(NamedTuple):
    """What a folder holds.

    Attributes:
        items: the files that are worked on, by name.
        others: of the rest, how many there are of each suffix.
        examples: and one of each.
    """

    items: tuple[Item, ...]
    others: dict[str, int]
    examples: dict[str, str]


def take_inventory(
    folder: Path,
    out: Path,
    wanted: Callable[[Path], bool],
    one: Callable[[Sequence[Path]], bool] = lambda paths: False,
) -> Inventory:
    """Look through a folder and all below it; links to folders are followed, each folder once.

    Args:
        folder: where to look.
        out: where results go; it is left out where it lies in the folder.
        wanted: whether a file is one of the data set.
        one: whether files of one folder, which are called alike but for a number at the end, are
            the frames of one item, the folder.

    Raises:
        OSError: a folder cannot be read.
    """
    items, others, examples = [], Counter(), {}
    places: dict[Path, list[Item]] = {}
    for path in _files(folder, out.resolve()):
        name = path.relative_to(folder).as_posix()
        if name in RESERVED and (folder / Store.FOLDER).exists():
            continue  # of the run that wrote this folder
        if path.name.startswith(".") or not wanted(path):
            kind = "hidden" if path.name.startswith(".") else path.suffix.lower() or "no suffix"
            others[kind] += 1
            examples.setdefault(kind, name)
            continue
        try:
            found = path.stat()
        except OSError:  # a link to nothing: the reader says so, in a row of its own
            items.append(Item(name, path, 0, 0))
            continue
        item = Item(name, path, found.st_size, found.st_mtime_ns)
        places.setdefault(path.parent, []).append(item)
    for place, inner in places.items():
        alike = len(inner) > 1 and len({_unnumbered(item.path) for item in inner}) == 1
        if place != folder and alike and one([item.path for item in inner]):
            name = place.relative_to(folder).as_posix()
            size, modified = sum(i.size for i in inner), max(i.modified for i in inner)
            items.append(Item(name, place, size, modified))
        else:
            items += inner
    return Inventory(tuple(sorted(items)), dict(sorted(others.items())), examples)


def _unnumbered(path: Path) -> tuple[str, str]:
    """A file's name without the number at the end of its stem; of one without, all of it."""
    start = path.stem.rstrip("0123456789")
    return (start, path.suffix) if start != path.stem else (path.name, "")


def _files(folder: Path, out: Path) -> Iterator[Path]:
    def fail(error: OSError) -> None:
        raise type(error)(
            f"folder must be readable: got {error.filename!r} ({error.strerror})"
        ) from error

    seen = {folder.resolve()}
    for place, folders, files in os.walk(folder, followlinks=True, onerror=fail):
        kept = []
        for name in sorted(folders):
            inner = Path(place, name).resolve()
            if inner != out and inner not in seen and name != Store.FOLDER:
                seen.add(inner)
                kept.append(name)
        folders[:] = kept
        yield from (Path(place, name) for name in files)


class Shard(NamedTuple):
    """One of several parts of a data set, by a hash of the names: `number` from 0, of `count`."""

    number: int
    count: int

    def has(self, name: str) -> bool:
        """Whether a file is in this part."""
        digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()
        return int.from_bytes(digest[:8], "big") % self.count == self.number


def as_shard(shard: str | tuple[int, int] | None) -> Shard:
    """A part as users write it: "3/64", (3, 64), or None for all.

    Raises:
        ValueError: it is none.

    Example:
        >>> as_shard("0/2").has("walk.npz"), as_shard("1/2").has("walk.npz")
        (True, False)
    """
    if shard is None:
        return Shard(0, 1)
    try:
        number, count = (
            int(part) for part in (shard.split("/") if isinstance(shard, str) else shard)
        )
    except ValueError:
        number, count = 0, 0
    if not 0 <= number < count:
        raise ValueError(f"shard must be i/n with i from 0 to n - 1, such as 0/8: got {shard!r}.")
    return Shard(number, count)
