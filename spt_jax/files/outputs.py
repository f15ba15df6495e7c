"""Output files that are whole or absent, in folders that are checked first."""

import errno
import json
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

# What writing meets where a disk, a quota or the largest size of a file is reached, or it breaks.
_FULL = {errno.ENOSPC, errno.EFBIG, errno.EIO, getattr(errno, "EDQUOT", errno.ENOSPC)}


def ensure_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder at a path, made with its parents where missing, once it can be written.

    Args:
        path: the folder.

    Raises:
        OSError: it cannot be made or written; the subclass is the system's own.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # os.access answers for the real user id and not for a full or read-only disk; a file does.
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise folder_error(folder, error) from error
    return folder


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, within: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path beside `path` that takes its place when the block ends well.

    Whatever ends the block early, KeyboardInterrupt included, removes the temporary file and leaves
    a file already at `path` as it was.

    Args:
        path: where the file is to stand; its folder must exist.
        within: where the temporary file is to stand, on the same disk; beside `path` if None. A
            process that is killed leaves it there.

    Raises:
        OSError: the folder is missing, full or cannot be written, or `path` is itself a folder.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "note.txt") as temporary:
        ...     _ = temporary.write_text("done")
        >>> (folder / "note.txt").read_text()
        'done'
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(f"path must name a file: got the folder {str(target)!r}")
    # The suffix stays last: trimesh and NumPy choose or extend the format by it.
    name = f".{target.stem}.{secrets.token_hex(6)}{target.suffix}"
    temporary = target.with_name(name) if within is None else within / name
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        raise folder_error(temporary.parent, error) from error
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno in _FULL:
            raise OSError(
                f"out must have room for {str(target)!r}: got {error.strerror}; make room, or "
                "choose another folder"
            ) from error
        raise


def write_json(path: str | os.PathLike[str], value: Any, *, within: Path | None = None) -> None:
    """Write a value as indented JSON, atomically; arrays become lists and paths strings.

    Raises:
        TypeError: something in it has no JSON form.
        ValueError: it holds NaN or infinity, which JSON cannot say.
        OSError: as in `atomic_write`.
    """

    def plain(item: Any) -> Any:
        if hasattr(item, "__array__"):  # NumPy's and JAX's, which is not imported for this
            return np.asarray(item).tolist()
        if isinstance(item, os.PathLike):
            return os.fspath(item)
        raise TypeError(
            f"value must hold JSON types, arrays and paths: got {type(item).__name__}; convert it"
        )

    try:
        text = json.dumps(value, indent=2, default=plain, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"value must be finite to be written as JSON: got {error}") from error
    with atomic_write(path, within=within) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def folder_error(folder: Path, error: OSError) -> OSError:
    """The system's error about a folder that cannot be written, with what to do."""
    return type(error)(
        f"out must be a folder that can be written: got {str(folder)!r} ({error.strerror}); "
        "make the folder or choose another"
    )
