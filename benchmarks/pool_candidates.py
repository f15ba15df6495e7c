"""Pools of processes behind one face, for `benchmarks.pools`: ours, loky's, and Python's own.

The libraries' pools are used as ours is: the caller measures along, a thread hands one mesh after
another to the worker, and what that does not answer in time is done by the caller. Only public
functions of theirs are called. This module imports no JAX, because the workers import it.
"""

import functools
import multiprocessing
import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any, Protocol

from spt_jax import config
from spt_jax.bridge import process_pool
from spt_jax.bridge.worker import Function, Mesh, packed
from spt_jax.overlap.host_functions import PenaltyOptions

# What `bridge/worker.py` gives its workers.
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}


class Candidate(Protocol):
    """A pool of one worker beside the caller."""

    @property
    def answered(self) -> int:
        """How many meshes the worker has measured."""
        ...

    def measure(
        self, function: Function, options: PenaltyOptions, meshes: Sequence[Mesh]
    ) -> list[Any]:
        """The function of every mesh, whoever measured it."""
        ...

    def pid(self) -> int:
        """The process that measures, when it is ready."""
        ...

    def leave_to_parent(self) -> None:
        """In a forked child: begin anew."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class _Counted(process_pool.Workers):
    """`spt_jax.bridge.process_pool`, which counts what its worker measures."""

    answered = 0

    def _elsewhere(self, worker, work, mesh):
        found = super()._elsewhere(worker, work, mesh)
        self.answered += 1
        return found


class Ours:
    """`spt_jax.bridge.process_pool`, without its thresholds."""

    def __init__(self):
        config.processes = 1
        process_pool._WORTH_STARTING, process_pool._WORTH_SHARING = 0.0, 0
        self._pool = _Counted()
        self._threads = ThreadPoolExecutor(1)

    @property
    def answered(self) -> int:
        return self._pool.answered

    def measure(
        self, function: Function, options: PenaltyOptions, meshes: Sequence[Mesh]
    ) -> list[Any]:
        return self._pool.measure(function, options, meshes, lambda: self._threads)

    def pid(self) -> int:
        (worker,) = self._pool._free
        return worker._process.pid

    def leave_to_parent(self) -> None:
        self._threads = ThreadPoolExecutor(1)
        self._pool.leave_to_parent()

    def close(self) -> None:
        self._pool.close()


class OverExecutor:
    """A pool of `concurrent.futures`' kind."""

    def __init__(self, start: Callable[[], Executor], end: Callable[[Any], None]):
        self._start, self._end = start, end
        self._executor: Executor | None = None
        self._awaited: Future[Any] | None = None
        self._pace = process_pool.Pace()
        self._threads = ThreadPoolExecutor(1)
        self.answered = 0

    def measure(
        self, function: Function, options: PenaltyOptions, meshes: Sequence[Mesh]
    ) -> list[Any]:
        found: list[Any] = [None] * len(meshes)
        left, lost = deque(range(len(meshes))), []
        work = packed(function, options)
        assert work is not None

        def taken() -> Iterator[int]:
            while left:
                try:
                    yield left.popleft()
                except IndexError:
                    return

        def share() -> None:
            for i in taken():
                lost.append(i)
                begin, size = time.perf_counter(), len(meshes[i][1])
                try:
                    assert self._executor is not None
                    self._awaited = self._executor.submit(measured, work, *meshes[i])
                    found[i] = self._awaited.result(self._pace.patience(work, size))
                except TimeoutError:
                    return
                except Exception:  # the pool is broken, or the worker could not
                    self.close()
                    return
                self._awaited = None
                self._pace.note(work, size, time.perf_counter() - begin)
                self.answered += 1
                lost.remove(i)

        shared = self._threads.submit(share) if self._is_ready() else None
        for i in taken():
            begin = time.perf_counter()
            found[i] = function(*meshes[i], options)
            self._pace.note(work, len(meshes[i][1]), time.perf_counter() - begin)
        if shared:
            shared.result()
        for i in lost:
            found[i] = function(*meshes[i], options)
        return found

    def _is_ready(self) -> bool:
        if self._executor is None:
            self._executor = self._start()
            self._awaited = self._executor.submit(os.getpid)
        if self._awaited is None:
            return True
        if not self._awaited.done():
            return False
        broken = self._awaited.exception() is not None
        self._awaited = None
        if broken:
            self.close()
        return not broken

    def pid(self) -> int:
        assert self._executor is not None
        return self._executor.submit(os.getpid).result(60.0)

    def leave_to_parent(self) -> None:
        """In a forked child: begin anew, without a word to the parent's worker."""
        self.__init__(self._start, self._end)

    def close(self) -> None:
        executor, self._executor, self._awaited = self._executor, None, None
        if executor is not None:
            self._end(executor)


@functools.lru_cache(maxsize=8)
def _unpacked(work: bytes) -> tuple[Function, PenaltyOptions]:
    return pickle.loads(work)


def measured(work: bytes, *mesh: Any) -> Any:
    """What a worker of a library's pool does."""
    function, options = _unpacked(work)
    return function(*mesh, options)


def _loky() -> OverExecutor:
    import loky

    return OverExecutor(
        lambda: loky.get_reusable_executor(1, timeout=None, env=ENVIRONMENT, reuse=False),
        lambda executor: executor.shutdown(kill_workers=True),
    )


def _spawned() -> OverExecutor:
    # It takes no environment; to set this process' own would not be a library's to do.
    return OverExecutor(
        lambda: ProcessPoolExecutor(1, multiprocessing.get_context("spawn")),
        lambda executor: executor.shutdown(wait=False, cancel_futures=True),
    )


CANDIDATES: dict[str, Callable[[], Candidate]] = {
    "ours": Ours,
    "loky": _loky,
    "concurrent.futures, spawn": _spawned,
}
