"""Files read within a limit: what a file announces is held against what there is, first.

A few bytes can announce terabytes. Nothing here allocates by an announced size before it has been
compared with the bytes that there are and with a limit that the caller can raise.
"""

import io
import json
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

MAX_BYTES = 2**30
"""What a file may take in memory if nobody says otherwise: 1 GiB."""
MAX_JSON_BYTES = 2**28
"""How long a JSON text may be, 256 MiB: its objects take several times that in memory."""
# A list or an object takes at least two bytes of text and some hundred of memory.
_JSON_BYTES_PER_CONTAINER = 16
# Deflate packs no better than 1032 to 1.
_MOST_DEFLATED = 1040
# NumPy's own headers are shorter than this, and it reads none that are longer.
_LONGEST_HEADER = 10_000

# What zipfile and NumPy raise where bytes are cut, damaged, encrypted or packed in another way;
# RuntimeError's subclass RecursionError stands for a header of nested brackets.
DAMAGE = (
    *(ValueError, TypeError, KeyError, SyntaxError, EOFError, RuntimeError, OverflowError),
    *(OSError, struct.error, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


class TooLargeError(ValueError):
    """A file, or an array in it, is larger than the limit that it is read with."""


class Npz(NamedTuple):
    """What was read of an .npz file: the arrays that were asked for, and all names that it has."""

    arrays: dict[str, np.ndarray]
    names: list[str]


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


def read_npz(
    path: str | os.PathLike[str],
    wanted: Callable[[str], bool] = lambda name: True,
    what: str = ".npz file",
    *,
    max_bytes: int | None = None,
) -> Npz:
    """Return the arrays of an .npz file that are wanted, within the limit; nothing is unpickled.

    Every array's announced shape is compared with the size of its member, and that with the packed
    bytes that there are, before any is unpacked. An entry counts eight bytes at least, because it
    is worked on in double precision.

    Args:
        path, what: as in `as_file`.
        wanted: which arrays, by name; others are not looked at.
        max_bytes: the limit for all of them together; `MAX_BYTES` where None.

    Raises:
        FileNotFoundError, OSError: as `as_file`.
        TooLargeError: the arrays take more than the limit.
        ValueError: no .npz file, damaged, or a wanted array holds objects; the message names it.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(f"{folder}/a.npz", pose=np.zeros((2, 3)), other=np.zeros(4))
        ...     found = read_npz(f"{folder}/a.npz", wanted={"pose"}.__contains__)
        >>> found.arrays["pose"].shape, found.names
        ((2, 3), ['pose', 'other'])
    """
    file = as_file(path, what)
    name = os.fspath(path)
    with file_errors(what, file), open(file, "rb") as stream:
        try:
            archive = open_archive(stream)
        except DAMAGE as error:
            raise ValueError(
                f"{what} must be an .npz archive: got {name!r}, which is none ({error}); it is "
                "another kind of file, truncated or damaged."
            ) from error
        members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
        names = [member.filename.removesuffix(".npy") for member in members]
        found = {n: member for n, member in zip(names, members, strict=True) if wanted(n)}
        for n in found:
            if names.count(n) > 1:
                raise ValueError(f"{what} must hold {n} once: got {name!r} with several of them.")
        size = os.fstat(stream.fileno()).st_size
        headers, total = {}, 0
        for n, member in found.items():
            with named_field(n, name):
                headers[n] = array_header(archive, member, size)
            shape, _, dtype = headers[n]
            total += math.prod(shape) * max(dtype.itemsize, 8)
            check_bytes(
                f"{n} in" if len(found) == 1 else f"arrays up to {n} in", path, total, max_bytes
            )
        arrays = {}
        for n, member in found.items():
            with named_field(n, name):
                arrays[n] = _array(archive, member, *headers[n])
    return Npz(arrays, names)


def open_archive(stream: Any) -> zipfile.ZipFile:
    """A zip archive in which every member has the same name both times that it is written.

    Nothing sums up the list of members. A damaged name in it would be one that nobody asks for, and
    what lies there would be left out without a word.

    Raises:
        BadZipFile and whatever else of `DAMAGE`: it is none, or is damaged.
    """
    archive = zipfile.ZipFile(stream)
    for member in archive.infolist():
        archive.open(member).close()
    return archive


def check_archive(
    content: bytes, what: str, path: str | os.PathLike[str], *, max_bytes: int | None = None
) -> None:
    """Do nothing for a zip archive whose members unpack to no more than the limit.

    Raises:
        TooLargeError: they unpack to more.
        ValueError: it is no archive.
    """
    name = os.fspath(path)
    try:
        with open_archive(io.BytesIO(content)) as archive:
            members = archive.infolist()
    except DAMAGE as error:
        raise ValueError(f"{what} must be a zip archive: got {name!r} ({error}).") from error
    check_bytes(what, path, sum(member.file_size for member in members), max_bytes)


@contextmanager
def named_field(field: str, path: str) -> Iterator[None]:
    """Turn whatever damage raises into an error with the field's and the file's name."""
    try:
        yield
    except _ObjectArrayError as error:
        raise ValueError(
            f"{field} in {path} is an object array, a pickle inside the .npz, which is not read; "
            "store it as a dense array of numbers."
        ) from error
    except MemoryError as error:
        raise ValueError(
            f"{field} in {path} must fit into memory, of which there is not enough; free some, or "
            "take a smaller file."
        ) from error
    except DAMAGE as error:
        raise ValueError(
            f"{field} in {path} cannot be read: {error}; the file is truncated or damaged, make "
            "or download it again."
        ) from error


class _ObjectArrayError(ValueError):
    pass


def array_header(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, file_size: int, *, objects: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran's order or not, and dtype, once they agree with the bytes that there are.

    Args:
        archive, member: the array, in an .npz.
        file_size: of the .npz.
        objects: let arrays of objects pass, whose bytes do not follow from their shape.

    Raises:
        ValueError and whatever else damage raises: they do not agree.
    """
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("it is packed in a way that NumPy does not use")
    packed = min(member.compress_size, file_size - member.header_offset)
    if member.file_size > packed * _MOST_DEFLATED:
        raise ValueError(f"it announces {member.file_size:,} bytes packed into {packed:,}")
    with archive.open(member) as stream:
        return npy_header(stream, member.file_size, objects=objects)


def npy_header(
    stream: Any, size: int, *, objects: bool = False
) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The same of a binary stream that holds an array of `size` bytes, header included."""
    with warnings.catch_warnings():
        # A header as Python 2 wrote it is as good as another.
        warnings.simplefilter("ignore", UserWarning)
        version = np.lib.format.read_magic(stream)
        start = stream.tell()
        length = int.from_bytes(stream.read(2 if version == (1, 0) else 4), "little")
        if length > _LONGEST_HEADER:
            raise ValueError(f"its header announces {length:,} bytes")
        stream.seek(start)
        if version == (1, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        else:
            shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
        start = stream.tell()
    if dtype.hasobject and not objects:
        raise _ObjectArrayError
    if any(length < 0 for length in shape):
        raise ValueError(f"it announces the shape {shape}")
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != size - start:
        raise ValueError(
            f"it announces {shape} entries of {dtype.itemsize} bytes and has {size - start:,} bytes"
        )
    return shape, fortran, dtype


def _array(
    archive: zipfile.ZipFile,
    member: zipfile.ZipInfo,
    shape: tuple[int, ...],
    fortran: bool,
    dtype: np.dtype,
) -> np.ndarray:
    length = math.prod(shape) * dtype.itemsize
    with archive.open(member) as stream:
        stream.read(member.file_size - length)
        # A copy, because what is read cannot be written to.
        content = bytearray(stream.read())
    flat = np.frombuffer(content, dtype) if length else np.zeros(math.prod(shape), dtype)
    return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
