"""One file of a data set: claimed, worked on, and its result committed, in whichever process."""

import errno
import os
import platform
import socket
import sys
import time
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from spt_jax.datasets.items.inventory import Item
from spt_jax.datasets.items.store import RESERVED, Store, outputs_in, place_of

# What writing meets where nothing can be written any more: the next file would fare no better.
_FULL = {errno.ENOSPC, errno.EFBIG, errno.EROFS, getattr(errno, "EDQUOT", errno.ENOSPC)}

# Called with what is done of a file, of how much, and what is done now.
Report = Callable[[int, int, str], None]


class Task(Protocol):
    """What is done with each file of a data set; an object that can be pickled.

    Attributes:
        name: what it is called in messages and in `summary.json`.
    """

    name: str

    def settings(self) -> dict[str, Any]:
        """What its results depend on, as JSON types; other settings want another folder."""
        ...

    def wants(self, path: Path) -> bool:
        """Whether a file is one of the data set, by its name."""
        ...

    def start(self) -> None:
        """Prepare a process, once, before its first file.

        Raises:
            ValueError, OSError: nothing can be done in it; the run ends.
        """
        ...

    def work(self, path: Path, out: Path, report: Report) -> dict[str, Any]:
        """Write the outputs of a file into a folder, and return its figures as JSON types.

        Args:
            path: the file.
            out: an empty folder; its files are moved to where the file lies in the data set.
            report: may be called with what is done, of how much, and what is done now.

        Returns:
            Any figures. `status` says how it went, "done" if it is not there; `message` more. In
            the summary, numbers called `largest_` are maxima, those called `mean_` are means over
            the files' `frames`, and all others are sums.

        Raises:
            UnknownFileError: the file is none of the kind; it is counted and left alone.
            ValueError, TypeError, OSError: it is damaged; the message becomes its row's.
        """
        ...


class UnknownFileError(ValueError):
    """A file that is none of a data set's kind."""


class RoomError(OSError):
    """The folder of the results takes no more."""


def work(store: Store, task: Task, item: Item, report: Report) -> dict[str, Any] | None:
    """The row of a file, made now or by somebody else meanwhile; None where somebody is at it.

    Raises:
        RoomError: the folder of the results takes no more.
    """
    with store.claim(item.name) as taken:
        if not taken:
            return None
        before = store.row(item.name)
        if before is not None and is_whole(store, before, item):
            return before
        begin, used = time.perf_counter(), time.process_time()
        try:
            with store.staging(item.name) as staged:
                found = _attempt(task, item, staged, report)
                known = {
                    "name": item.name,
                    "status": "done",
                    "message": "",
                    "input_bytes": item.size,
                    "input_modified_ns": item.modified,
                    "seconds": round(time.perf_counter() - begin, 4),
                    "processor_seconds": round(time.process_time() - used, 4),
                    "largest_memory_bytes": peak_memory(),
                    "host": socket.gethostname(),
                    "version": _version(),
                    "finished": datetime.now(UTC).isoformat(timespec="seconds"),
                }
                return store.commit(known | found, staged)
        except OSError as error:
            raise RoomError(
                error.errno,
                f"out must be a folder that takes what is written: got {str(store.out)!r} "
                f"({error.strerror or error}); make room, or choose another. What is done stays, "
                "and the same command goes on there",
            ) from error


def is_whole(store: Store, row: dict[str, Any], item: Item) -> bool:
    """Whether a row is that of the file as it is now, with its outputs."""
    same = (row["input_bytes"], row["input_modified_ns"]) == (item.size, item.modified)
    return same and row["status"] != "lost" and store.has(row)


def lost(store: Store, item: Item, message: str) -> dict[str, Any] | None:
    """The row of a file whose processes ended; it is tried again by the next run."""

    class Lost:
        def work(self, *_: Any) -> dict[str, Any]:
            return {"status": "lost", "message": message}

    return work(store, Lost(), item, lambda *_: None)  # pyright: ignore[reportArgumentType]


def _attempt(task: Task, item: Item, staged: Path, report: Report) -> dict[str, Any]:
    try:
        found = task.work(item.path, staged, report)
        taken = {place_of(item.name, path, staged) for path in outputs_in(staged)} & {*RESERVED}
        if taken:
            raise ValueError(
                f"file must not be called as what a run writes: got {item.name!r}, whose output "
                f"would be {taken.pop()}; rename it, or move it into a folder"
            )
        return found
    except UnknownFileError as error:
        found = {"status": "unknown", "message": " ".join(str(error).split())}
    except Exception as error:
        if isinstance(error, OSError) and (error.errno in _FULL or _names(error, staged)):
            raise
        message = " ".join(str(error).split())
        found = {"status": "failed", "message": message}
        if not isinstance(error, ValueError | OSError | TypeError):
            found["message"] = f"{type(error).__name__}: {message}"
            found["traceback"] = traceback.format_exc(limit=-6)
    for path in outputs_in(staged):
        path.unlink()  # half of a result is none
    return found


def _names(error: OSError, folder: Path) -> bool:
    """Whether an error is about the folder of the results."""
    return str(folder) in f"{error.filename} {error}"


def peak_memory() -> int:
    """The most memory that this process has taken, in bytes; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _version() -> str:
    from spt_jax import __version__

    return f"spt_jax {__version__}, Python {platform.python_version()}"


def usable_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
