"""What may be set for the whole process: helper processes, and the cache of results."""

import os
from typing import Any, Literal

import numpy as np

_MOST_PROCESSES = 7  # not every core of a large machine: each takes 100 MB
_CACHE_BYTES = 64 << 20


class Config:
    """Settings of the process, read where they are used; `spt_jax.config` is the one object.

    Attributes:
        processes: how many helper processes may share a batch of meshes on the host: 0 (the
            default), a number, or "auto" for one less than there are cores, at most 7. Two cores
            then measure a batch 1.6 times as fast as one. They are started once batches have taken
            half a second, take 100 MB each (300 with a rest surface), and end with this process; a
            loss of one mesh at a time gains nothing from them.
        result_cache_bytes: how much memory the results of the last meshes may take, 64 MB by
            default; 0 keeps none. A solver under `vmap` asks for the same meshes over and over.

    The environment variables SPT_JAX_PROCESSES and SPT_JAX_RESULT_CACHE_BYTES set the same when
    spt_jax is imported. `spt_jax.clear_caches()` ends the processes and empties the cache.

    Example:
        >>> import spt_jax
        >>> spt_jax.config.processes
        0
        >>> spt_jax.config.result_cache_bytes >> 20
        64
        >>> spt_jax.config.processes = -1
        Traceback (most recent call last):
        ValueError: processes must be "auto" or a whole number, not negative: got -1.
    """

    def __init__(self):
        self.processes = _from_environment("SPT_JAX_PROCESSES", 0)
        self.result_cache_bytes = _from_environment("SPT_JAX_RESULT_CACHE_BYTES", _CACHE_BYTES)

    @property
    def processes(self) -> int | Literal["auto"]:
        """How many helper processes may share a batch of meshes."""
        return self._processes

    @processes.setter
    def processes(self, count: int | Literal["auto"]) -> None:
        if count != "auto" and not _is_count(count):
            raise ValueError(
                f'processes must be "auto" or a whole number, not negative: got {count!r}.'
            )
        self._processes: int | Literal["auto"] = count

    @property
    def result_cache_bytes(self) -> int:
        """How much memory the results of the last meshes may take."""
        return self._result_cache_bytes

    @result_cache_bytes.setter
    def result_cache_bytes(self, count: int) -> None:
        if not _is_count(count):
            raise ValueError(
                f"result_cache_bytes must be a whole number, not negative: got {count!r}."
            )
        self._result_cache_bytes = int(count)

    def most_processes(self, cores: int) -> int:
        """How many helper processes there may be on so many cores."""
        if self._processes == "auto":
            return min(cores - 1, _MOST_PROCESSES)
        return int(self._processes)

    def __repr__(self) -> str:
        return f"Config(processes={self.processes!r}, result_cache_bytes={self.result_cache_bytes})"


def _is_count(value: Any) -> bool:
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return bool(whole and value >= 0)


def _from_environment(name: str, default: int) -> Any:
    given = os.environ.get(name, "").strip()
    if not given or given == "auto":
        return given or default
    if not given.isdecimal():
        raise ValueError(f"the environment variable {name} must be a whole number: got {given!r}.")
    return int(given)


config = Config()
