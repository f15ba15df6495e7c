"""The price of the NumPy calls that the host path is made of: `python -m benchmarks.calls`.

Nanoseconds a number, on arrays as long as those of one band of rows, and the same work twice where
one way was chosen for another.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section

# Numbers in an array of one band: spans and crossings are some ten thousand each.
COUNT = 12_000
TABLE = 3_000


@dataclass
class Settings:
    """How often each call is repeated."""

    repeats: int = 2000
    record: bool = False
    """Write the table into results.md."""


def calls() -> dict[str, Callable[[], Any]]:
    """Each call by what it does."""
    rng = np.random.default_rng(0)
    count = rng.multinomial(COUNT, np.ones(TABLE) / TABLE)
    index = np.repeat(np.arange(TABLE), count)
    real, number = rng.random(TABLE), rng.random(COUNT)
    pair = real + 1j * real
    index_32, real_32 = index.astype(np.int32), real.astype(np.float32)
    pixel = rng.integers(0, 2 * COUNT, COUNT)
    keys = rng.integers(0, 2**62, COUNT).astype(np.uint64)
    points = rng.random((COUNT, 3))
    written = np.zeros(2 * COUNT)
    flags = number > 0.7

    def write():
        written[pixel] = number

    def both():
        return real.take(index), real.take(index)

    return {
        "product": lambda: number * number,
        "repeat of row numbers": lambda: np.repeat(np.arange(TABLE), count),
        "take": lambda: real.take(index),
        "take through an index of 32 bits": lambda: real.take(index_32),
        "take of 32 bits": lambda: real_32.take(index),
        "two takes with one index": both,
        "one take of complex numbers": lambda: pair.take(index),
        "cumulative sum": lambda: np.cumsum(number),
        "written through an index": write,
        "bincount": lambda: np.bincount(pixel, minlength=2 * COUNT),
        "bincount, weighted": lambda: np.bincount(pixel, number, 2 * COUNT),
        "flatnonzero": lambda: np.flatnonzero(flags),
        "sort of uint64": lambda: np.sort(keys),
        "extent of (N, 3), along N": lambda: np.ptp(points, axis=0),
        "the same of its transposed copy": lambda: np.ptp(points.T.copy(), axis=1),
    }


def main(settings: Settings) -> None:
    """Time them turn about in ten rounds; the least of the rounds is printed."""
    named = calls()
    least = dict.fromkeys(named, np.inf)
    rounds = 10
    with progress() as bar:
        task = bar.add_task("calls", total=rounds * len(named))
        for _ in range(rounds):
            for name, call in named.items():
                start = time.perf_counter()
                for _ in range(settings.repeats // rounds):
                    call()
                taken = (time.perf_counter() - start) / (settings.repeats // rounds)
                least[name] = min(least[name], 1e9 * taken / COUNT)
                bar.advance(task)
    table = Table(
        f"Nanoseconds a number, arrays of {COUNT:,}",
        ("call", "ns"),
        [(name, f"{value:.2f}") for name, value in least.items()],
    )
    table.print()
    if settings.record:
        command = f"python -m benchmarks.calls --repeats {settings.repeats} --record"
        body = f"{provenance(command)}\n\n{table.markdown()}"
        record_section("calls", "The price of NumPy's calls", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
