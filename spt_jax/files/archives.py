"""Arrays of .npz files and other zip archives, read within a limit; nothing is unpickled.

What an archive announces, the size of each member and the shape of each array, is compared with
the bytes that there are, and with the limit, before anything is unpacked.
"""

import io
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from spt_jax.files.limits import as_file, check_bytes, file_errors

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


class Npz(NamedTuple):
    """What was read of an .npz file: the arrays that were asked for, and all names that it has."""

    arrays: dict[str, np.ndarray]
    names: list[str]


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
