"""Wavefront .obj: positions are indexed apart from texture and normals, and so read as one surface.

trimesh 5.2 groups an .obj by material and splits it by texture coordinate, which loses the order of
the vertices; the file itself indexes positions apart from both.
"""

import re
from collections.abc import Sequence

import numpy as np

from spt_jax.io.meshes.polygons import polygon_triangles
from spt_jax.io.meshes.raw import (
    RawMesh,
    UnreadableError,
    checked_corners,
    crossing_notes,
    holds_double,
)

_EXTRAS = {"vt": "texture coordinates", "vn": "normals", "usemtl": "materials"}
_LINES = frozenset({"l", "curv", "curv2"})


def read_obj(content: bytes) -> RawMesh:
    """The mesh of an .obj file.

    Raises:
        UnreadableError: a vertex or a face that is none; the message says the line.
    """
    # Latin-1 gives every byte back as it was.
    text = re.sub(r"\\\r?\n", " ", content.decode("latin-1"))
    lines = re.split(r"\r\n|\n|\r", text)
    positions: list[list[float]] = []
    corners: list[int] = []
    counts: list[int] = []
    vertex_lines: list[int] = []
    face_lines: list[int] = []
    extras: dict[str, None] = {}
    libraries: list[str] = []
    short = curves = surfaces = 0
    for number, line in enumerate(lines):
        kind, *fields = line.partition("#")[0].split() or [""]
        try:
            if kind == "v":
                x, y, z = map(float, fields[:3])
                positions.append([x, y, z])
                vertex_lines.append(number)
                if len(fields) >= 6:
                    extras["vertex colors"] = None
            elif kind == "f":
                polygon = [int(field.partition("/")[0]) for field in fields]
                if len(polygon) < 3:
                    short += 1
                    continue
                if 0 in polygon:
                    raise ValueError("indices count from 1")
                # Indices count from 1, or back from the last vertex so far.
                corners += [i - 1 if i > 0 else len(positions) + i for i in polygon]
                counts.append(len(polygon))
                face_lines.append(number)
        except ValueError as error:
            raise UnreadableError(f"line {number + 1} is {line.strip()[:60]!r} ({error})") from None
        if kind in _EXTRAS:
            extras[_EXTRAS[kind]] = None
        elif kind == "mtllib":
            libraries.append(line.split(maxsplit=1)[1].strip() if fields else "")
        curves += kind in _LINES
        surfaces += kind == "surf"
    vertices = np.array(positions, np.float64).reshape(-1, 3)
    flat = checked_corners(corners, len(vertices))
    places, polygons, crossed = polygon_triangles(vertices, flat, np.array(counts, np.int64))

    def rewrite(moved: np.ndarray) -> bytes:
        written = list(lines)
        for number, position in zip(vertex_lines, moved.tolist(), strict=True):
            rest = lines[number].partition("#")[0].split()[4:]
            written[number] = " ".join(["v", *map(repr, position), *rest])
        _cut_faces(written, face_lines, counts, places, polygons)
        return "\n".join(written).encode("latin-1")

    notes = crossing_notes(crossed, short)
    if surfaces:
        notes += (f"{surfaces} free-form surfaces are left out; export the mesh of triangles",)
    return RawMesh(
        vertices,
        flat[places],
        double=holds_double(vertices),
        extras=tuple(extras),
        notes=notes,
        rewrite=rewrite,
        companions=tuple(name for name in libraries if name),
        lines=curves,
    )


def _cut_faces(
    written: list[str],
    face_lines: Sequence[int],
    counts: Sequence[int],
    places: np.ndarray,
    polygons: np.ndarray,
) -> None:
    """Replace each polygon's line by those of its triangles, which keep the corners' indices."""
    starts = np.cumsum(counts) - counts
    for polygon in np.flatnonzero(np.asarray(counts) > 3).tolist():
        number = face_lines[polygon]
        fields = written[number].partition("#")[0].split()[1:]
        first, last = np.searchsorted(polygons, [polygon, polygon + 1])
        cut = places[first:last] - starts[polygon]
        written[number] = "\n".join(
            f"f {fields[a]} {fields[b]} {fields[c]}" for a, b, c in cut.tolist()
        )
