"""Other processes that measure the meshes of a batch along with this one.

Threads do not help. Measuring one body makes about a thousand calls of NumPy on arrays that fit
the cache, 10 to 50 us each. Each gives Python's lock away and has to win it back, and between two
threads that hand-over costs as much as the call: for 30,000 elements, two threads that do nothing
but `np.add`, `take` or `bincount` are together 0.9 to 1.2 times as fast as one, and two threads
that measure bodies 0.8 to 1.1 times. Arrays ten times as large would hide it and miss the cache.
Processes share no lock. Whatever goes wrong with one, its work is done here.
"""

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np

from spt_jax.worker import Function, LostError, Mesh, Worker, can_start, packed

# Starting one takes a second of a core, and 190 MB while it is there: not before batches have
# taken as long, and not for every core of a large machine.
_WORTH_STARTING = 1.0
_MOST_WORKERS = 7

# Triangles in a batch for it to be shared: handing a mesh over costs as much as some 500.
_WORTH_SHARING = 10_000

# Triangles of one mesh for it to be measured elsewhere.
_WORTH_ASKING = 2_000

# A worker that answers later than this is lost: seconds, and microseconds for each triangle, a
# hundred times what is usual. After so many losses there are no more workers.
_PATIENCE = 20.0, 100.0
_MOST_LOSSES = 3


class Workers:
    """The workers of this process, started when batches have been worth it."""

    def __init__(self):
        self._lock = threading.Lock()
        self._free: list[Worker] = []
        self._number = 0
        self._losses = 0
        self._spent = 0.0
        self._at_work = 0

    def measure_one(self, function: Function, options: Hashable, mesh: Mesh) -> tuple[Any, ...]:
        """The function of one mesh: here, or elsewhere while another thread measures here."""
        with self._lock:
            alone = self._at_work == 0
            self._at_work += 1
        begin = time.perf_counter()
        try:
            size = len(mesh[1])
            work = packed(function, options) if not alone and size > _WORTH_ASKING else None
            if work is not None:
                patience = _PATIENCE[0] + 1e-6 * _PATIENCE[1] * size
                for worker in self._ready(work, 1):
                    try:
                        found = worker.measure(work, mesh, patience)
                    except LostError:
                        self._drop(worker)
                    else:
                        self._release(worker)
                        return found
            return function(*mesh, options)
        finally:
            with self._lock:
                self._at_work -= 1
                if not alone:
                    self._spent += time.perf_counter() - begin

    def measure(
        self,
        function: Function,
        options: Hashable,
        meshes: Sequence[Mesh],
        executor: Callable[[], Executor],
    ) -> list[tuple[np.ndarray, ...]]:
        """The function of every mesh, in their order, whoever measured it."""
        found: list[Any] = [None] * len(meshes)
        left = deque(range(len(meshes)))
        lost: list[int] = []
        shares = []

        def taken() -> Iterator[int]:
            while True:
                try:
                    i = left.popleft()
                except IndexError:
                    return
                yield i

        def share(worker: Worker, work: bytes, seconds: float) -> None:
            try:
                for i in taken():
                    lost.append(i)
                    found[i] = worker.measure(work, meshes[i], seconds)
                    lost.remove(i)
            except LostError:
                self._drop(worker)
            else:
                self._release(worker)

        begin = time.perf_counter()
        size = sum(len(faces) for _, faces in meshes)
        work = packed(function, options) if size > _WORTH_SHARING else None
        patience = _PATIENCE[0] + 1e-6 * _PATIENCE[1] * size
        try:
            if work is not None:
                for worker in self._ready(work, len(meshes) - 1):
                    try:
                        shares.append(executor().submit(share, worker, work, patience))
                    except RuntimeError:  # the interpreter is leaving and takes no more work
                        self._release(worker)
            for i in taken():
                found[i] = function(*meshes[i], options)
        finally:
            left.clear()
            for ended in shares:
                ended.result()
            self._spent += time.perf_counter() - begin
        for i in lost:
            found[i] = function(*meshes[i], options)
        return found

    def close(self) -> None:
        """End all that are free, and start no more."""
        with self._lock:
            workers, self._free = self._free, []
            self._losses = _MOST_LOSSES
        for worker in workers:
            worker.close()

    def leave_to_parent(self) -> None:
        """In a forked child: begin anew."""
        for worker in self._free:
            worker.leave_to_parent()
        self.__init__()

    def _ready(self, work: bytes, most: int) -> list[Worker]:
        with self._lock:
            self._start()
            free, self._free = self._free, []
        ready = []
        for worker in free:
            try:
                if len(ready) < most and worker.is_ready(work):
                    ready.append(worker)
                else:
                    self._release(worker)
            except LostError:
                self._drop(worker)
        return ready

    def _start(self) -> None:
        most = min(usable_cores() - 1, _MOST_WORKERS)
        if self._spent < _WORTH_STARTING or self._losses >= _MOST_LOSSES or not can_start():
            return
        while self._number < most:
            try:
                self._free.append(Worker())
            except (OSError, LostError):
                self._losses = _MOST_LOSSES
                return
            self._number += 1

    def _release(self, worker: Worker) -> None:
        with self._lock:
            self._free.append(worker)

    def _drop(self, worker: Worker) -> None:
        worker.close()
        with self._lock:
            self._number -= 1
            self._losses += 1


def usable_cores() -> int:
    """How many cores this process may use."""
    # The affinity, not the machine: containers and job schedulers hand out fewer cores.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
