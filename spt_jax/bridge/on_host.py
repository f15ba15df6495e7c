"""What the host does with meshes that are handed to it: NumPy alone, one result a mesh.

Results of the last meshes are remembered (`result_cache.py`), other processes help with batches
(`process_pool.py`), and the interpreter does not leave while a callback is under way.
"""

import atexit
import functools
import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from spt_jax.bridge.process_pool import Workers, usable_cores
from spt_jax.bridge.result_cache import ResultCache

# function(vertices, faces, options) -> one array per result; NumPy alone, never raises.
HostFunction = Callable[[np.ndarray, np.ndarray, Any], tuple[np.ndarray, ...]]
# Shape of a result for one mesh, and its dtype's name.
ResultSpec = tuple[tuple[int, ...], str]


class Work(NamedTuple):
    """What is done with each mesh.

    Attributes:
        function: a module-level function, pure.
        options: handed on as they are.
        results: shapes and dtypes of what it returns.
    """

    function: HostFunction
    options: Hashable
    results: tuple[ResultSpec, ...]


def measured(work: Work, vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """The results for a list of meshes, stacked.

    Args:
        work: what is asked.
        vertices: (N, V, 3). Neither they nor the faces are kept or written to.
        faces: (1, F, 3) or (N, F, 3).

    Returns:
        Fresh arrays (N, ...). Where memory does not suffice, or the interpreter is leaving, numbers
        are NaN and arrays zero.
    """
    with _traffic, np.errstate(all="ignore"):
        try:
            if not _traffic.leaving:
                return _stacked(work, vertices, faces)
        except MemoryError:
            pass  # too many rays for this machine: as unusable as NaN vertices
        return [
            np.full((len(vertices), *shape), 0.0 if shape else np.nan).astype(dtype)
            for shape, dtype in work.results
        ]


def _stacked(work: Work, vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    known = [_result_cache.faces(one) for one in faces]
    meshes = list(zip(map(_as_xla_has_them, vertices), itertools.cycle(known), strict=False))
    found = _result_cache.results(work, meshes, functools.partial(_measured_anew, work))
    return [
        np.array([one[k] for one in found], dtype).reshape(len(vertices), *shape)
        for k, (shape, dtype) in enumerate(work.results)
    ]


def _as_xla_has_them(vertices: np.ndarray) -> np.ndarray:
    """The vertices; zeros where all are smaller than XLA's arithmetic leaves them."""
    largest = np.abs(vertices).max(initial=0.0)
    return np.zeros_like(vertices) if 0 < largest < np.finfo(vertices.dtype).tiny else vertices


def _measured_anew(work: Work, meshes: list[tuple[np.ndarray, np.ndarray]]):
    meshes = [(vertices.astype(np.float64), faces) for vertices, faces in meshes]
    if len(meshes) == 1:
        found = [_workers.measure_one(work.function, work.options, meshes[0])]
    else:
        found = _workers.measure(work.function, work.options, meshes, executor)
    return [
        tuple(
            np.asarray(array).reshape(shape).astype(dtype)
            for array, (shape, dtype) in zip(one, work.results, strict=True)
        )
        for one in found
    ]


@functools.cache
def executor() -> ThreadPoolExecutor:
    """The threads that talk to other processes."""
    return ThreadPoolExecutor(usable_cores(), thread_name_prefix="spt_jax")


_result_cache = ResultCache()
_workers = Workers()


def clear_results() -> None:
    """Drop the cached results."""
    _result_cache.clear()


def release() -> None:
    """Release everything that is kept between calls: results, other processes and threads."""
    _result_cache.clear_all()
    _workers.release()


def _begin_anew() -> None:
    global _result_cache
    # A forked child inherits the executor but not its threads, and locks as they are.
    executor.cache_clear()
    _result_cache = ResultCache()
    _workers.leave_to_parent()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


class _Traffic:
    """Counts the calls under way, so that the interpreter does not leave under them."""

    def __init__(self):
        self.leaving = False
        self._lock = threading.Lock()
        self._under_way = 0
        self._last_end = -math.inf

    def __enter__(self):
        with self._lock:
            self._under_way += 1

    def __exit__(self, *_):
        with self._lock:
            self._under_way -= 1
            self._last_end = time.monotonic()

    def has_been(self) -> bool:
        """Whether any call ever ran."""
        with self._lock:
            return self._under_way > 0 or self._last_end > -math.inf

    def is_quiet(self) -> bool:
        """Whether none is running, nor likely to follow."""
        # A solver asks again within milliseconds; a pause this long means that none is running,
        # even where others keep the cores busy.
        with self._lock:
            return self._under_way == 0 and time.monotonic() - self._last_end > 0.3


_traffic = _Traffic()


@atexit.register
def _finish_pending_work() -> None:
    """Let work that nobody waited for end before the interpreter goes.

    A callback that asks for Python's lock while the interpreter finalises kills the process: a
    script whose last line computes a penalty and reads nothing is enough, or Ctrl-C in a solve.
    What is under way gets two seconds; then callbacks answer NaN at once, which ends a solver's
    loop or at least makes its steps cheap.
    """
    if not _traffic.has_been():
        return
    try:
        _wait_for_quiet()
    finally:
        _workers.close()


def _wait_for_quiet() -> None:
    for leaving, seconds in ((False, 2.0), (True, 5.0)):
        _traffic.leaving = leaving
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            arrays = jax.live_arrays("cpu")
            if _traffic.is_quiet() and all(x.is_deleted() or x.is_ready() for x in arrays):
                return
            threading.Event().wait(0.005)
