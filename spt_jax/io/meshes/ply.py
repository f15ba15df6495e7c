"""Stanford .ply: vertices, and polygons or triangle strips, with whatever stands beside them.

trimesh 5.2 refuses binary files in which polygons differ in size, takes a file of triangle strips
for a point cloud, cuts every polygon into a fan, and splits vertices where texture coordinates
differ.
"""

import numpy as np

from spt_jax.io.meshes.ply_elements import TYPE_NAMES, Element, Lists, read_elements
from spt_jax.io.meshes.polygons import polygon_triangles
from spt_jax.io.meshes.raw import (
    RawMesh,
    UnreadableError,
    checked_corners,
    crossing_notes,
    holds_double,
)

_CORNERS = ("vertex_indices", "vertex_index")
_EXTRAS = {
    "texture coordinates": {"s", "t", "u", "v", "texture_u", "texture_v", "texcoord"},
    "colors": {"red", "green", "blue", "diffuse_red"},
    "normals": {"nx", "ny", "nz"},
}


def read_ply(content: bytes) -> RawMesh:
    """The mesh of a .ply file.

    Raises:
        UnreadableError: it is none, cut or damaged.
    """
    listed, comments, said = read_elements(content)
    elements = {element.name: element for element in listed}
    vertex = elements.get("vertex", Element("vertex", 0))
    for axis in "xyz":
        if vertex.length and not isinstance(vertex.data.get(axis), np.ndarray):
            raise UnreadableError(
                f"its vertices must have x, y and z: got {', '.join(vertex.data)}"
            )
    if vertex.length:
        columns = [np.asarray(vertex.data[axis], np.float64) for axis in "xyz"]
        points = np.stack(columns, axis=1)
        double = any(vertex.types[axis][1] == "f8" for axis in "xyz") and holds_double(points)
    else:
        points, double = np.zeros((0, 3)), False
    face = elements.get("face", Element("face", 0))
    key = next((name for name in _CORNERS if isinstance(face.data.get(name), Lists)), None)
    if key is None and face.length:
        raise UnreadableError(f"its faces must have vertex_indices: got {', '.join(face.data)}")
    corners = _lists(face, key)
    flat = checked_corners(corners.values, len(points))
    places, owner, crossed = polygon_triangles(points, flat, corners.counts)
    strips = _strip_triangles(elements, len(points))
    faces = np.concatenate([flat[places], strips])
    notes = crossing_notes(crossed, int((corners.counts < 3).sum()))
    left = [
        e.name for e in listed if e.length and e.name not in ("vertex", "face", "tristrips", "edge")
    ]

    def rewrite(moved: np.ndarray) -> bytes:
        return _written(vertex, face, key, places, owner, strips, flat, comments, moved)

    return RawMesh(
        points,
        faces,
        double=double,
        extras=tuple(
            name for name, keys in _EXTRAS.items() if keys & (vertex.types | face.types).keys()
        ),
        notes=said + notes + tuple(f"its {name!r} are left out" for name in left),
        rewrite=rewrite,
        companions=tuple(
            words[2].strip()
            for comment in comments
            if len(words := comment.split(maxsplit=2)) == 3 and words[1].lower() == "texturefile"
        ),
        lines=elements["edge"].length if "edge" in elements else 0,
    )


def _strip_triangles(elements: dict[str, Element], count: int) -> np.ndarray:
    """The triangles of strips, each with the strip's sense; -1 ends a strip within a list."""
    strips = elements.get("tristrips", Element("tristrips", 0))
    found = [np.zeros((0, 3), np.int64)]
    for name in _CORNERS:
        lists = strips.data.get(name)
        if not isinstance(lists, Lists):
            continue
        ends = np.cumsum(lists.counts)
        for start, end in zip(ends - lists.counts, ends, strict=True):
            row = np.asarray(lists.values[start:end], np.int64)
            for strip in np.split(row, np.flatnonzero(row == -1)):
                strip = checked_corners(strip[strip != -1], count)
                k = np.arange(max(len(strip) - 2, 0))
                odd = k % 2
                trio = np.stack([strip[k], strip[k + 1 + odd], strip[k + 2 - odd]], axis=1)
                # A strip turns corners by triangles that repeat a vertex.
                found.append(trio[(trio != np.roll(trio, 1, axis=1)).all(axis=1)])
    return np.concatenate(found)


def _written(
    vertex: Element,
    face: Element,
    key: str | None,
    places: np.ndarray,
    owner: np.ndarray,
    strips: np.ndarray,
    flat: np.ndarray,
    comments: list[str],
    moved: np.ndarray,
) -> bytes:
    """The file with other positions, as binary, and triangles in place of polygons and strips."""
    number = "f4" if moved.dtype == np.float32 else "f8"
    header = ["ply", "format binary_little_endian 1.0", *comments, f"element vertex {len(moved)}"]
    columns: list[tuple[str, np.ndarray]] = []
    for name, (count, kind) in vertex.types.items():
        if count is not None:
            continue
        values = np.asarray(vertex.data[name])
        if name in "xyz":
            kind, values = number, moved[:, "xyz".index(name)]
        columns.append((kind, values))
        header.append(f"property {TYPE_NAMES[kind]} {name}")
    body = [_packed(columns)]
    triangles = np.concatenate([flat[places], strips]).astype("i4")
    header.append(f"element face {len(triangles)}")
    columns = [("u1", np.full(len(triangles), 3)), ("i4", triangles)]
    header.append(f"property list uchar int {key or _CORNERS[0]}")
    for name, (_, kind) in face.types.items():
        data = face.data[name]
        if name == key or len(strips):  # strips have nothing to go by
            continue
        if isinstance(data, Lists):
            if not (data.counts == 2 * _lists(face, key).counts).all():
                continue
            # Two texture coordinates a corner.
            columns += [
                ("u1", np.full(len(triangles), 6)),
                (kind, data.values.reshape(-1, 2)[places]),
            ]
            header.append(f"property list uchar {TYPE_NAMES[kind]} {name}")
        else:
            columns.append((kind, np.asarray(data)[owner]))
            header.append(f"property {TYPE_NAMES[kind]} {name}")
    header.append("end_header")
    return ("\n".join(header) + "\n").encode("latin-1") + b"".join([*body, _packed(columns)])


def _lists(element: Element, key: str | None) -> Lists:
    found = element.data.get(key or "")
    return found if isinstance(found, Lists) else Lists(np.zeros(0, np.int64), np.zeros(0))


def _packed(columns: list[tuple[str, np.ndarray]]) -> bytes:
    rows = len(columns[0][1]) if columns else 0
    kinds = [(f"f{k}", "<" + kind, values.shape[1:]) for k, (kind, values) in enumerate(columns)]
    packed = np.zeros(rows, kinds)
    for k, (_, values) in enumerate(columns):
        packed[f"f{k}"] = values
    return packed.tobytes()
