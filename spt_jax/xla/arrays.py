"""Lists of unknown length in arrays of a fixed one."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int


def cumulative_sum(numbers: Int[Array, "N"]) -> Int[Array, "N"]:
    """As `jnp.cumsum`, without its tree of additions on a CPU.

    There 262,144 numbers take 1.0 ms for its 4.3.
    """
    return jax.lax.platform_dependent(numbers, cpu=_by_rows, default=jnp.cumsum)


def _by_rows(numbers):
    length = int(np.ceil(np.sqrt(len(numbers))))
    columns = jnp.pad(numbers, (0, -len(numbers) % length)).reshape(-1, length).T

    def add(total, row):
        return total + row, total + row

    # All columns at once, row by row; then what is in the columns before.
    total, sums = jax.lax.scan(add, jnp.zeros_like(columns[0]), columns)
    index = np.arange(len(total))
    before = jnp.where(index[None, :] < index[:, None], total[None, :], 0)
    sums = sums + before.sum(axis=1, dtype=numbers.dtype)[None, :]
    return sums.T.reshape(-1)[: len(numbers)]


def take(table: Array, index: Int[Array, "..."]) -> Array:
    """As `table[index]` for an index that is in range; others are clipped.

    Without this a gather looks for negative indices first, and whether any is out of range.
    """
    return table.at[index].get(mode="clip", wrap_negative_indices=False)


def indices(mask: Bool[Array, "N"], size: int) -> Int[Array, "M"]:
    """Where the mask is true, in `size` places; N at those that are left."""
    place = jnp.where(mask, cumulative_sum(mask.astype(jnp.int32)) - 1, size)
    index = jnp.arange(len(mask), dtype=jnp.int32)
    return (
        jnp.full(size, len(mask), jnp.int32)
        .at[place]
        .set(index, mode="drop", wrap_negative_indices=False)
    )


def expand(
    count: Int[Array, "F"], size: int, skipped: Int[Array, ""] | int = 0
) -> tuple[Int[Array, "N"], Int[Array, "N"], Bool[Array, "N"]]:
    """Repeat every index `count` times, into `size` places, leaving out the first `skipped`.

    Returns:
        The index at each place, how many places of the same index are before it, and which places
        are used; the others hold an index all the same.
    """
    end = cumulative_sum(count) - skipped
    start = end - count
    # Indices of no places add to the same mark as the next, so that the sum skips them.
    marks = (
        jnp.zeros(size, jnp.int32)
        .at[jnp.maximum(start, 0)]
        .add(1, mode="drop", wrap_negative_indices=False)
    )
    index = cumulative_sum(marks) - 1
    place = jnp.arange(size, dtype=jnp.int32)
    return index, place - take(start, index), place < end[-1]


def last_within(total: Int[Array, "R"], begin: Int[Array, ""], most: int) -> Int[Array, ""]:
    """The last index, after `begin`, up to which a cumulative sum grows by at most `most`.

    At least the next one. The sum may wrap around, as long as one step and `most` together do not.
    """
    index = jnp.arange(len(total), dtype=jnp.int32)
    beyond = (index > begin) & (total - total[begin] > most)
    last = jnp.where(beyond.any(), jnp.argmax(beyond).astype(jnp.int32), len(total)) - 1
    return jnp.maximum(last, begin + 1)
