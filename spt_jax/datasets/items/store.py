"""What is done of a data set: a row and whole outputs for each file, whoever works where.

All of it lies in the folder of the results. `OUT/.spt-jax` holds `settings.json`, a row for each
file that is done, what is being written, and `claims`, a file of which nothing but bytes are
locked.

A result counts from the moment at which its row stands. Outputs are written into a folder of their
own and moved to their places, and then the row is, each by a rename, which happens whole or not at
all: a process that is killed in between leaves work that is done again, and no half of anything.
Rows have the length and the hash of each output, and nothing is forced to the disk: what a machine
loses with its power is told by them, and made again.

Who works on a file has locked one byte of `claims`, at a place that the file's name says. Such a
lock ends with its process, however that ends, and holds between machines where the file system has
locks (NFS has); where it has none, two runs on one folder do the same work and write the same.
"""

import errno
import hashlib
import json
import os
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from spt_jax.files.limits import read_json
from spt_jax.files.outputs import atomic_write, ensure_folder, write_json

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

RESERVED = ("manifest.jsonl", "manifest.csv", "people.csv", "summary.json", "report.html")
"""What a run itself writes into the folder of the results."""

_WHOLE = 0  # the byte that stands for all of it
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}


class Store:
    """The results of a data set in a folder.

    Args:
        out: the folder.
    """

    FOLDER = ".spt-jax"

    def __init__(self, out: Path):
        self.out = Path(out)
        self.folder = self.out / self.FOLDER

    def begin(self, settings: Mapping[str, Any], *, anew: bool = False) -> None:
        """Make the folder, or go on with what is there.

        Args:
            settings: what results depend on, as JSON types.
            anew: discard all results, whatever settings they were made with.

        Raises:
            ValueError: what is there was made with other settings.
            OSError: the folder cannot be made or written.
        """
        ensure_folder(self.folder)
        path = self.folder / "settings.json"
        given = json.loads(json.dumps(settings))
        with self.writing() as within:
            if anew:
                shutil.rmtree(self.folder / "rows", ignore_errors=True)
                path.unlink(missing_ok=True)
            if not path.exists():
                write_json(path, given, within=within)
                return
            before = read_json(path, "settings")
        wrong = [key for key in {**given, **before} if given.get(key) != before.get(key)]
        if wrong:
            key = wrong[0]
            raise ValueError(
                f"out must not hold results of other settings: got {str(self.out)!r}, made with "
                f"{key} {before.get(key)!r} and not {given.get(key)!r}; choose another folder, or "
                "start anew (--anew), which replaces them."
            )

    @staticmethod
    def key(name: str) -> str:
        """A name's hash, as part of a file's name."""
        return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:32]

    def row(self, name: str) -> dict[str, Any] | None:
        """The row of a file; None where it is not done, or the row is damaged."""
        try:
            found = json.loads(self._row(name).read_bytes())
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) and found.get("name") == name else None

    def has(self, row: Mapping[str, Any]) -> bool:
        """Whether the outputs that a row names are there, as long as they were."""
        for name, size in zip(row["outputs"], row["output_bytes"], strict=True):
            try:
                if (self.out / name).stat().st_size != size:
                    return False
            except OSError:
                return False
        return True

    def verified(self, row: Mapping[str, Any]) -> bool:
        """Whether they are what they were, to the bit."""
        hashes = zip(row["outputs"], row["output_sha256"], strict=True)
        return self.has(row) and all(sha256(self.out / name) == digest for name, digest in hashes)

    @contextmanager
    def staging(self, name: str) -> Iterator[Path]:
        """An empty folder for the outputs of a file that is claimed, gone afterwards."""
        folder = self._staging / self.key(name)
        shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
        outputs = folder / "outputs"
        outputs.mkdir(parents=True)
        try:
            yield outputs
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def sweep(self) -> None:
        """Remove what processes that were killed left of files that nobody works on."""
        with suppress(OSError):
            for folder in list(self._staging.iterdir()):
                place = _place(folder.name)
                with _claims.lock(self.folder / "claims", place, wait=False, sure=True) as taken:
                    if taken:
                        shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Nobody else begins or ends a run; a folder for what is half written, gone afterwards."""
        folder = self.folder / "writing"
        with _claims.lock(self.folder / "claims", _WHOLE, wait=True):
            shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed
            folder.mkdir()
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)

    def discard(self, name: str) -> None:
        """A file is not done any more."""
        self._row(name).unlink(missing_ok=True)

    def commit(self, row: dict[str, Any], staged: Path) -> dict[str, Any]:
        """Put outputs in their places and then the row; the row.

        Args:
            row: of the file.
            staged: what `staging` gave for it.

        Outputs that an earlier row of the file names, and this one does not, are removed.

        Raises:
            OSError: there is no room, or a folder cannot be written.
        """
        files = outputs_in(staged)
        names = [place_of(row["name"], path, staged) for path in files]
        for stale in set((self.row(row["name"]) or {}).get("outputs", ())) - set(names):
            (self.out / stale).unlink(missing_ok=True)
        row = row | {
            "outputs": names,
            "output_bytes": [path.stat().st_size for path in files],
            "output_sha256": [sha256(path) for path in files],
        }
        for path, name in zip(files, names, strict=True):
            target = self.out / name
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, target)
        self._row(row["name"]).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(self._row(row["name"]), within=staged.parent) as temporary:
            temporary.write_text(json.dumps(row, allow_nan=False), encoding="utf-8")
        return row

    @contextmanager
    def claim(self, name: str) -> Iterator[bool]:
        """Whether the file is this process' to work on while the block runs; it does not wait."""
        with _claims.lock(self.folder / "claims", _place(self.key(name)), wait=False) as taken:
            yield taken

    @property
    def _staging(self) -> Path:
        return self.folder / "staging"

    def _row(self, name: str) -> Path:
        key = self.key(name)
        return self.folder / "rows" / key[:2] / f"{key}.json"


def _place(key: str) -> int:
    """The byte of `claims` that stands for a file, by the hash of its name."""
    return 1 + int(key[:15], 16)


def outputs_in(staged: Path) -> list[Path]:
    """The files that a task has written."""
    return sorted(path for path in staged.rglob("*") if path.is_file())


def place_of(name: str, path: Path, staged: Path) -> str:
    """Where an output of a file goes, from the folder of the results."""
    return (PurePosixPath(name).parent / path.relative_to(staged).as_posix()).as_posix()


def sha256(path: Path) -> str:
    """The hash of a file's content."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class _Claims:
    """Locks of bytes in files, of this process and within it.

    A process loses its locks of a file with the first descriptor of it that it closes, so each file
    is opened once and stays open.
    """

    def __init__(self):
        self._open: dict[str, int] = {}
        self._own: set[tuple[str, int]] = set()
        self._changed = threading.Condition()

    @contextmanager
    def lock(self, file: Path, place: int, *, wait: bool, sure: bool = False) -> Iterator[bool]:
        """Whether a byte is locked while the block runs.

        Args:
            file, place: the byte.
            wait: for whoever has it.
            sure: False where the file system has no locks; else that goes for locked.
        """
        key = (str(file.resolve()), place)
        with self._changed:
            while key in self._own:
                if not wait:
                    break
                self._changed.wait()
            mine = key not in self._own
            if mine:
                self._own.add(key)
        if not mine:
            yield False
            return
        try:
            descriptor = self._descriptor(file, key[0])
            taken = _lock(descriptor, place, wait)
            try:
                yield bool(taken) or (taken is None and not sure)
            finally:
                if taken and fcntl is not None:
                    _quietly(fcntl.lockf, descriptor, fcntl.LOCK_UN, 1, place)
        finally:
            with self._changed:
                self._own.discard(key)
                self._changed.notify_all()

    def _descriptor(self, file: Path, key: str) -> int:
        with self._changed:
            known = self._open.get(key)
            if known is None or not _is_open_at(known, file):
                flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0)
                self._open[key] = os.open(file, flags, 0o644)
            return self._open[key]


def _is_open_at(descriptor: int, file: Path) -> bool:
    """Whether a descriptor is still that of the file: its folder may have been made anew."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(file))
    except OSError:
        return False


def _lock(descriptor: int, place: int, wait: bool) -> bool | None:
    """Whether it is locked; None where there are no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, place)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return None
    return True


def _quietly(function: Any, *arguments: Any) -> None:
    with suppress(OSError):
        function(*arguments)


_claims = _Claims()
