"""Mesh files opened: read in whatever format they have, and ready to be written again."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from spt_jax.files.limits import TooLargeError, as_file, file_errors, read_bytes
from spt_jax.files.outputs import atomic_write
from spt_jax.io.meshes.arrays import as_mesh_arrays
from spt_jax.io.meshes.companions import copy_companions
from spt_jax.io.meshes.obj import read_obj
from spt_jax.io.meshes.off import read_off
from spt_jax.io.meshes.ply import read_ply
from spt_jax.io.meshes.raw import RawMesh, UnreadableError
from spt_jax.io.meshes.scenes import SCENE_SUFFIXES, read_scene
from spt_jax.io.meshes.seams import closed_seams
from spt_jax.io.meshes.stl import read_stl
from spt_jax.io.meshes.writing import write_shape


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh file that was read, with all that it takes to write it again.

    Attributes:
        path: the file.
        vertices, faces: as `read_mesh` returns them.
        notes: what had to be done or left out to read it, one sentence each.
        raw: the mesh as the file has it.
        rows: of each vertex of the file, which of `vertices` it became.
    """

    path: Path
    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    notes: tuple[str, ...]
    raw: RawMesh
    rows: Int[np.ndarray, "R"]

    def write(
        self, path: str | os.PathLike[str], vertices: Float[np.ndarray, "V 3"]
    ) -> tuple[str, ...]:
        """Write the mesh with other positions, and all else that the file has where that goes.

        Material libraries and textures that the file names are copied along. A file of another
        format has the shape alone. Positions read back to the bit, as far as the format holds them.

        Args:
            path: .ply, .obj, .off, .stl or .glb.
            vertices: positions in place of `vertices`; of float32 where they fit.

        Returns:
            What is not as it was, one sentence each.

        Raises:
            ValueError: another suffix.
            OSError: as in `atomic_write`.
        """
        target, raw = Path(path), self.raw
        formats = {self.path.suffix.lower(), ".glb" if self.path.suffix.lower() == ".gltf" else ""}
        if raw.rewrite is None or target.suffix not in formats:
            write_shape(target, vertices, self.faces)
            lost = (*raw.extras, *raw.dropped)
            return (f"left out in {target.name}: {', '.join(lost)}",) if lost else ()
        content = raw.rewrite(vertices[self.rows])
        with atomic_write(target) as temporary:
            temporary.write_bytes(content)
        notes = []
        if raw.dropped:
            notes.append(f"left out in {target.name}: {', '.join(raw.dropped)}")
        if "normals" in raw.extras:
            notes.append(f"normals in {target.name} are those before; compute them again")
        missing = copy_companions(self.path, raw.companions, target.parent)
        if missing:
            notes.append(f"{target.name} names files that were not found: {', '.join(missing)}")
        return tuple(notes)


def read_mesh(
    path: str | os.PathLike[str], *, max_bytes: int | None = None
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return (vertices, faces) of a mesh file, as float64 and int64.

    Read are .ply, .obj, .off, .stl, .glb and .gltf, and where their packages are installed .3mf,
    .3dxml, .dae, .zae, .xaml, .step and .drc. A scene's meshes are concatenated, each moved by its
    own transform. Vertices and faces keep the file's order; polygons are cut into triangles that
    cover them, convex or not.

    A surface that the file split, along seams of its texture or into single triangles, is closed
    again: vertices on edges without a partner are joined where they are at exactly the same
    position, then where they are within four units in the last place of the largest coordinate.
    Triangles that collapse thereby are dropped. So a closed surface reads as closed, while closed
    parts that merely touch stay apart (not in .stl, which has nothing to separate them by). Nothing
    else is merged, repaired or reordered. `open_mesh` says what was done.

    Args:
        path: the file; its suffix names the format.
        max_bytes: what the file and its arrays may take; 1 GiB where None.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: the file cannot be read.
        ValueError: an unknown suffix, an unreadable file, one without triangles (a point cloud,
            a curve, an empty mesh), one that holds NaN, or one larger than the limit.

    Example:
        >>> import pathlib, tempfile
        >>> import trimesh
        >>> from spt_jax.io.mesh_files import read_mesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "box.stl"
        ...     _ = trimesh.creation.box().export(file)
        ...     vertices, faces = read_mesh(file)
        >>> vertices.shape, faces.shape  # an .stl holds three corners for each triangle
        ((8, 3), (12, 3))
    """
    found = open_mesh(path, max_bytes=max_bytes)
    return found.vertices, found.faces


def open_mesh(path: str | os.PathLike[str], *, max_bytes: int | None = None) -> MeshFile:
    """Return a mesh file with what had to be done to read it, ready to be written again.

    Args, Raises: as `read_mesh`.
    """
    content_of = _readers()
    file = as_file(path, "mesh file")
    suffix = file.suffix.lower()
    if suffix not in content_of:
        packed = suffix in (".zip", ".gz", ".bz2", ".xz", ".7z", ".tar")
        raise ValueError(
            f"mesh file must have one of the suffixes {' '.join(content_of)}: got {file.name!r}; "
            + ("unpack it first" if packed else "convert it to .ply, .obj, .stl, .off or .glb")
        )
    content = read_bytes(file, "mesh file", max_bytes=max_bytes)
    with file_errors("mesh file", file):
        try:
            raw = content_of[suffix](content, file, max_bytes)
        except (TooLargeError, MemoryError, RecursionError, OSError):
            raise
        except UnreadableError as error:
            raise ValueError(
                f"mesh file must be a readable {suffix} file: got {str(path)!r}; {error}"
            ) from error
        except Exception as error:  # each loader fails in its own way; all mean the same here
            raise ValueError(
                f"mesh file must be a readable {suffix} file: got {str(path)!r} "
                f"({type(error).__name__}: {error})"
            ) from error
        if not len(raw.faces):
            raise ValueError(f"mesh file must hold triangles: got {str(path)!r} {_instead(raw)}")
        try:
            vertices, faces, _ = as_mesh_arrays(raw.vertices, raw.faces)
        except ValueError as error:
            raise ValueError(f"mesh file must hold a mesh: got {str(path)!r} ({error})") from error
        vertices, faces, rows, collapsed = closed_seams(vertices, faces, raw.double)
    notes = raw.notes
    if collapsed and suffix != ".stl":
        count = f"{collapsed} triangle{'s' if collapsed > 1 else ''}"
        notes += (f"{count} without area at a seam left out",)
    if not len(faces):
        raise ValueError(f"mesh file must hold triangles: got {str(path)!r}, all without area")
    return MeshFile(file, vertices, faces, notes, raw, rows)


def _readers() -> dict[str, Callable[[bytes, Path, int | None], RawMesh]]:
    """By suffix, what reads a file's content."""
    plain = {".ply": read_ply, ".obj": read_obj, ".off": read_off, ".stl": read_stl}
    readers = {s: lambda content, _, __, r=r: r(content) for s, r in plain.items()}
    return readers | dict.fromkeys(SCENE_SUFFIXES, read_scene)


def _instead(raw: RawMesh) -> str:
    """What a file without triangles has, and what to do about it."""
    if raw.lines:
        return (
            f"with {raw.lines} lines or curves and no faces; a wireframe is no surface: export "
            "the faces too"
        )
    if len(raw.vertices):
        return (
            f"with a point cloud of {len(raw.vertices)} points and no faces; reconstruct a surface "
            "first"
        )
    return "with nothing in it; export the mesh again"
