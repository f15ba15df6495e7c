"""Another process of the same Python that measures meshes, and the orders it takes.

It is started by command line, not forked: a fork of a process with threads, as JAX has, may hang;
and not through `multiprocessing`, which runs the user's main script again. It ends when its
connection closes or its parent is gone.
"""

import copyreg
import functools
import io
import itertools
import json
import os
import pickle
import socket
import subprocess
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from spt_jax.bridge.messages import BrokenError, Frames
from spt_jax.rest.paths import SurfacePaths, surface_paths

# function(vertices, faces, options) -> one array per result, as `callback.HostFunction`.
Function = Callable[..., tuple[np.ndarray, ...]]
Mesh = tuple[np.ndarray, np.ndarray]

# Seconds after which a worker that has not answered is given up. Nobody waits so long: it is only
# not asked until then. Starting it, and unpacking a rest surface, take seconds on a busy machine.
_GIVEN_UP = 60.0

# Seconds spent on sending it an order at most.
_ORDERING = 0.1

_numbers = itertools.count()

# How many functions with their options a worker keeps.
_MOST_KEPT = 8

# What a worker's allocator keeps for itself: glibc gives arrays of some 100 kB back to the system
# and asks for them anew, a page fault for every 4 kB. Two processes are 1.65 times as fast as one
# with this, and 1.48 without.
_KEPT_BYTES = str(64 << 20)

_BOOT = """
import json, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.path[:] = json.loads(sys.argv[2])
from spt_jax.bridge.worker import serve
serve(int(sys.argv[1]), int(sys.argv[3]))
"""


class LostError(Exception):
    """A worker is gone, or answers nonsense, or is late for ever."""


class LateError(Exception):
    """A worker has not answered in time, and may yet."""


class Worker:
    """One process, for one thread at a time. It begins to start when it is made.

    Attributes:
        number: in the order in which they were made.
    """

    def __init__(self):
        self.number = next(_numbers)
        ours, theirs = socket.socketpair()
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MALLOC_MMAP_THRESHOLD_": _KEPT_BYTES,
            "MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
        }
        own = str(theirs.fileno()), json.dumps([str(path) for path in sys.path]), str(os.getpid())
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _BOOT, *own],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
        self._frames = Frames(ours)
        # Answers that are on their way, and when each is given up. The first says that it is there.
        self._awaited = {0: time.monotonic() + _GIVEN_UP}
        self._known: OrderedDict[bytes, int] = OrderedDict()
        self._faces: np.ndarray | None = None
        self._number = 0

    def is_ready(self, work: bytes) -> bool:
        """Whether it can measure now; if only the work is unknown to it, it is sent.

        Raises:
            LostError: it is gone, or has not answered for a minute.
        """
        try:
            while self._awaited:
                self._take(0.0)  # late answers are nobody's any more
        except TimeoutError:
            if min(self._awaited.values()) < time.monotonic():
                raise LostError from None
            return False
        if work in self._known:
            self._known.move_to_end(work)
            return True
        try:
            if len(self._known) == _MOST_KEPT:
                self._ask(_ORDERING, "evict", self._known.popitem(last=False)[1])
            # Options may take a second to unpack, such as the distances of a rest surface.
            self._known[work] = self._number + 1
            self._ask(_ORDERING, "register", self._number + 1, work)
        except TimeoutError:
            pass  # the rest is sent when it takes more
        return False

    def measure(self, work: bytes, mesh: Mesh, seconds: float) -> tuple[np.ndarray, ...]:
        """What the function returns for one mesh, when it is ready.

        Raises:
            LateError: not within so many seconds.
            LostError: it is gone, or could not.
        """
        vertices, faces = mesh
        fresh = None if faces is self._faces else faces
        deadline = time.monotonic() + seconds
        self._faces = faces  # what is sent late is sent all the same
        try:
            number = self._ask(seconds, "measure", self._known[work], vertices, fresh)
            while True:
                answered, answer = self._take(max(0.0, deadline - time.monotonic()))
                if answered == number:
                    return answer
        except TimeoutError:
            raise LateError from None

    def close(self) -> None:
        """End it, whatever it does: it has nothing to lose."""
        self._frames.close()
        self._process.kill()
        self._process.wait()

    def leave_to_parent(self) -> None:
        """In a forked child: the worker is the parent's, and must see when that is gone."""
        self._frames.close()
        self._process.returncode = 0  # nothing to wait for here

    def _ask(self, seconds: float, *message: Any) -> int:
        self._number += 1
        self._awaited[self._number] = time.monotonic() + _GIVEN_UP
        try:
            self._frames.send(self._number, message, seconds)
        except BrokenError as error:
            raise LostError from error
        return self._number

    def _take(self, seconds: float) -> tuple[int, Any]:
        try:
            number, (good, answer) = self._frames.receive(seconds)
        except TimeoutError:
            raise
        except Exception as error:  # whatever it sent
            raise LostError from error
        if not good or self._awaited.pop(number, None) is None:
            raise LostError
        return number, answer


def serve(descriptor: int, parent: int) -> None:
    """What a worker does until its parent is gone."""
    frames = Frames(socket.socket(fileno=descriptor))
    works: dict[int, tuple[Function, Any]] = {}
    known_faces = np.zeros((0, 3), np.int64)

    def evict(number):
        del works[number]

    def register(number, work):
        works[number] = pickle.loads(work)

    def measure(number, vertices, faces):
        nonlocal known_faces
        if faces is not None:
            known_faces = faces
        function, options = works[number]
        with np.errstate(all="ignore"):
            return function(vertices, known_faces, options)

    orders = {"evict": evict, "register": register, "measure": measure}
    try:
        frames.send(0, (True, None), _GIVEN_UP)
        while True:
            try:
                asked, (order, *arguments) = frames.receive(5.0)
            except TimeoutError:
                # A fork of the parent may hold the connection open when the parent is gone.
                if os.getppid() != parent:
                    os._exit(0)
                continue
            try:
                answer = True, orders[order](*arguments)
            except Exception:  # too little memory, perhaps: for the parent to find out
                answer = False, None
            frames.send(asked, answer, _GIVEN_UP)
    except (BrokenError, TimeoutError, ValueError, TypeError):
        os._exit(0)  # at once: nothing here needs to be wound up


@functools.lru_cache(maxsize=_MOST_KEPT)
def packed(function: Function, options: Hashable) -> bytes | None:
    """A function with its options as bytes; None where another process could not find it."""
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


def can_start() -> bool:
    """Whether this Python can be started once more by command line."""
    # An application with Python built in would start itself once more.
    name = os.path.basename(sys.executable or "").lower()
    return os.name == "posix" and name.startswith("python") and not hasattr(sys, "frozen")
