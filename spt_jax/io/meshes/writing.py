"""Meshes written to files: colored by label to be looked at, or to the last digit."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from spt_jax.files.outputs import atomic_write
from spt_jax.io.meshes.arrays import as_mesh_arrays, fits_single, single_rounding

BODY_COLOR = (213, 201, 188)
PENETRATING_COLOR = (222, 58, 24)
INVERTED_COLOR = (0, 114, 178)


def write_mesh(
    path: str | os.PathLike[str],
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    labels: Int[Array | np.ndarray, " V"] | None = None,
) -> None:
    """Write a mesh as .glb or .ply, atomically, with one color a vertex that other programs show.

    Clear vertices are warm gray, penetrating ones (+1) vermillion, inverted ones (-1) blue. A .ply
    stores positions as float32 where that holds all of them exactly, else as float64. A .glb, which
    knows float32 alone, stores them so; of a mesh far from the origin about its middle, and that as
    a node's translation. glTF defines vertex colors as linear light, so a .glb holds the same
    colors linearised.

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
        >>> from spt_jax.io.mesh_files import read_mesh, write_mesh
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
    points, triangles, label = as_mesh_arrays(vertices, faces, labels)
    colors = np.array([BODY_COLOR, PENETRATING_COLOR, INVERTED_COLOR], dtype=np.uint8)[label]
    if suffix == ".glb":
        colors = _linear_light(colors)
    rgba = np.concatenate([colors, np.full((len(colors), 1), 255, np.uint8)], axis=1)
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


def write_shape(
    path: str | os.PathLike[str],
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
) -> None:
    """Write a mesh so that it reads back to the bit, atomically: no digit of it may be lost.

    Args:
        path: .ply, .obj, .off, .stl or .glb; the last two hold float32 alone.
        vertices, faces: the mesh.

    Raises:
        ValueError: another suffix.
        OSError: as in `atomic_write`.
    """
    file = Path(path)
    if file.suffix in (".ply", ".glb"):
        write_mesh(file, vertices, faces)
        return
    if file.suffix == ".stl":
        import trimesh
        from trimesh.exchange.stl import export_stl

        content = export_stl(trimesh.Trimesh(vertices, faces, process=False))
    elif file.suffix == ".obj":
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
        content = ("\n".join(lines) + "\n").encode()
    elif file.suffix == ".off":
        lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
        lines += [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
        content = ("\n".join(lines) + "\n").encode()
    else:
        raise ValueError(f"path must end in .ply, .obj, .off, .stl or .glb: got {file.name!r}")
    with atomic_write(file) as temporary:
        temporary.write_bytes(content)


def _as_ply(points: np.ndarray, triangles: np.ndarray, rgba: np.ndarray) -> bytes:
    # trimesh 5.2 writes float32 whatever it is given.
    number, name = ("<f8", "double") if single_rounding(points) else ("<f4", "float")
    corners = np.empty(len(points), [("position", number, 3), ("color", "u1", 4)])
    corners["position"], corners["color"] = points, rgba
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


def _linear_light(colors: np.ndarray) -> np.ndarray:
    # The sRGB transfer function; glTF 2.0, section 3.7.2.1: COLOR_0 is linear.
    value = colors / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def _add_light_material(tree: dict[str, Any]) -> None:
    # Without a material glTF's default is fully metallic, which most viewers draw nearly black.
    surface = {"metallicFactor": 0.0, "roughnessFactor": 0.8, "baseColorFactor": [1, 1, 1, 1]}
    tree["materials"] = [{"name": "body", "pbrMetallicRoughness": surface, "doubleSided": True}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
