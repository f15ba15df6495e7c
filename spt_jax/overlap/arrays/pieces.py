"""Work in pieces of bounded size, so that the memory it takes does not grow with the mesh."""

from collections.abc import Iterable, Iterator

import numpy as np

# Candidates handled at once: bounds the memory for any mesh. A posed body's pairs take 5.0 ms with
# this many, 5.5 with 50,000 and 9 with 2^14; with 2^17, whose arrays of 1 MiB the allocator may
# give back to the system each time, up to 9.8.
_CHUNK = 96 << 10


def parts_of_size(found: Iterable[tuple[np.ndarray, np.ndarray]]):
    """The same pairs in fewer parts, of bounded size."""
    waiting, size = [], 0
    for t, u in found:
        waiting.append((t, u))
        size += len(t)
        if size > _CHUNK:
            yield concatenate(waiting)
            waiting, size = [], 0
    if waiting:
        yield concatenate(waiting)


def concatenate(pairs):
    """Join many tuples of arrays into one."""
    return tuple(np.concatenate(part) for part in zip(*pairs, strict=True))


def pieces(count: int, size: int) -> Iterator[slice]:
    """Slices of `count` items, each of which counts `size` times, of about `_CHUNK` in all."""
    step = max(_CHUNK // size, 1)
    for begin in range(0, count, step):
        yield slice(begin, min(begin + step, count))


def parts(count) -> Iterator[slice]:
    """Slices of the items, such that each slice's counts add up to about `_CHUNK` at most."""
    total = np.cumsum(count)
    begin, done = 0, 0
    while begin < len(total):
        end = max(begin + 1, int(np.searchsorted(total, done + _CHUNK, side="right")))
        yield slice(begin, end)
        begin, done = end, int(total[end - 1])
