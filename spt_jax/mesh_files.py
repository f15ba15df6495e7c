"""Triangle meshes read from and written to files."""

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from spt_jax.output_files import atomic_write

BODY_COLOUR = (213, 201, 188)
OUT_COLOUR = (222, 58, 24)
IN_COLOUR = (0, 114, 178)

# What rounding to float32 may move vertices by, against the size of the mesh, and not be seen: near
# the origin it does by a tenth of that.
_MOST_ROUNDING = 1e-6

# Formats that cannot share a vertex between triangles, or that split it along texture and normal
# seams. The others (PLY, OFF, ...) index their vertices, so their topology is taken as it stands.
_SPLIT_FORMATS = frozenset({".stl", ".obj", ".glb", ".gltf", ".dae", ".3mf"})


def write_mesh(
    path: str | os.PathLike[str],
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    labels: Int[Array | np.ndarray, " V"] | None = None,
) -> None:
    """Write a mesh as .glb or .ply, atomically, with one colour a vertex that other programs show.

    V_0 is warm grey, V_out (+1) vermillion, V_in (-1) blue. A .ply stores positions as float32
    where that holds all of them exactly, else as float64. A .glb, which knows float32 alone, stores
    them so; of a mesh far from the origin about its middle, and that as a node's translation. glTF
    defines vertex colours as linear light, so a .glb holds the same colours linearised.

    Args:
        path: the file; its suffix chooses the format.
        vertices: positions, in any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        labels: 0, +1 or -1 for each vertex; all 0 when None.

    Raises:
        ValueError: another suffix, or arrays that do not make a mesh.
        OSError: as in `atomic_write`.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> from spt_jax.mesh_files import read_mesh, write_mesh
        >>> corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_mesh(pathlib.Path(folder) / "tetrahedron.ply", corners, faces)
        ...     print(read_mesh(pathlib.Path(folder) / "tetrahedron.ply")[1].tolist())
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    suffix = Path(path).suffix.lower()
    if suffix not in (".glb", ".ply"):
        raise ValueError(f"path must end in .glb or .ply: got {str(path)!r}")
    points, triangles, classes = as_mesh_arrays(vertices, faces, labels)
    colours = np.array([BODY_COLOUR, OUT_COLOUR, IN_COLOUR], dtype=np.uint8)[classes]
    if suffix == ".glb":
        colours = _linear_light(colours)
    rgba = np.concatenate([colours, np.full((len(colours), 1), 255, np.uint8)], axis=1)
    if suffix == ".glb":
        middle = np.eye(4)
        if not fits_single(points):
            middle[:3, 3] = (points.min(axis=0) + points.max(axis=0)) / 2
        mesh = trimesh.Trimesh(points - middle[:3, 3], triangles, vertex_colors=rgba, process=False)
        scene = trimesh.Scene()
        scene.add_geometry(mesh, transform=middle)
        content = export_glb(scene, tree_postprocessor=_add_light_material)
    else:
        content = _as_ply(points, triangles, rgba)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def read_mesh(
    path: str | os.PathLike[str],
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return (vertices, faces) of a mesh file of any kind that trimesh reads, as float64 and int64.

    A scene's meshes are concatenated, each moved by its own transform. Vertices and faces keep the
    file's order. In formats that split vertices (.stl, .obj, .glb, .gltf, .dae, .3mf), vertices at
    exactly the same position are joined where their triangles do not meet yet, and triangles that
    collapse thereby are dropped: so a closed surface reads as closed, while closed parts that
    merely touch stay apart (not in .stl, which has nothing to tell them by). Nothing else is
    merged, repaired or reordered.

    Args:
        path: the file; its suffix names the format.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an unknown suffix, an unreadable file, one without triangles (a point cloud,
            a curve, an empty mesh), or one that holds NaN.

    Example:
        >>> import pathlib, tempfile
        >>> import trimesh
        >>> from spt_jax.mesh_files import read_mesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "box.stl"
        ...     _ = trimesh.creation.box().export(file)
        ...     vertices, faces = read_mesh(file)
        >>> vertices.shape, faces.shape  # an .stl holds three corners for each triangle
        ((8, 3), (12, 3))
    """
    import trimesh
    from trimesh.exchange.load import mesh_formats

    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"mesh file must exist: got {str(path)!r}; check the spelling")
    if not file.is_file():
        raise ValueError(f"mesh file must be a file: got the folder {str(path)!r}")
    suffix = file.suffix.lower()
    if suffix[1:] not in mesh_formats():
        raise ValueError(
            f"mesh file must have a suffix that trimesh reads: got {file.name!r}; "
            "convert it to .ply, .obj, .stl, .off or .glb"
        )
    try:
        if suffix == ".obj":
            parts = [trimesh.Trimesh(*_read_obj(file), process=False)]
        else:
            options: dict[str, Any] = (
                {"skip_materials": True} if suffix in (".glb", ".gltf") else {}
            )
            parts = trimesh.load_scene(file, process=False, **options).dump()
    except Exception as error:  # each loader fails in its own way; all mean the same here
        raise ValueError(
            f"mesh file must be a readable {suffix} file: got {str(path)!r} "
            f"({type(error).__name__}: {error})"
        ) from error
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not meshes:
        seen = ", ".join(type(part).__name__ for part in parts) or "nothing"
        raise ValueError(
            f"mesh file must hold triangles: got {str(path)!r} with {seen} and no faces; "
            "reconstruct a surface first"
        )
    points = np.concatenate([np.asarray(mesh.vertices, np.float64) for mesh in meshes])
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    indices = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    try:
        vertices, faces, _ = as_mesh_arrays(points, np.concatenate(indices))
    except ValueError as error:
        raise ValueError(f"mesh file must hold a mesh: got {str(path)!r} ({error})") from error
    return _close_seams(vertices, faces) if suffix in _SPLIT_FORMATS else (vertices, faces)


def as_mesh_arrays(
    vertices: Any, faces: Any, labels: Any = None
) -> tuple[
    Float[np.ndarray, "V 3"],
    Int[np.ndarray, "F 3"],
    Int[np.ndarray, " V"],
]:
    """Return (vertices float64, faces int64, labels int8) once they make one mesh.

    Raises:
        ValueError: a shape, a type, an index or a label that does not, or NaN or infinity.
    """
    points, triangles = np.asarray(vertices), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise ValueError(f"vertices must be (V, 3) numbers: got {points.dtype} {points.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must be (F, 3) integers: got {triangles.dtype} {triangles.shape}")
    if len(triangles) == 0:
        raise ValueError("faces must hold at least one triangle: got none")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise ValueError(f"vertices must be finite: got {points[row]} at vertex {row}")
    low, high = int(triangles.min()), int(triangles.max())
    if low < 0 or high >= len(points):
        raise ValueError(
            f"faces must index into vertices: got index {low if low < 0 else high} for "
            f"{len(points)} vertices; indices are 0-based"
        )
    classes = np.zeros(len(points), np.int8) if labels is None else np.asarray(labels)
    if classes.shape != (len(points),) or not np.isin(classes, (-1, 0, 1)).all():
        raise ValueError(
            f"labels must be 0, +1 or -1 for each of {len(points)} vertices: got "
            f"{classes.dtype} {classes.shape} with values {np.unique(classes)[:5]}"
        )
    return points.astype(np.float64), triangles.astype(np.int64), classes.astype(np.int8)


def single_rounding(vertices: Float[np.ndarray, "V 3"]) -> float:
    """How far float32 moves a coordinate at most; 0 where it holds all of them exactly."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(vertices.astype(np.float32) - vertices).max(initial=0.0))


def fits_single(vertices: Float[np.ndarray, "V 3"]) -> bool:
    """Whether float32 moves vertices by so little that nobody sees it."""
    with np.errstate(invalid="ignore"):
        size = np.ptp(vertices, axis=0).max(initial=0.0)
    return bool(single_rounding(vertices) <= _MOST_ROUNDING * size)


def _read_obj(file: Path) -> tuple[np.ndarray, np.ndarray]:
    # trimesh 5.2 groups an .obj by material and splits it by texture coordinate, which loses the
    # order of the vertices; the file itself indexes positions apart from both.
    positions, corners = [], []
    text = file.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
    for kind, *fields in filter(None, map(str.split, text.splitlines())):
        if kind == "v":
            positions.append([float(field) for field in fields[:3]])
        elif kind == "f":
            polygon = [int(field.split("/")[0]) for field in fields]
            # Indices count from 1, or back from the last vertex so far.
            polygon = [i - 1 if i > 0 else len(positions) + i if i < 0 else -1 for i in polygon]
            corners += [[polygon[0], *pair] for pair in pairwise(polygon[1:])]
    vertices = np.array(positions, np.float64).reshape(-1, 3)
    return vertices, np.array(corners, np.int64).reshape(-1, 3)


def _close_seams(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    # A split vertex always has an edge that finds no partner running the other way, so joining
    # only vertices on such edges closes every seam and leaves finished surfaces alone.
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edge, partner = tail * len(vertices) + head, head * len(vertices) + tail
    unpaired = ~np.isin(edge, partner)
    loose = np.unique(np.concatenate([tail[unpaired], head[unpaired]]))
    _, first, group = np.unique(
        vertices[loose] + 0.0,  # -0.0 becomes 0.0
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    stands_for = np.arange(len(vertices))
    stands_for[loose] = loose[first][group.ravel()]
    kept = stands_for == np.arange(len(vertices))
    joined = (np.cumsum(kept) - 1)[stands_for[faces]]
    collapsed = (joined == np.roll(joined, 1, axis=1)).any(axis=1)
    collapsed &= ~(faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return vertices[kept], joined[~collapsed]


def _as_ply(points: np.ndarray, triangles: np.ndarray, rgba: np.ndarray) -> bytes:
    # trimesh 5.2 writes float32 whatever it is given.
    number, name = ("<f8", "double") if single_rounding(points) else ("<f4", "float")
    corners = np.empty(len(points), [("position", number, 3), ("colour", "u1", 4)])
    corners["position"], corners["colour"] = points, rgba
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {name} {axis}" for axis in "xyz"),
        *(f"property uchar {part}" for part in ("red", "green", "blue", "alpha")),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + corners.tobytes() + faces.tobytes()


def _linear_light(colours: np.ndarray) -> np.ndarray:
    # The sRGB transfer function; glTF 2.0, section 3.7.2.1: COLOR_0 is linear.
    value = colours / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def _add_light_material(tree: dict[str, Any]) -> None:
    # Without a material glTF's default is fully metallic, which most viewers draw nearly black.
    surface = {"metallicFactor": 0.0, "roughnessFactor": 0.8, "baseColorFactor": [1, 1, 1, 1]}
    tree["materials"] = [{"name": "body", "pbrMetallicRoughness": surface, "doubleSided": True}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
