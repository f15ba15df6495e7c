"""Other processes of the same Python that measure meshes of a batch along with this one.

Threads do not help. Measuring one body makes about a thousand calls of NumPy on arrays that fit
the cache, 10 to 50 us each. Each gives Python's lock away and has to win it back, and between two
threads that hand-over costs as much as the call: for 30,000 elements, two threads that do nothing
but `np.add`, `take` or `bincount` are together 0.9 to 1.2 times as fast as one, and two threads
that measure bodies 0.8 to 1.1 times. Arrays ten times as large would hide it and miss the cache.
Processes share no lock: two are together 1.9 times as fast as one.

A worker is started by command line, not forked: a fork of a process with threads, as JAX has, may
hang; and not through `multiprocessing`, which runs the user's main script again. It ends when its
connection closes or its parent is gone, and whatever goes wrong with one, the work is done here.
"""

import copyreg
import functools
import io
import os
import pickle
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Executor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from spt_jax.surface_paths import SurfacePaths, surface_paths

# function(vertices, faces, options, map) -> one array per result, as `host.HostFunction`.
Function = Callable[..., tuple[np.ndarray, ...]]
Mesh = tuple[np.ndarray, np.ndarray]

# Starting one takes a second of a core, and 190 MB while it is there: not before batches have
# taken as long, and not for every core of a large machine.
_WORTH_STARTING = 1.0
_MOST_WORKERS = 7

# Triangles in a batch for it to be shared: handing a mesh over costs as much as some 500.
_WORTH_SHARING = 10_000

# A worker that answers later than this is lost: seconds, and microseconds for each triangle, a
# hundred times what is usual. After so many losses there are no more workers.
_PATIENCE = 20.0, 100.0
_MOST_LOSSES = 3

# How many functions with their options a worker remembers.
_REMEMBERED = 8

_BOOT = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
from multiprocessing.connection import Connection
connection = Connection(int(sys.argv[1]))
sys.path[:], parent = connection.recv()
from spt_jax.workers import serve
serve(connection, parent)
"""


class _LostError(Exception):
    """A worker is gone, or answers nonsense."""


class Worker:
    """One process, for one thread at a time. It begins to start when it is made."""

    def __init__(self):
        ours, theirs = socket.socketpair()
        # One that has stopped in the middle of a message must not stop us, too.
        seconds = struct.pack("ll", *divmod(int(1e6 * _PATIENCE[0]), 1_000_000))
        for limit in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, limit, seconds)
        environment = os.environ | {
            "JAX_PLATFORMS": "cpu",  # imported, never used; must not reserve an accelerator
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _BOOT, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
        self._connection = Connection(ours.detach())
        self._pending = 1  # answers that are on their way: the first says that it is there
        self._known: OrderedDict[bytes, int] = OrderedDict()
        self._faces: np.ndarray | None = None
        self._number = 0
        self._send(sys.path, os.getpid())

    def is_ready(self, work: bytes) -> bool:
        """Whether it can measure now; if only for want of knowing the work, it is told."""
        while self._pending and self._connection.poll(0):
            self._receive(0.0)
            self._pending -= 1
        if self._pending:
            return False
        if work in self._known:
            self._known.move_to_end(work)
            return True
        if len(self._known) == _REMEMBERED:
            self._tell("forget", self._known.popitem(last=False)[1])
        self._number += 1
        self._known[work] = self._number
        # Options may take a second to unpack, such as the distances of a rest surface.
        self._tell("learn", self._number, work)
        return False

    def measure(self, work: bytes, mesh: Mesh, seconds: float) -> tuple[np.ndarray, ...]:
        """What the function returns for one mesh, when it is ready."""
        vertices, faces = mesh
        fresh = None if faces is self._faces else faces
        self._send("measure", self._known[work], vertices, fresh)
        self._faces = faces
        return self._receive(seconds)

    def close(self) -> None:
        """End it, whatever it does: it has nothing to lose."""
        self._connection.close()
        self._process.kill()
        self._process.wait()

    def leave_to_parent(self) -> None:
        """In a forked child: the worker is the parent's, and must see when that is gone."""
        self._connection.close()
        self._process.returncode = 0  # nothing to wait for here

    def _tell(self, *message: Any) -> None:
        self._send(*message)
        self._pending += 1

    def _send(self, *message: Any) -> None:
        try:
            self._connection.send(message)
        except (OSError, ValueError) as error:
            raise _LostError from error

    def _receive(self, seconds: float) -> Any:
        try:
            if not self._connection.poll(seconds):
                raise _LostError
            good, answer = self._connection.recv()
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            raise _LostError from error
        if not good:
            raise _LostError
        return answer


def serve(connection: Connection, parent: int) -> None:
    """What a worker does until its parent is gone."""
    works: dict[int, tuple[Function, Any]] = {}
    known_faces = np.zeros((0, 3), np.int64)

    def forget(number):
        del works[number]

    def learn(number, work):
        works[number] = pickle.loads(work)

    def measure(number, vertices, faces):
        nonlocal known_faces
        if faces is not None:
            known_faces = faces
        function, options = works[number]
        with np.errstate(all="ignore"):
            return function(vertices, known_faces, options, map)

    orders = {"forget": forget, "learn": learn, "measure": measure}
    try:
        connection.send((True, None))
        while True:
            # A fork of the parent may hold the connection open when the parent is gone.
            while not connection.poll(5.0):
                if os.getppid() != parent:
                    os._exit(0)
            order, *arguments = connection.recv()
            try:
                answer = True, orders[order](*arguments)
            except Exception:  # too little memory, perhaps: for the parent to find out
                answer = False, None
            connection.send(answer)
    except (OSError, EOFError):
        os._exit(0)  # at once: nothing here needs to be wound up


class Workers:
    """The workers of this process, started when batches have been worth it."""

    def __init__(self):
        self._lock = threading.Lock()
        self._free: list[Worker] = []
        self._number = 0
        self._losses = 0
        self._spent = 0.0

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

        def measure_here() -> None:
            i = left.popleft()
            found[i] = function(*meshes[i], options, map)

        def share(worker: Worker, work: bytes, seconds: float) -> None:
            try:
                while left:
                    i = left.popleft()
                    lost.append(i)
                    found[i] = worker.measure(work, meshes[i], seconds)
                    lost.remove(i)
            except IndexError:  # another took the last one
                pass
            except _LostError:
                self._drop(worker)
                return
            self._release(worker)

        begin = time.perf_counter()
        size = sum(len(faces) for _, faces in meshes)
        work = _packed(function, options) if size > _WORTH_SHARING else None
        patience = _PATIENCE[0] + 1e-6 * _PATIENCE[1] * size
        try:
            for worker in self._ready(work, len(meshes) - 1) if work else ():
                try:
                    shares.append(executor().submit(share, worker, work, patience))
                except RuntimeError:  # the interpreter is leaving and takes no more work
                    self._release(worker)
            while left:
                try:
                    measure_here()
                except IndexError:
                    break
        finally:
            left.clear()
            for ended in shares:
                ended.result()
            self._spent += time.perf_counter() - begin
        for i in lost:
            found[i] = function(*meshes[i], options, map)
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
            except _LostError:
                self._drop(worker)
        return ready

    def _start(self) -> None:
        most = min(usable_cores() - 1, _MOST_WORKERS)
        if self._spent < _WORTH_STARTING or self._losses >= _MOST_LOSSES or not _can_start():
            return
        while self._number < most:
            try:
                self._free.append(Worker())
            except (OSError, _LostError):
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


@functools.lru_cache(maxsize=_REMEMBERED)
def _packed(function: Function, options: Hashable) -> bytes | None:
    """The work as bytes; None where another process could not find the function."""
    if not function.__module__.startswith("spt_jax."):
        return None
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL)
    # Made again from the mesh: it holds locks, and tables of 50 MB.
    pickler.dispatch_table = copyreg.dispatch_table | {
        SurfacePaths: lambda paths: (surface_paths, (paths.content.vertices, paths.content.faces))
    }
    try:
        pickler.dump((function, options))
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return buffer.getvalue()


def _can_start() -> bool:
    # An application with Python built in would start itself once more.
    name = os.path.basename(sys.executable or "").lower()
    return os.name == "posix" and name.startswith("python") and not hasattr(sys, "frozen")


def usable_cores() -> int:
    """How many cores this process may use."""
    # The affinity, not the machine: containers and job schedulers hand out fewer cores.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
