"""Stereolithography, .stl: three corners for each triangle, as text or binary.

trimesh 5.2 takes a binary file with a byte too many for text, leaves out a solid that ends with
"end solid", and lets the numbers of a damaged line slip into the next vertex.
"""

import re

import numpy as np

from spt_jax.io.meshes.raw import RawMesh, UnreadableError, holds_double

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# A triangle of a text as almost all programs write it; None stands for a number.
_LAYOUT = (
    *(b"facet", b"normal", None, None, None, b"outer", b"loop"),
    *(b"vertex", None, None, None) * 3,
    *(b"endloop", b"endfacet"),
)
_PLACES = [7 + 4 * corner + 1 + axis for corner in range(3) for axis in range(3)]
_NAMES = re.compile(rb"^[ \t]*(end[ \t]*)?solid\b[^\r\n]*", re.M | re.I)
_LOOP = re.compile(rb"outer\s+loop(.*?)end\s*loop", re.S | re.I)
_LONGEST_END = 2**16  # of what follows the last triangle
_NUMBER = rb"[-+.0-9a-zA-Z]+"
_CORNERS = re.compile(
    rb"\s*" + rb"\s+".join([rb"vertex" + 3 * (rb"\s+(" + _NUMBER + rb")")] * 3) + rb"\s*", re.I
)


def read_stl(content: bytes) -> RawMesh:
    """The triangles of an .stl file, none sharing a vertex.

    Raises:
        UnreadableError: it is cut, or damaged.
    """
    announced = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    expected = 84 + 50 * announced
    text = (
        content[:512].lstrip().lower().startswith(b"solid") and b"facet" in content[:2048].lower()
    )
    if announced >= 0 and (len(content) == expected or not text):
        return _binary(content, announced, expected)
    if not content.lstrip()[:5].lower() == b"solid":
        raise UnreadableError(
            "it is neither a binary .stl, which has 84 bytes at least, nor a text"
        )
    return _text(content)


def _binary(content: bytes, announced: int, expected: int) -> RawMesh:
    if len(content) < expected:
        raise UnreadableError(
            f"it announces {announced:,} triangles, {expected:,} bytes, and has {len(content):,}; "
            "it is cut"
        )
    facets = np.frombuffer(content, _FACET, announced, 84)
    notes = ()
    if len(content) > expected:
        notes = (f"{len(content) - expected:,} bytes after the last triangle are left out",)
    extras = ("attributes or colors of triangles",) if facets["attribute"].any() else ()
    corners = facets["corners"].reshape(-1, 3).astype(np.float64)
    return RawMesh(corners, _in_threes(corners), extras=extras, notes=notes)


def _text(content: bytes) -> RawMesh:
    end = content[-_LONGEST_END:].lower()
    if not re.search(rb"end\s*solid", end[max(end.rfind(b"facet"), 0) :]):
        raise UnreadableError("it does not end with endsolid; it is cut")
    words = _NAMES.sub(b" ", content).split()
    regular = (
        bool(words)
        and len(words) % len(_LAYOUT) == 0
        and all(
            word is None or set(words[k :: len(_LAYOUT)]) <= {word}
            for k, word in enumerate(_LAYOUT)
        )
    )
    if regular:
        columns = [words[k :: len(_LAYOUT)] for k in _PLACES]
        numbers = [number for facet in zip(*columns, strict=True) for number in facet]
    else:
        numbers = _loops(content)
    try:
        vertices = np.array(list(map(float, numbers)), np.float64).reshape(-1, 3)
    except ValueError as error:
        raise UnreadableError(f"a vertex does not hold numbers ({error})") from None
    return RawMesh(vertices, _in_threes(vertices), double=holds_double(vertices))


def _loops(content: bytes) -> list[bytes]:
    """The corners' numbers of a text that is laid out in another way, or damaged."""
    numbers: list[bytes] = []
    loops = 0
    for loops, loop in enumerate(_LOOP.finditer(content), 1):
        corners = _CORNERS.fullmatch(loop[1])
        if corners is None:
            seen = b" ".join(loop[1].split())[:60].decode("latin-1")
            raise UnreadableError(f"triangle {loops - 1} must have three vertices: got {seen!r}")
        numbers += corners.groups()
    begun = len(re.findall(rb"outer\s+loop", content, re.I))
    if begun != loops:
        raise UnreadableError(f"triangle {loops} has no end; it is cut")
    return numbers


def _in_threes(corners: np.ndarray) -> np.ndarray:
    return np.arange(len(corners)).reshape(-1, 3)
