"""Files read within a limit: what a file announces is held against what there is, first.

A few bytes can announce terabytes. Nothing here allocates by an announced size before it has been
compared with the bytes that there are and with a limit that the caller can raise. Bytes and JSON
are read here, arrays and zip archives in `archives.py`.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAX_BYTES = 2**30
"""What a file may take in memory if nobody says otherwise: 1 GiB."""
MAX_JSON_BYTES = 2**28
"""How long a JSON text may be, 256 MiB: its objects take several times that in memory."""
# A list or an object takes at least two bytes of text and some hundred of memory.
_JSON_BYTES_PER_CONTAINER = 16


class TooLargeError(ValueError):
    """A file, or an array in it, is larger than the limit that it is read with."""


def as_file(path: str | os.PathLike[str], what: str = "file") -> Path:
    """Return the path once it names a regular file.

    Args:
        path: the file.
        what: how messages call it, such as "mesh file".

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is a folder, a device or a pipe.
        OSError: the system will not say; the subclass is its own.
    """
    file = Path(path)
    with file_errors(what, file):
        if not file.exists():
            raise FileNotFoundError(
                f"{what} must exist: got {os.fspath(path)!r}; check the spelling."
            )
        if not file.is_file():
            kind = "folder" if file.is_dir() else "device or pipe"
            raise ValueError(f"{what} must be a regular file: got the {kind} {os.fspath(path)!r}.")
    return file


@contextmanager
def file_errors(what: str, path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever lacks the file's name into an error that has it.

    MemoryError and RecursionError become ValueError; an OSError of the system stays one.

    Args:
        what: what is read, such as "mesh file".
        path: the file.

    Example:
        >>> with file_errors("keypoint file", "deep.json"):
        ...     raise RecursionError
        Traceback (most recent call last):
        ValueError: keypoint file must not be nested so deeply: got 'deep.json'; it is damaged.
    """
    name = os.fspath(path)
    try:
        yield
    except MemoryError as error:
        raise ValueError(
            f"{what} must fit into memory: got {name!r}, for which there is not enough; free some, "
            "or take a smaller file."
        ) from error
    except RecursionError as error:
        raise ValueError(
            f"{what} must not be nested so deeply: got {name!r}; it is damaged."
        ) from error
    except OSError as error:
        if error.errno is None:  # one of ours, with a message of its own
            raise
        raise type(error)(f"{what} must be readable: got {name!r} ({error.strerror}).") from error


def check_bytes(
    what: str, path: str | os.PathLike[str], size: int, max_bytes: int | None = None
) -> None:
    """Do nothing for a size within the limit.

    Args:
        what: what is measured, such as "mesh file" or "poses in".
        path: the file.
        size: in bytes.
        max_bytes: the limit; `MAX_BYTES` where None.

    Raises:
        TooLargeError: it is larger; the message says how to raise the limit.
        ValueError: a limit that is not positive.

    Example:
        >>> check_bytes("mesh file", "huge.stl", 5_000_000_084)
        Traceback (most recent call last):
        spt_jax.files.limits.TooLargeError: mesh file 'huge.stl' must not take more than \
1,073,741,824 bytes: got 5,000,000,084; if the file is trusted, raise max_bytes (--max-bytes).
    """
    limit = MAX_BYTES if max_bytes is None else max_bytes
    if limit <= 0:
        raise ValueError(f"max_bytes must be positive: got {limit}; leave it out for the default.")
    if size > limit:
        raise TooLargeError(
            f"{what} {os.fspath(path)!r} must not take more than {limit:,} bytes: got {size:,}; if "
            "the file is trusted, raise max_bytes (--max-bytes)."
        )


def read_bytes(
    path: str | os.PathLike[str], what: str = "file", *, max_bytes: int | None = None
) -> bytes:
    """Return the content of a regular file that is within the limit.

    Args:
        path, what: as in `as_file`.
        max_bytes: the limit; `MAX_BYTES` where None.

    Raises:
        FileNotFoundError, OSError, ValueError: as `as_file`.
        TooLargeError: the file is larger than the limit.
    """
    file = as_file(path, what)
    with file_errors(what, file), open(file, "rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        check_bytes(what, path, size, max_bytes)
        # Files of the system announce a size of 0, and others may grow. A read asks for as much
        # memory as it may return, so none is of the limit's size.
        left = (MAX_BYTES if max_bytes is None else max_bytes) + 1
        pieces: list[bytes] = []
        while piece := stream.read(min(left, size + 1 if not pieces else 2**20)):
            pieces.append(piece)
            left -= len(piece)
        content = b"".join(pieces)
    check_bytes(what, path, len(content), max_bytes)
    return content


def read_json(
    path: str | os.PathLike[str], what: str = "JSON file", *, max_bytes: int | None = None
) -> Any:
    """Return what a JSON file within the limit holds.

    Args:
        path, what: as in `as_file`.
        max_bytes: the limit of the text; `MAX_JSON_BYTES` where None. Lists and objects may be a
            sixteenth of it in number.

    Raises:
        FileNotFoundError, OSError: as `as_file`.
        TooLargeError: the text is longer, or holds more lists and objects.
        ValueError: it is no JSON; the message says where it stops being.
    """
    limit = MAX_JSON_BYTES if max_bytes is None else max_bytes
    content = read_bytes(path, what, max_bytes=limit)
    containers = content.count(b"[") + content.count(b"{")
    check_bytes(f"the lists of {what}", path, _JSON_BYTES_PER_CONTAINER * containers, limit)
    return parse_json(content, what, path)


def parse_json(content: bytes, what: str, path: str | os.PathLike[str]) -> Any:
    """Return what a JSON text holds, with errors that name the file.

    Raises:
        ValueError: as `read_json`.
    """
    name = os.fspath(path)
    with file_errors(what, path):
        try:
            return json.loads(content.decode("utf-8-sig"))
        except UnicodeDecodeError as error:
            raise ValueError(
                f"{what} must be JSON text: got {name!r} with bytes that are no text at position "
                f"{error.start}."
            ) from error
        except json.JSONDecodeError as error:
            raise ValueError(
                f"{what} must be JSON: got {name!r} with {error.msg} at line {error.lineno}, "
                f"column {error.colno}; it is cut or damaged."
            ) from error
        except ValueError as error:  # an integer of thousands of digits
            raise ValueError(f"{what} must be JSON: got {name!r} with {error}.") from error
