"""Processes of this machine: each takes the next file until there is none left."""

import json
import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

from spt_jax.datasets.engines.events import Finished, Progress, StartError
from spt_jax.datasets.engines.messages import receive, send
from spt_jax.datasets.items.inventory import Item
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.items.work import RoomError, Task, lost, work

# How often a file is given to another process after one has ended at it.
_TRIES = 3

# As much as is read of what a process that ended has said.
_LAST_WORDS = 2000

_BOOT = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from spt_jax.datasets.engines.worker import serve
serve()
"""

# A process is to take one core, where all are taken by others of its kind: without these, two of
# them are slower than one, because each starts threads for every core. glibc's allocator keeps what
# it has (see `spt_jax.bridge.worker`).
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "SPT_JAX_PROCESSES": "0",
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}


def local(
    store: Store, task: Task, items: Sequence[Item], processes: int
) -> Iterator[Finished | Progress]:
    """Work on files with so many processes; 0 works in this one.

    A process that ends at a file is replaced, and the file tried again, three times in all; then it
    is "lost". Leaving the iterator ends the processes.

    Raises:
        RoomError: the folder of the results takes no more.
        StartError: a process cannot start.
    """
    if processes == 0:
        return _here(store, task, items)
    return _elsewhere(store, task, items, processes)


def _here(store: Store, task: Task, items: Sequence[Item]) -> Iterator[Finished | Progress]:
    task.start()
    for item in items:
        yield Finished(item, work(store, task, item, lambda *_: None))


def _elsewhere(
    store: Store, task: Task, items: Sequence[Item], processes: int
) -> Iterator[Finished | Progress]:
    crew = _Crew(store, task, items)
    threads = [
        threading.Thread(target=crew.tend, daemon=True) for _ in range(min(processes, len(items)))
    ]
    try:
        for thread in threads:
            thread.start()
        left = len(threads)
        while left:
            event = crew.events.get()
            if event is None:
                left -= 1
            elif isinstance(event, BaseException):
                raise event
            else:
                yield event
    finally:
        crew.end()
        for thread in threads:
            thread.join()


class _Crew:
    """The files that are left, and the processes that take them; a thread tends each."""

    def __init__(self, store: Store, task: Task, items: Sequence[Item]):
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._store, self._task = store, task
        self._left = deque((item, 0) for item in items)
        self._lock = threading.Lock()
        self._workers: set[_Worker] = set()
        self._ended = False

    def tend(self) -> None:
        """Have one process after the other take files; says None to `events` at the end."""
        worker = None
        try:
            while (taken := self._next()) is not None:
                item, tries = taken
                try:
                    worker = worker or self._started()
                    self.events.put(Finished(item, worker.work(item, self.events)))
                except _EndedError as error:
                    worker = self._left_behind(worker)
                    if self._ended:
                        return
                    if tries + 1 < _TRIES:
                        with self._lock:
                            self._left.append((item, tries + 1))
                        continue
                    message = f"{_TRIES} processes ended while they worked on it: {error}"
                    self.events.put(Finished(item, lost(self._store, item, message)))
        except BaseException as error:
            if not self._ended:
                self.events.put(error)
        finally:
            self._left_behind(worker)
            self.events.put(None)

    def end(self) -> None:
        """End all processes, whatever they do."""
        with self._lock:
            self._ended = True
            self._left.clear()
            workers = list(self._workers)
        for worker in workers:
            worker.kill()

    def _next(self) -> tuple[Item, int] | None:
        with self._lock:
            return self._left.popleft() if self._left and not self._ended else None

    def _started(self) -> "_Worker":
        worker = _Worker(self._store)
        with self._lock:
            self._workers.add(worker)
            ended = self._ended
        if ended:
            worker.kill()
        try:
            worker.begin(self._store, self._task)
        except BaseException:
            self._left_behind(worker)
            raise
        return worker

    def _left_behind(self, worker: "_Worker | None") -> None:
        if worker is not None:
            worker.close()
            with self._lock:
                self._workers.discard(worker)


class _EndedError(Exception):
    """A process has ended; the message says how."""


class _Worker:
    """One process."""

    def __init__(self, store: Store):
        # A file without a name: nothing of it is left, and nothing is written elsewhere.
        self._said = tempfile.TemporaryFile(dir=store.folder)  # noqa: SIM115, closed by `close`
        self._process = subprocess.Popen(
            [sys.executable, "-c", _BOOT, json.dumps([os.path.abspath(p) for p in sys.path])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            env=os.environ | ENVIRONMENT,
        )

    def begin(self, store: Store, task: Task) -> None:
        """Tell it what its work is, and wait until it is ready.

        Raises:
            StartError: it is not.
        """
        try:
            self._send(pickle.dumps((store, task)))
            kind, said = self._receive()
        except _EndedError as error:
            raise StartError(f"a process must start: got one that did not ({error})") from None
        if kind == "failed":
            raise StartError(said)

    def work(self, item: Item, events: Any) -> dict[str, Any] | None:
        """Its row of a file; what it reports on the way goes to `events`.

        Raises:
            _EndedError: it ended.
            RoomError: it cannot write.
        """
        self._send(item)
        while True:
            kind, answer = self._receive()
            if kind == "row":
                return answer
            if kind == "full":
                raise RoomError(None, answer)
            events.put(Progress(item.name, *answer))

    def kill(self) -> None:
        """End it; whoever waits for it learns that."""
        self._process.kill()

    def close(self) -> None:
        """End it, and close what leads to it."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._said):
            with suppress(OSError):  # what was written last, and nobody reads
                stream.close()  # pyright: ignore[reportOptionalMemberAccess]

    def _send(self, message: Any) -> None:
        try:
            send(self._process.stdin, message)  # pyright: ignore[reportArgumentType]
        except (OSError, ValueError):
            raise self._ended() from None

    def _receive(self) -> tuple[str, Any]:
        try:
            return receive(self._process.stdout)  # pyright: ignore[reportArgumentType]
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise self._ended() from None

    def _ended(self) -> _EndedError:
        try:
            code = self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:  # it has closed its output, and goes on
            self._process.kill()
            code = self._process.wait()
        how = f"exit code {code}"
        if code < 0:
            known = {s.value: s.name for s in signal.Signals}
            how = f"signal {known.get(-code, -code)}"
            how += ", which systems send that are out of memory" if -code == 9 else ""
        self._said.seek(max(0, self._said.seek(0, os.SEEK_END) - _LAST_WORDS))
        words = self._said.read().decode("utf-8", "replace").strip().splitlines()
        return _EndedError(how + (f"; its last words: {words[-1][:200]}" if words else ""))
