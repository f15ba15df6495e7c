"""Files opened as trees of dictionaries, lists and arrays, however packed, and back."""

import bz2
import gzip
import io
import json
import lzma
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spt_jax.files.archives import DAMAGE, array_header, named_field, npy_header, open_archive
from spt_jax.files.limits import (
    MAX_BYTES,
    TooLargeError,
    as_file,
    check_bytes,
    file_errors,
    parse_json,
    read_bytes,
)
from spt_jax.files.pickles import RefusedPickleError
from spt_jax.files.stand_ins import StandIn, plain
from spt_jax.io.poses.pickling import as_pickle, as_torch_archive
from spt_jax.io.poses.unpickling import as_storage, check_total, read_legacy_torch, unpickled

WHAT = "pose file"
# How joblib packs, by the first bytes of each (joblib/joblib, joblib/compressor.py).
_PACKED: dict[bytes, Callable[[io.BytesIO], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ": lzma.open,
    b"\x5d\x00\x00": lzma.open,
}
_LEGACY_START = b"\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19"


@dataclass(frozen=True, eq=False)
class Container:
    """A file as a tree, and how a tree becomes such a file again.

    Attributes:
        path: the file.
        kind: "npz", "npy", "pickle", "torch", "json" or "bvh".
        tree: what it holds. Arrays of one object are that object; tensors are `TorchArray`.
        encode: a tree of the same structure as the content of a file.
    """

    path: Path
    kind: str
    tree: Any
    encode: Callable[[Any], bytes]


def open_container(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> Container:
    """Open a file by its first bytes; what it is called does not matter.

    Args:
        path: the file.
        max_bytes: what it may take, packed and unpacked; 1 GiB where None.

    Raises:
        FileNotFoundError, OSError: there is no such file, or it cannot be read.
        TooLargeError: it takes more than the limit.
        RefusedPickleError: a pickle in it names what is not admitted.
        ValueError: another kind of file, or one that is cut or damaged.
    """
    file = as_file(path, WHAT)
    content = read_bytes(file, WHAT, max_bytes=max_bytes)
    with file_errors(WHAT, file):
        found = _opened(file, content, max_bytes)
        check_total(file, found.tree, max_bytes)
    return found


def _opened(file: Path, content: bytes, max_bytes: int | None) -> Container:
    content = _unpacked(file, content, max_bytes)
    if content.startswith(b"PK"):
        return _archive(file, content, max_bytes)
    if content.startswith(b"\x93NUMPY"):
        value = _member(file, file.name, content, max_bytes)
        return Container(file, "npy", value, _as_npy)
    start = content.lstrip(b"\xef\xbb\xbf \t\r\n")[:9]
    if start == b"HIERARCHY":
        from spt_jax.io.poses.bvh_tree import as_bvh, parse_bvh

        return Container(file, "bvh", parse_bvh(content, file), as_bvh)
    if start[:1] in (b"{", b"["):
        check_bytes("the lists of pose file", file, 16 * content.count(b"["), max_bytes)
        return Container(file, "json", parse_json(content, WHAT, file), _as_json)
    if content[2:].startswith(_LEGACY_START):
        with _damage(file):
            value = read_legacy_torch(content, MAX_BYTES if max_bytes is None else max_bytes)
        return Container(file, "torch", value, as_torch_archive)
    if content[:1] not in (b"\x80", b"(", b"}", b"]", b"c"):
        raise ValueError(
            f"pose file must be an .npz, .npy, pickle, .pt, .json or .bvh file: got {str(file)!r}, "
            "which begins like none of them; it is another kind of file, truncated or damaged."
        )
    tree = _dense(file, unpickled(content, file, max_bytes=max_bytes))
    protocol = 2 if content[:2] <= b"\x80\x02" or content[:1] != b"\x80" else 4
    return Container(file, "pickle", tree, lambda value: as_pickle(value, protocol))


def _unpacked(file: Path, content: bytes, max_bytes: int | None) -> bytes:
    """A file that joblib packed, or gzip, within the limit."""
    limit = MAX_BYTES if max_bytes is None else max_bytes
    try:
        if content[:1] == b"\x78" and len(content) > 2 and int.from_bytes(content[:2]) % 31 == 0:
            packed = zlib.decompressobj()
            unpacked = packed.decompress(content, limit + 1)
            check_bytes("unpacked pose file", file, len(unpacked), max_bytes)
            if not packed.eof:
                raise EOFError("it ends before it should")
            return unpacked
        for start, opened in _PACKED.items():
            if content.startswith(start):
                with opened(io.BytesIO(content)) as stream:
                    unpacked = stream.read(limit + 1)
                check_bytes("unpacked pose file", file, len(unpacked), max_bytes)
                return unpacked
    except (OSError, EOFError, zlib.error, lzma.LZMAError) as error:
        raise ValueError(
            f"pose file must unpack: got {str(file)!r} ({error}); it is cut or damaged: make or "
            "download it again."
        ) from error
    return content


def _archive(file: Path, content: bytes, max_bytes: int | None) -> Container:
    with _damage(file):
        archive = open_archive(io.BytesIO(content))
        members = archive.infolist()
    roots = [m.filename[: -len("data.pkl")] for m in members if m.filename.endswith("/data.pkl")]
    if roots:
        size = sum(member.file_size for member in members)
        check_bytes("the members of pose file", file, size, max_bytes)
        with _damage(file):
            value = _torch_archive(file, archive, roots[0], max_bytes)
        return Container(file, "torch", value, as_torch_archive)
    tree, total = {}, 0
    for member in members:
        name = member.filename.removesuffix(".npy")
        if name == member.filename:
            continue
        if name in tree:
            raise ValueError(f"pose file must hold {name} once: got {str(file)!r} with several.")
        with named_field(name, str(file)):
            shape, _, dtype = array_header(archive, member, len(content), objects=True)
            total += int(np.prod(shape, dtype=object)) * max(dtype.itemsize, 8)
            what = f"{name} in" if len(members) == 1 else f"arrays up to {name} in"
            check_bytes(what, file, total, max_bytes)
            data = archive.read(member)
        tree[name] = _member(file, name, data, max_bytes)
    if not tree:
        raise ValueError(
            f"pose file must be an .npz archive: got {str(file)!r}, a zip archive without arrays; "
            "unpack it first."
        )
    return Container(file, "npz", tree, _as_npz)


def _torch_archive(file: Path, archive: zipfile.ZipFile, root: str, max_bytes: int | None) -> Any:
    """What `torch.save` wrote (pytorch/pytorch, torch/serialization.py)."""
    names = set(archive.namelist())
    if root + "byteorder" in names and archive.read(root + "byteorder").strip() == b"big":
        raise ValueError("its numbers have their bytes in the other order")
    storages: dict[str, np.ndarray] = {}

    def storage(pid: Any) -> np.ndarray:
        _, kind, key, _, count = pid
        if key not in storages:
            storages[key] = as_storage(kind, archive.read(f"{root}data/{key}"), int(count))
        return storages[key]

    content = archive.read(root + "data.pkl")
    return unpickled(content, file, max_bytes=max_bytes, storage=storage)


def _member(file: Path, name: str, content: bytes, max_bytes: int | None) -> Any:
    """The array of an .npy; one of objects is a pickle, and one object is that object."""
    stream = io.BytesIO(content)
    with named_field(name, str(file)):
        shape, fortran, dtype = npy_header(stream, len(content), objects=True)
        if not dtype.hasobject:
            flat = np.frombuffer(bytearray(stream.read()), dtype)
            if not len(content) - stream.tell() and not flat.size:
                flat = np.zeros(math.prod(shape), dtype)
            return flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
    try:
        array = _dense(file, unpickled(content[stream.tell() :], file, max_bytes=max_bytes))
    except RefusedPickleError as error:
        return Unread(str(error))  # whatever else the file holds may do without it
    if not isinstance(array, np.ndarray) or array.shape != shape:
        raise ValueError(
            f"{name} in {file} must hold what its header says, {shape}; the file is damaged: make "
            "or download it again."
        )
    return array.item() if array.shape == () else array


class Unread(str):
    """Why an array was not read; it is left out where the file is written again."""


@contextmanager
def _damage(file: Path) -> Iterator[None]:
    """Turn what zipfile and NumPy raise at damaged bytes into an error with the file's name."""
    try:
        yield
    except (TooLargeError, RefusedPickleError, MemoryError, RecursionError):
        raise
    except DAMAGE as error:
        if isinstance(error, ValueError) and str(file) in str(error):
            raise
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"pose file must be whole: got {str(file)!r} ({what}); it is cut or damaged: make or "
            "download it again."
        ) from error


def _dense(file: Path, tree: Any) -> Any:
    """The tree with arrays in place of chumpy's and SciPy's; each container is looked at once."""
    root = [tree]
    left: list[Any] = [root]
    seen = set()
    with _damage(file):
        while left:
            node = left.pop()
            if id(node) in seen:
                continue
            seen.add(id(node))
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                if isinstance(value, StandIn):
                    node[key] = plain(value)
                elif isinstance(value, dict | list) or (
                    isinstance(value, np.ndarray) and value.dtype.hasobject and value.ndim == 1
                ):
                    left.append(value)
    return root[0]


def _as_npz(tree: Mapping[str, Any]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, value in tree.items():
            if not isinstance(value, Unread):
                archive.writestr(f"{name}.npy", _as_npy(value))
    return stream.getvalue()


def _as_npy(value: Any) -> bytes:
    stream = io.BytesIO()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        np.lib.format.write_array(stream, value, allow_pickle=False)
        return stream.getvalue()
    array = value if isinstance(value, np.ndarray) else np.empty((), object)
    if array is not value:
        array[()] = value
    header = {"descr": "|O", "fortran_order": False, "shape": array.shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + as_pickle(np.ascontiguousarray(array).reshape(array.shape), 4)


def _as_json(tree: Any) -> bytes:
    return (json.dumps(tree, indent=1) + "\n").encode()
