"""One other process of the same Python that measures meshes, and what it is told.

It is started by command line, not forked: a fork of a process with threads, as JAX has, may hang;
and not through `multiprocessing`, which runs the user's main script again. It ends when its
connection closes or its parent is gone.
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
from collections import OrderedDict
from collections.abc import Callable, Hashable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from spt_jax.surface_paths import SurfacePaths, surface_paths

# function(vertices, faces, options) -> one array per result, as `host.HostFunction`.
Function = Callable[..., tuple[np.ndarray, ...]]
Mesh = tuple[np.ndarray, np.ndarray]

# Seconds that a message may take to go through.
_PATIENCE = 20.0

# How many functions with their options a worker remembers.
_REMEMBERED = 8

# What a worker's allocator keeps for itself: glibc gives arrays of some 100 kB back to the system
# and asks for them anew, a page fault for every 4 kB. Two processes are 1.65 times as fast as one
# with this, and 1.48 without.
_KEPT_BYTES = str(64 << 20)

_BOOT = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
from multiprocessing.connection import Connection
connection = Connection(int(sys.argv[1]))
sys.path[:], parent = connection.recv()
from spt_jax.worker import serve
serve(connection, parent)
"""


class LostError(Exception):
    """A worker is gone, or answers nonsense."""


class Worker:
    """One process, for one thread at a time. It begins to start when it is made."""

    def __init__(self):
        ours, theirs = socket.socketpair()
        # One that has stopped in the middle of a message must not stop us, too.
        seconds = struct.pack("ll", *divmod(int(1e6 * _PATIENCE), 1_000_000))
        for limit in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, limit, seconds)
        environment = os.environ | {
            "JAX_PLATFORMS": "cpu",  # imported, never used; must not reserve an accelerator
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MALLOC_MMAP_THRESHOLD_": _KEPT_BYTES,
            "MALLOC_TRIM_THRESHOLD_": _KEPT_BYTES,
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
            raise LostError from error

    def _receive(self, seconds: float) -> Any:
        try:
            if not self._connection.poll(seconds):
                raise LostError
            good, answer = self._connection.recv()
        except Exception as error:  # whatever it sent
            raise LostError from error
        if not good:
            raise LostError
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
            return function(vertices, known_faces, options)

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


@functools.lru_cache(maxsize=_REMEMBERED)
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
