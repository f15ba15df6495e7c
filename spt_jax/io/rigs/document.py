"""A glTF file opened: its JSON, its buffers, and its accessors as arrays.

The specification is Khronos' glTF 2.0. No library reads it for us: pygltflib decodes no accessor
and checks nothing (of a file cut at a hundred places it reads 98, and it follows paths out of the
folder), and what its classes do not name is gone from a file that went through it; trimesh knows no
skins, and what it decodes is neither normalized nor sparse (`python -m benchmarks.gltf_readers`).
So the JSON stays a tree of dictionaries, and what is written differs from what was read by what was
added.
"""

import base64
import binascii
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spt_jax.files.limits import check_bytes, read_bytes
from spt_jax.io.meshes.gltf_check import check_extensions, file_of_uri, gltf_tree
from spt_jax.io.meshes.raw import UnreadableError

WHAT = "rig file"
SUFFIXES = (".glb", ".gltf", ".vrm")

DTYPES = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
"""Of each component type."""
_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True, eq=False)
class Document:
    """An opened file.

    Attributes:
        path: the file.
        tree: its JSON.
        buffers: the bytes of each buffer.
        max_bytes: what the file and its arrays may take; None for the default.
    """

    path: Path
    tree: dict[str, Any]
    buffers: tuple[bytes, ...]
    max_bytes: int | None

    def items(self, kind: str) -> list[dict[str, Any]]:
        """All objects of a kind, such as "nodes".

        Raises:
            UnreadableError: it is no list of objects.
        """
        found = self.tree.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise UnreadableError(f"{kind} must be a list of objects")
        return found

    def item(self, kind: str, index: Any, where: str) -> dict[str, Any]:
        """The object that an index names.

        Raises:
            UnreadableError: it names none.
        """
        found = self.items(kind)
        return found[checked_index(index, len(found), f"{where} must be one of the {kind}")]

    def array(self, index: Any, kind: str, where: str) -> np.ndarray:
        """What an accessor holds: float64 of numbers and of normalized ones, int64 of others.

        Args:
            index: of the accessor.
            kind: "SCALAR", "VEC3", ...: what it must be.
            where: the field that names it, for messages.

        Returns:
            A row an element; one number each where it is a scalar.

        Raises:
            UnreadableError: it announces more than there is, has another type, or values that are
                not finite.
        """
        accessor = self.item("accessors", index, where)
        if accessor.get("type") != kind:
            raise UnreadableError(f"{where} must be a {kind}: got {accessor.get('type')!r}")
        count, dtype = accessor["count"], _dtype(accessor.get("componentType"), where)
        width = _NUMBERS[kind]
        if "bufferView" in accessor:
            values = self._rows(accessor, count, width, dtype, where)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values, accessor["sparse"], dtype, where)
        if accessor.get("normalized") and dtype.kind != "f":
            found = np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        else:
            found = values.astype(np.float64 if dtype.kind == "f" else np.int64)
        if not np.isfinite(found).all():
            row = int(np.flatnonzero(~np.isfinite(found).all(axis=1))[0])
            raise UnreadableError(f"{where} must be finite: got {found[row].tolist()} at {row}")
        return found[:, 0] if width == 1 else found

    def as_glb(self) -> bytes:
        """The file as a .glb of one buffer."""
        (data,) = self.buffers
        text = json.dumps(self.tree, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        data += b"\0" * (-len(data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _with_sparse(self, values, sparse: dict[str, Any], dtype: np.dtype, where: str):
        count = checked_count(sparse["count"], f"the sparse count of {where}")
        kind = _dtype(sparse["indices"].get("componentType"), where)
        at = self._rows(sparse["indices"], count, 1, kind, where)[:, 0].astype(np.int64)
        if len(at) and not 0 <= at.min() <= at.max() < len(values):
            raise UnreadableError(f"the sparse indices of {where} must be below {len(values)}")
        values = values.copy()
        values[at] = self._rows(sparse["values"], count, values.shape[1], dtype, where)
        return values

    def _rows(self, holder: dict[str, Any], count: int, width: int, dtype: np.dtype, where: str):
        """Elements of a buffer view, once they lie within it, and it within its buffer."""
        view = self.item("bufferViews", holder["bufferView"], f"the bufferView of {where}")
        buffers = len(self.buffers)
        which = checked_index(view.get("buffer"), buffers, f"the buffer of {where} must exist")
        start = checked_count(view.get("byteOffset", 0), f"the byteOffset of {where}")
        length = checked_count(view.get("byteLength"), f"the byteLength of {where}")
        offset = checked_count(holder.get("byteOffset", 0), f"the byteOffset of {where}")
        element = width * dtype.itemsize
        stride = checked_count(view.get("byteStride", element), f"the byteStride of {where}")
        needed = offset + (stride * (count - 1) + element if count else 0)
        there = min(length, len(self.buffers[which]) - start)
        if stride < element or needed > there:
            raise UnreadableError(
                f"{where} announces {count:,} elements of {element} bytes, {needed:,} bytes of a "
                f"view that has {max(there, 0):,}; the file is cut or damaged, export it again"
            )
        return np.ndarray(
            (count, width),
            dtype,
            self.buffers[which],
            start + offset,
            (stride, dtype.itemsize),
        )


def open_document(path: Path, max_bytes: int | None) -> Document:
    """A .glb, .gltf or .vrm file with its buffers; nothing is allocated by an announced size.

    Raises:
        UnreadableError, ValueError: it is damaged, or needs what is not read.
        TooLargeError: it announces more than the limit.
        OSError: it cannot be read.
    """
    content = read_bytes(path, WHAT, max_bytes=max_bytes)
    # A .vrm is a .glb by another name.
    tree = gltf_tree(content, path.with_suffix(".glb") if path.suffix.lower() == ".vrm" else path)
    check_extensions(tree)
    document = Document(path, tree, (), max_bytes)
    total = 0
    for number, accessor in enumerate(document.items("accessors")):
        count = checked_count(accessor.get("count"), f"the count of accessor {number}")
        total += 8 * count * _NUMBERS.get(str(accessor.get("type")), 1)  # worked on as float64
    check_bytes(f"the arrays of {WHAT}", path, total, max_bytes)
    return Document(path, tree, _buffers(document, content), max_bytes)


def _buffers(document: Document, content: bytes) -> tuple[bytes, ...]:
    found, total = [], 0
    for number, buffer in enumerate(document.items("buffers")):
        uri, where = buffer.get("uri"), f"buffer {number}"
        if uri is None:
            data = _binary_chunk(content)
        elif not isinstance(uri, str):
            raise UnreadableError(f"the uri of {where} must be a text: got {uri!r}")
        elif uri.startswith("data:"):
            data = decoded(uri, where)
        else:
            file = file_of_uri(uri, document.path.parent, where)
            data = read_bytes(file, "buffer of rig file", max_bytes=document.max_bytes)
        length = checked_count(buffer.get("byteLength"), f"the byteLength of {where}")
        if length > len(data):
            raise UnreadableError(
                f"{where} announces {length:,} bytes and has {len(data):,}; the file is cut, copy "
                "or export it again"
            )
        total += len(data)
        check_bytes(f"the buffers of {WHAT}", document.path, total, document.max_bytes)
        found.append(data[:length])
    return tuple(found)


def decoded(uri: str, where: str) -> bytes:
    """The bytes of a data URI.

    Raises:
        UnreadableError: it is not in base64, or damaged.
    """
    kind, _, text = uri.partition(",")
    if not kind.endswith(";base64"):
        raise UnreadableError(f"{where} must be in base64: got {kind[:80]!r}")
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise UnreadableError(f"{where} must be in base64: got {error}") from None


def _binary_chunk(content: bytes) -> bytes:
    """The second chunk of a .glb; nothing where there is none."""
    if content[:4] != b"glTF":
        return b""
    at = 20 + int.from_bytes(content[12:16], "little")
    if content[at + 4 : at + 8] != b"BIN\0":
        return b""
    return content[at + 8 : at + 8 + int.from_bytes(content[at : at + 4], "little")]


def checked_index(value: Any, count: int, rule: str) -> int:
    """A whole number from 0 to below a count.

    Raises:
        UnreadableError: it is none; the message begins with the rule.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < count:
        raise UnreadableError(f"{rule}: got {value!r} of {count}, counted from 0; export it again")
    return value


def checked_count(value: Any, what: str) -> int:
    """A whole number that is not negative.

    Raises:
        UnreadableError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise UnreadableError(f"{what} must be a whole number, not negative: got {value!r}")
    return value


def _dtype(component: Any, where: str) -> np.dtype:
    if component not in DTYPES:
        raise UnreadableError(f"the componentType of {where} must be glTF's: got {component!r}")
    return DTYPES[component]
