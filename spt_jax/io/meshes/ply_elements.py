"""Stanford .ply: its header, and the elements that it announces, as text or binary."""

import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from spt_jax.io.meshes.raw import UnreadableError

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "float32": "f4", "double": "f8"},
    **{"float64": "f8", "float16": "f2"},
}
TYPE_NAMES = {
    **{"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
    **{"i8": "int64", "u8": "uint64", "f2": "float16", "f4": "float", "f8": "double"},
}
_LONGEST_HEADER = 2**20


class Lists(NamedTuple):
    """A property that is a list in each row: how long each is, and all values, row after row."""

    counts: np.ndarray
    values: np.ndarray


@dataclass
class Element:
    """Rows of one kind, such as vertices; `data` has one array or `Lists` a property."""

    name: str
    length: int
    # By property: the type of a list's length, or None, and the values' type.
    types: dict[str, tuple[str | None, str]] = field(default_factory=dict)
    data: dict[str, "np.ndarray | Lists"] = field(default_factory=dict)


def read_elements(content: bytes) -> tuple[list[Element], list[str], tuple[str, ...]]:
    """The elements of a .ply file with their data, its comments, and what there is to say of it.

    Raises:
        UnreadableError: no header, or other data than it announces.
    """
    header, start = _header(content)
    comments = [line for line in header if line.startswith(("comment", "obj_info"))]
    elements: list[Element] = []
    order = None
    for line in header[1:]:
        words = line.split()
        try:
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[
                    words[1]
                ]
            elif words[0] == "element":
                elements.append(Element(words[1], int(words[2])))
                if elements[-1].length < 0:
                    raise ValueError
            elif words[0] == "property" and words[1] == "list":
                elements[-1].types[words[4]] = (_TYPES[words[2]], _TYPES[words[3]])
            elif words[0] == "property":
                elements[-1].types[words[2]] = (None, _TYPES[words[1]])
            else:
                raise KeyError
        except (KeyError, IndexError, ValueError):
            raise UnreadableError(f"its header has the line {line[:60]!r}") from None
    if order is None:
        raise UnreadableError("its header names no format")
    for element in elements:
        # A row takes a byte at least.
        if element.types and element.length > len(content) - start:
            raise UnreadableError(
                f"it announces {element.length:,} rows of {element.name!r} and has "
                f"{len(content) - start:,} bytes of data"
            )
    if order == "":
        return elements, comments, _read_text(elements, content[start:])
    source = _Binary(content, start, order)
    for element in elements:
        _read_rows(element, source)
    left = len(content) - source.place
    notes = (f"{left:,} bytes after the last row are left out",) if left else ()
    return elements, comments, notes


def _read_text(elements: list[Element], content: bytes) -> tuple[str, ...]:
    """Fill in the elements of a text: wherever its lines break, or else line by line."""
    source = _Text(content)
    problem = None
    try:
        for element in elements:
            _read_rows(element, source)
        if not source.left():
            return ()
    except UnreadableError as error:
        problem = error
    left = source.left()
    # Some programs write more into each line than their header says.
    lines = _Lines(source.numbers, content)
    if len(lines.starts) - 1 == sum(element.length for element in elements if element.types):
        for element in elements:
            _read_rows(element, lines)
        return ("numbers at the ends of lines that its header does not name are left out",)
    if problem is not None:
        raise problem
    return (f"{left:,} numbers after the last row are left out",)


def _header(content: bytes) -> tuple[list[str], int]:
    if content[:3] != b"ply" or content[3:4] not in (b"\n", b"\r"):
        raise UnreadableError('it must begin with a line "ply"')
    end = content.find(b"end_header", 0, _LONGEST_HEADER)
    if end < 0:
        raise UnreadableError('its header has no line "end_header"; it is cut')
    start = end + len(b"end_header")
    # As the first line ends, so does the header; a byte more would be the data's first.
    start += 2 if content[start : start + 2] == b"\r\n" else 1
    return content[:end].decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split(
        "\n"
    ), start


@functools.lru_cache(maxsize=256)  # where lists differ in length, rows are read one by one
def _packed_type(kinds: tuple[tuple[str, int], ...]) -> np.dtype:
    return np.dtype([(f"f{k}", kind, (count,)) for k, (kind, count) in enumerate(kinds)])


class _Text:
    """All numbers of a text, wherever its lines break."""

    def __init__(self, content: bytes):
        try:
            self.numbers = np.fromstring(content, sep=" ")
        except (ValueError, DeprecationWarning):
            raise UnreadableError("its data hold something else than numbers") from None
        self.place = 0

    def left(self) -> int:
        return len(self.numbers) - self.place

    def rows(self, kinds: list[tuple[str, int]], length: int) -> np.ndarray | None:
        dtype = _packed_type(tuple(("f8", count) for _, count in kinds))
        size = dtype.itemsize // 8 * length
        if size > self.left():
            return None
        found = self.numbers[self.place : self.place + size].view(dtype)
        self.place += size
        return found


class _Lines(_Text):
    """The same, where each row begins a line."""

    def __init__(self, numbers: np.ndarray, content: bytes):
        lengths = [len(fields) for line in content.splitlines() if (fields := line.split())]
        self.numbers, self.place, self.line = numbers, 0, 0
        self.starts = np.cumsum([0, *lengths])

    def begin_row(self) -> None:
        self.place, self.line = int(self.starts[self.line]), self.line + 1

    def rows(self, kinds: list[tuple[str, int]], length: int) -> np.ndarray | None:
        found = super().rows(kinds, length)
        return found if self.place <= self.starts[self.line] else None


class _Binary:
    """Packed rows."""

    def __init__(self, content: bytes, start: int, order: str):
        self.content, self.place, self.order = content, start, order

    def rows(self, kinds: list[tuple[str, int]], length: int) -> np.ndarray | None:
        dtype = _packed_type(tuple((self.order + kind, count) for kind, count in kinds))
        if dtype.itemsize * length > len(self.content) - self.place:
            return None
        found = np.frombuffer(self.content, dtype, length, self.place)
        self.place += dtype.itemsize * length
        return found


def _read_rows(element: Element, source: "_Text | _Binary") -> None:
    """Fill in an element's data: at once where all lists are as long as the first row's."""
    if not element.length or not element.types:
        element.data = {name: np.zeros(0, kind) for name, (_, kind) in element.types.items()}
        for name, (count, kind) in element.types.items():
            if count is not None:
                element.data[name] = Lists(np.zeros(0, np.int64), np.zeros(0, kind))
        return
    if isinstance(source, _Lines):
        _fill(element, [_row(element, source, row) for row in range(element.length)])
        return
    start = source.place
    sizes = _row(element, source, 0)[1]
    source.place = start
    kinds: list[tuple[str, int]] = []
    for size, (count, kind) in zip(sizes, element.types.values(), strict=True):
        kinds += ([] if count is None else [(count, 1)]) + [(kind, size)]
    rows = source.rows(kinds, element.length)
    if rows is not None and _uniform(element, rows, sizes):
        k = 0
        for size, (name, (count, kind)) in zip(sizes, element.types.items(), strict=True):
            k += count is not None
            values = _as_kind(element.name, name, rows[f"f{k}"].reshape(-1), kind)
            counts = np.full(element.length, size)
            element.data[name] = values if count is None else Lists(counts, values)
            k += 1
        return
    source.place = start
    if isinstance(source, _Binary) and sum(c is not None for c, _ in element.types.values()) == 1:
        _read_one_list(element, source)
        return
    _fill(element, [_row(element, source, row) for row in range(element.length)])


def _read_one_list(element: Element, source: _Binary) -> None:
    """Fill in an element whose rows have one list each, of differing lengths, quickly."""
    names = list(element.types)
    at = next(k for k, name in enumerate(names) if element.types[name][0] is not None)
    fixed = [(name, source.order + element.types[name][1]) for name in names if name != names[at]]
    before = sum(np.dtype(element.types[name][1]).itemsize for name in names[:at])
    after = sum(np.dtype(element.types[name][1]).itemsize for name in names[at + 1 :])
    count, kind = element.types[names[at]]
    count_type, item_type = np.dtype(source.order + str(count)), np.dtype(source.order + kind)
    if count_type.kind not in "iu":
        raise UnreadableError(f"{names[at]} of {element.name} counts its values by {count}")
    content, place, end = source.content, source.place, len(source.content)
    order = "little" if source.order == "<" else "big"
    width, signed = count_type.itemsize, count_type.kind == "i"
    counts, lists, scalars = [], [], []
    for row in range(element.length):
        first = place + before + width
        size = int.from_bytes(content[place + before : first], order, signed=signed)
        last = first + size * item_type.itemsize
        if size < 0 or last + after > end:
            raise UnreadableError(
                f"it ends at {element.name} {row} of {element.length:,}; it is cut"
            )
        counts.append(size)
        lists.append(content[first:last])
        scalars += [content[place : place + before], content[last : last + after]]
        place = last + after
    source.place = place
    values = np.frombuffer(b"".join(lists), item_type).astype(kind)
    rows = np.frombuffer(b"".join(scalars), fixed) if fixed else None
    for name in names:
        if name == names[at]:
            element.data[name] = Lists(np.array(counts, np.int64), values)
        elif rows is not None:
            element.data[name] = rows[name].astype(element.types[name][1])


def _fill(element: Element, found: list[tuple[list[np.ndarray], list[int]]]) -> None:
    for k, (name, (count, kind)) in enumerate(element.types.items()):
        values = np.concatenate([row[0][k] for row in found])
        values = _as_kind(element.name, name, values, kind)
        counts = np.array([row[1][k] for row in found], np.int64)
        element.data[name] = values if count is None else Lists(counts, values)


def _row(
    element: Element, source: "_Text | _Binary", row: int
) -> tuple[list[np.ndarray], list[int]]:
    """The values of the next row, property by property, and how many each has."""
    values, sizes = [], []
    if isinstance(source, _Lines):
        source.begin_row()
    for count, kind in element.types.values():
        size = 1
        if count is not None:
            length = source.rows([(count, 1)], 1)
            size = -1 if length is None else float(length["f0"].reshape(-1)[0])
            if length is not None and not (size >= 0 and size == int(size)):
                raise UnreadableError(f"{element.name} {row} announces a list of {size:g} values")
        # A list of more values than there are bytes is cut, whatever it holds.
        room = len(source.content if isinstance(source, _Binary) else source.numbers)
        found = source.rows([(kind, int(size))], 1) if 0 < size <= room else None
        if size == 0:
            found = np.zeros(1, [("f0", kind, (0,))])
        if found is None:
            raise UnreadableError(
                f"it ends at {element.name} {row} of {element.length:,}; it is cut"
            )
        values.append(found["f0"].reshape(-1))
        sizes.append(int(size))
    return values, sizes


def _uniform(element: Element, rows: np.ndarray, sizes: list[int]) -> bool:
    k = 0
    for size, (count, _) in zip(sizes, element.types.values(), strict=True):
        if count is not None:
            if (rows[f"f{k}"] != size).any():
                return False
            k += 1
        k += 1
    return True


def _as_kind(element: str, name: str, values: np.ndarray, kind: str) -> np.ndarray:
    """Values in their announced type; those of a text may not have it."""
    if values.dtype.kind == "f" and kind[0] in "iu":
        low, high = np.iinfo(kind).min, np.iinfo(kind).max
        wrong = ~((values == np.floor(values)) & (values >= low) & (values <= high))
        if wrong.any():
            raise UnreadableError(
                f"{name} of {element} must be whole numbers of the type {TYPE_NAMES[kind]}: got "
                f"{values[wrong][0]:g}"
            )
    with np.errstate(over="ignore"):
        return values.astype(kind)
