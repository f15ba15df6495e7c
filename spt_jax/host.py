"""The way from XLA to NumPy and back: the only `pure_callback` of the package.

Four traps shape this file:

- On CPU a callback gets its operands as `jax.Array`s, and one above about 100 kB is copied on the
  thread pool that is waiting for the callback: the program hangs
  (https://github.com/jax-ml/jax/issues/24255, https://github.com/jax-ml/jax/issues/25861).
  So arrays travel as pieces of at most 96 kB and are joined here, and a batching rule of our own
  cuts them again where `vmap` would have made every piece larger.
- The callback runs on another thread, where `with jax.enable_x64(True)` of the caller does not
  hold: a float64 array would be rounded or refused there. So 8-byte numbers travel as pairs of
  uint32, both ways.
- Raising inside a callback is undefined behaviour: what can be wrong in the values comes back as
  NaN, everything else is refused while tracing.
- The callback has no derivative. `stop_gradient` on its operands keeps outer transformations
  (Hessian-vector products, implicit differentiation) from asking for one.
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
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Integer

from spt_jax.many_meshes import as_more_meshes, over_batch
from spt_jax.recent import Recent
from spt_jax.workers import Workers, usable_cores

_PIECE_BYTES = 96 * 1024

# function(vertices, faces, options) -> one array per result; NumPy alone, never raises.
HostFunction = Callable[[np.ndarray, np.ndarray, Any], tuple[np.ndarray, ...]]
# Shape of a result for one mesh, and its dtype's name.
ResultSpec = tuple[tuple[int, ...], str]


def call_on_host(
    function: HostFunction,
    options: Hashable,
    results: tuple[ResultSpec, ...],
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
) -> tuple[Array, ...]:
    """Run a NumPy function once per mesh of the batch, in as many processes as there are cores.

    Results of the last meshes are remembered, in 64 MB: a mesh that comes again is not measured
    again, and neither are equal meshes of one batch.

    Args:
        function: a module-level function, pure; its identity is part of the cache key, so a lambda
            made anew for each call would be traced anew for each call.
        options: handed on as they are.
        results: for each result, its shape for one mesh and its dtype. Where nothing can be
            measured, numbers come back as NaN and arrays as zeros.
        vertices: any number of leading batch axes.
        faces: shared by the batch; under `vmap` they may be batched too.

    Differentiation: none; all derivatives through the result are zero.
    """
    return over_batch(_bridge(function, options, results), vertices, faces)


@functools.cache
def _bridge(function: HostFunction, options: Hashable, results: tuple[ResultSpec, ...]):
    @as_more_meshes
    def bridge(vertices, faces):
        num_meshes = vertices.shape[0]
        mesh = (vertices.shape, vertices.dtype.name), (faces.shape, faces.dtype.name)
        host = _host_entry(function, options, results, *mesh)
        shapes = tuple(_words((num_meshes, *shape), dtype) for shape, dtype in results)
        words = jax.pure_callback(host, shapes, _pieces(vertices), _pieces(faces))
        return tuple(
            jax.lax.bitcast_convert_type(word, dtype)
            for word, (_, dtype) in zip(words, results, strict=True)
        )

    return bridge


def _words(shape: tuple[int, ...], dtype: str) -> jax.ShapeDtypeStruct:
    if np.dtype(dtype).itemsize == 8:
        return jax.ShapeDtypeStruct((*shape, 2), "uint32")
    return jax.ShapeDtypeStruct(shape, dtype)


def _pieces(array: Array) -> tuple[Array, ...]:
    flat = array.reshape(-1)
    if flat.dtype.itemsize == 8:
        flat = jax.lax.bitcast_convert_type(flat, "uint32").reshape(-1)
    step = _PIECE_BYTES // flat.dtype.itemsize
    return tuple(flat[start : start + step] for start in range(0, flat.size, step))


@functools.cache
def _host_entry(function, options, results, vertices_spec, faces_spec):
    """The callback itself, the same object for the same work so that XLA's caches are hit."""

    num_meshes = vertices_spec[0][0]

    def run_on_host(vertex_pieces, face_pieces):
        with _traffic, np.errstate(all="ignore"):
            try:
                if not _traffic.leaving:
                    return measured(vertex_pieces, face_pieces)
            except MemoryError:
                pass  # too many rays for this machine: as unusable as NaN vertices
            nothing = [
                np.full((num_meshes, *shape), 0.0 if shape else np.nan) for shape, _ in results
            ]
            return _as_words(nothing, results)

    def measured(vertex_pieces, face_pieces):
        vertices = _join(vertex_pieces, *vertices_spec)
        faces = [_recent.faces(one) for one in _join(face_pieces, *faces_spec)]
        meshes = list(zip(vertices, itertools.cycle(faces), strict=False))
        found = _recent.results((function, options, results), meshes, measured_anew)
        stacked = [
            np.array([one[k] for one in found], dtype).reshape(num_meshes, *shape)
            for k, (shape, dtype) in enumerate(results)
        ]
        return _as_words(stacked, results)

    def measured_anew(meshes):
        meshes = [(vertices.astype(np.float64), faces) for vertices, faces in meshes]
        if len(meshes) == 1:
            found = [_workers.measure_one(function, options, meshes[0])]
        else:
            found = _workers.measure(function, options, meshes, _executor)
        return [
            tuple(
                np.asarray(array).reshape(shape).astype(dtype)
                for array, (shape, dtype) in zip(one, results, strict=True)
            )
            for one in found
        ]

    return run_on_host


def _as_words(arrays, results: tuple[ResultSpec, ...]) -> tuple[np.ndarray, ...]:
    return tuple(
        array.astype(dtype).reshape(-1).view(words.dtype).reshape(words.shape)
        for array, (_, dtype) in zip(arrays, results, strict=True)
        for words in [_words(array.shape, dtype)]
    )


def _join(pieces, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    # jax.Array -> NumPy by np.asarray alone: any other use of jax here may wait for the thread
    # that waits for us.
    arrays = [np.asarray(piece) for piece in pieces]
    joined = np.concatenate(arrays) if arrays else np.zeros(0, dtype)
    return joined.view(dtype).reshape(shape)


@functools.cache
def _executor() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(usable_cores(), thread_name_prefix="spt_jax")


_recent = Recent()
_workers = Workers()


def forget() -> None:
    """Forget what was measured, for those who time it."""
    _recent.forget()


def _begin_anew() -> None:
    global _recent
    # A forked child inherits the executor but not its threads, and locks as they are.
    _executor.cache_clear()
    _recent = Recent()
    _workers.leave_to_parent()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


class _Traffic:
    """Counts the callbacks under way, so that the interpreter does not leave under them."""

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
        """Whether any callback ever ran."""
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
