"""Object file format, .off: positions and polygons, with colors or not.

trimesh 5.2 fails at polygons of five corners or more, and cuts quadrilaterals that are not convex
on the wrong side.
"""

import re

import numpy as np

from spt_jax.io.meshes.polygons import polygon_triangles
from spt_jax.io.meshes.raw import (
    RawMesh,
    UnreadableError,
    checked_corners,
    crossing_notes,
    holds_double,
)

_HEADER = re.compile(r"(ST)?(C)?(N)?(4)?(n)?OFF")


def read_off(content: bytes) -> RawMesh:
    """The mesh of a text .off file: OFF, COFF, NOFF, STOFF and their combinations.

    Raises:
        UnreadableError: another kind, counts that the lines do not have, or a line that is none.
    """
    lines = re.split(r"\r\n|\n|\r", content.decode("latin-1"))
    rows = [fields for line in lines if (fields := line.partition("#")[0].split())]
    header = _HEADER.match(rows[0][0]) if rows else None
    if header is None:
        raise UnreadableError("it must begin with OFF")
    texture, color, normal, four, dimension = header.groups()
    if four or dimension:
        raise UnreadableError(f"{header[0]} has points in another space than that of three axes")
    if "BINARY" in rows[0]:
        raise UnreadableError("it is a binary .off; save it as text")
    # The counts may follow at once, or on the next line.
    rest = [field for field in (rows[0][0][header.end() :], *rows[0][1:]) if field]
    rows = ([rest] if rest else []) + rows[1:]
    try:
        vertex_count, face_count = (int(field) for field in rows[0][:2])
        if vertex_count < 0 or face_count < 0:
            raise ValueError
    except (ValueError, IndexError):
        raise UnreadableError("the numbers of vertices and faces must follow OFF") from None
    if vertex_count + face_count > len(content):
        raise UnreadableError(
            f"it announces {vertex_count:,} vertices and {face_count:,} faces and has "
            f"{len(rows) - 1:,} lines"
        )
    width = 3 + 3 * bool(normal)
    points, at = _rows(rows, 1, vertex_count, lambda fields: width, "vertex")
    polygons, at = _rows(rows, at, face_count, lambda fields: 1 + int(fields[0]), "face")
    try:
        vertices = np.array([float(field) for row in points for field in row[:3]]).reshape(-1, 3)
        counts = np.array([int(row[0]) for row in polygons], np.int64)
        corners = [
            int(field) for row, n in zip(polygons, counts, strict=True) for field in row[1 : 1 + n]
        ]
    except ValueError as error:
        raise UnreadableError(f"a line does not hold numbers ({error})") from None
    if (counts < 0).any():
        raise UnreadableError(f"a face announces {counts.min()} corners")
    flat = checked_corners(corners, len(vertices))
    places, owner, crossed = polygon_triangles(vertices, flat, counts)
    triangles = flat[places]

    def rewrite(moved: np.ndarray) -> bytes:
        written = [header[0], f"{len(moved)} {len(triangles)} 0"]
        for position, row in zip(moved.tolist(), points, strict=True):
            written.append(" ".join([*map(repr, position), *row[3:]]))
        for corner, polygon in zip(triangles.tolist(), owner.tolist(), strict=True):
            tail = polygons[polygon][1 + counts[polygon] :]
            written.append(" ".join(["3", *map(str, corner), *tail]))
        return ("\n".join(written) + "\n").encode("latin-1")

    tails = any(len(row) > 1 + n for row, n in zip(polygons, counts, strict=True))
    extras = {
        "vertex colors": bool(color),
        "texture coordinates": bool(texture),
        "normals": bool(normal),
        "face colors": tails,
    }
    return RawMesh(
        vertices,
        triangles,
        double=holds_double(vertices),
        extras=tuple(name for name, there in extras.items() if there),
        notes=crossing_notes(crossed, int((counts < 3).sum())),
        rewrite=rewrite,
    )


def _rows(rows, start: int, count: int, width, what: str) -> tuple[list[list[str]], int]:
    """So many rows of at least `width(row)` fields, each of one line or of several."""
    found = []
    for k in range(count):
        fields: list[str] = []
        while not fields or len(fields) < width(fields):
            if start >= len(rows):
                raise UnreadableError(f"it ends at {what} {k} of {count}; it is cut")
            try:
                fields = fields + rows[start]
                width(fields)
            except ValueError:
                raise UnreadableError(f"{what} {k} is {' '.join(fields)[:60]!r}") from None
            start += 1
        found.append(fields)
    return found, start
