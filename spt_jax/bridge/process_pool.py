"""Other processes that measure the meshes of a batch along with this one.

Threads do not help. Measuring one body makes about a thousand calls of NumPy on arrays that fit
the cache, 10 to 50 us each. Each gives Python's lock away and has to win it back, and between two
threads that hand-over costs as much as the call: for 30,000 elements, two threads that do nothing
but `np.add`, `take` or `bincount` are together 0.9 to 1.2 times as fast as one, and two threads
that measure bodies 0.8 to 1.1 times. Arrays ten times as large would hide it and miss the cache.
Processes share no lock.

Whatever goes wrong with one, its work is done here: at once where it is gone or could not, and
otherwise when it takes much longer than such work usually does, be it stopped, starved or slow.
"""

import itertools
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import numpy as np

from spt_jax._settings import config
from spt_jax.bridge.worker import Function, LateError, LostError, Mesh, Worker, can_start, packed

# Starting one takes a quarter of a second of a core, and 100 MB while it is there: not before
# batches have taken longer.
_WORTH_STARTING = 0.5

# Triangles in a batch for it to be shared: handing a mesh over costs as much as some 500.
_WORTH_SHARING = 10_000

# Triangles of one mesh for it to be measured elsewhere.
_WORTH_ASKING = 2_000

# How long a worker may take for a mesh: seconds, and times what it usually takes. Before anything
# is known of it, seconds a triangle: a hundred times what a body takes.
_PATIENCE = 0.1, 8.0
_FIRST_GUESS = 1e-4

# After so many losses within so many seconds there are no more workers, until they are past.
_MOST_LOSSES, _LOSSES_COUNT = 3, 600.0


class Pace:
    """How long work usually takes: seconds a triangle, for the last kinds of it."""

    def __init__(self, kinds: int = 16):
        self._kinds = kinds
        self._lock = threading.Lock()
        self._usual: OrderedDict[bytes, float] = OrderedDict()

    def note(self, work: bytes, size: int, seconds: float) -> None:
        """Learn from one mesh of so many triangles."""
        found = seconds / max(size, 1)
        with self._lock:
            usual = self._usual.get(work, found)
            # One that took very long says little of what is usual.
            self._usual[work] = usual + 0.2 * (min(found, 4 * usual) - usual)
            self._usual.move_to_end(work)
            while len(self._usual) > self._kinds:
                self._usual.popitem(last=False)

    def patience(self, work: bytes, size: int) -> float:
        """Seconds after which it is done elsewhere."""
        with self._lock:
            usual = self._usual.get(work, _FIRST_GUESS)
        return _PATIENCE[0] + _PATIENCE[1] * usual * max(size, 1)


class Workers:
    """The workers of this process: as many as `config` allows, once batches are worth it."""

    def __init__(self):
        self._lock = threading.Lock()
        self._free: list[Worker] = []
        self._number = 0
        self._losses: deque[float] = deque(maxlen=_MOST_LOSSES)
        self._closed = False
        self._pace = Pace()
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
            if work is None:
                return function(*mesh, options)
            for worker in self._ready(work, 1):
                with self._lent(worker):
                    return self._elsewhere(worker, work, mesh)
            return self._here(function, options, mesh, work)
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
        lost: list[int] = []
        shares = []
        turns: list[deque[int]] = []

        def taken(own: deque[int]) -> Iterator[int]:
            """Its own in their order; then the last ones of whoever has most left."""
            while True:
                try:
                    yield own.popleft() if own else max(turns, key=len).pop()
                except IndexError:
                    if not any(turns):
                        return

        def share(worker: Worker, work: bytes, own: deque[int]) -> None:
            with self._lent(worker):
                for i in taken(own):
                    lost.append(i)
                    found[i] = self._elsewhere(worker, work, meshes[i])
                    lost.remove(i)

        begin = time.perf_counter()
        size = sum(len(faces) for _, faces in meshes)
        work = packed(function, options) if size > _WORTH_SHARING else None
        workers = [] if work is None else self._ready(work, len(meshes) - 1)
        # Each process has the same meshes in every call, which it knows from the last one: those of
        # a batch that moves a little (`overlap/triangles/warm_pairs.py`).
        workers.sort(key=lambda worker: worker.number)
        bounds = np.linspace(0, len(meshes), len(workers) + 2).astype(int).tolist()
        turns += [deque(range(*ends)) for ends in itertools.pairwise(bounds)]
        try:
            for worker, own in zip(workers, turns[1:], strict=True):
                if work is None:
                    break
                try:
                    shares.append(executor().submit(share, worker, work, own))
                except RuntimeError:  # the interpreter is leaving and takes no more work
                    self._release(worker)
            for i in taken(turns[0]):
                found[i] = self._here(function, options, meshes[i], work)
        finally:
            for own in turns:
                own.clear()
            for ended in shares:
                ended.result()
            self._spent += time.perf_counter() - begin
        for i in lost:
            found[i] = function(*meshes[i], options)
        return found

    def release(self) -> None:
        """End all that are free; batches that are worth it start others."""
        with self._lock:
            workers, self._free = self._free, []
            self._number -= len(workers)
            self._spent = 0.0
        for worker in workers:
            worker.close()

    def close(self) -> None:
        """End all that are free, and start no more."""
        self._closed = True
        self.release()

    def leave_to_parent(self) -> None:
        """In a forked child: begin anew."""
        for worker in self._free:
            worker.leave_to_parent()
        self.__init__()

    @contextmanager
    def _lent(self, worker: Worker) -> Iterator[None]:
        """A worker, which is given back unless it is lost; what it did not do is done here."""
        try:
            yield
        except LostError:
            self._drop(worker)
        except LateError:
            self._release(worker)
        else:
            self._release(worker)

    def _elsewhere(self, worker: Worker, work: bytes, mesh: Mesh) -> tuple[np.ndarray, ...]:
        size, begin = len(mesh[1]), time.perf_counter()
        found = worker.measure(work, mesh, self._pace.patience(work, size))
        self._pace.note(work, size, time.perf_counter() - begin)
        return found

    def _here(
        self, function: Function, options: Hashable, mesh: Mesh, work: bytes | None
    ) -> tuple[np.ndarray, ...]:
        begin = time.perf_counter()
        found = function(*mesh, options)
        if work is not None:
            self._pace.note(work, len(mesh[1]), time.perf_counter() - begin)
        return found

    def _ready(self, work: bytes, most: int) -> list[Worker]:
        most = min(most, config.most_processes(usable_cores()))
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
        most = config.most_processes(usable_cores())
        if self._closed or self._spent < _WORTH_STARTING or not can_start():
            return
        if len(self._losses) == _MOST_LOSSES:
            if time.monotonic() - self._losses[0] < _LOSSES_COUNT:
                return
            self._losses.clear()
        while self._number < most:
            try:
                self._free.append(Worker())
            except OSError:
                self._losses.append(time.monotonic())
                return
            self._number += 1

    def _release(self, worker: Worker) -> None:
        with self._lock:
            self._free.append(worker)

    def _drop(self, worker: Worker) -> None:
        worker.close()
        with self._lock:
            self._number -= 1
            self._losses.append(time.monotonic())


def usable_cores() -> int:
    """How many cores this process may use."""
    # The affinity, not the machine: containers and job schedulers hand out fewer cores.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
