"""The formats that trimesh reads alone, glTF and 3MF and COLLADA and others; and Draco."""

import io
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from spt_jax.files.archives import check_archive
from spt_jax.io.meshes.gltf_check import check_gltf, gltf_extras, gltf_tree, needs_draco
from spt_jax.io.meshes.raw import RawMesh, UnreadableError

_GLTF = (".glb", ".gltf")
_ARCHIVES = (".3mf", ".3dxml", ".zae")
_PACKAGES = {
    ".3mf": ("networkx", "lxml"),
    ".3dxml": ("networkx", "lxml", "pillow"),
    ".dae": ("pycollada",),
    ".zae": ("pycollada",),
    ".xaml": ("lxml",),
    ".step": ("cascadio",),
    ".stp": ("cascadio",),
    ".drc": ("DracoPy",),
}
SCENE_SUFFIXES = (*_GLTF, *_PACKAGES, ".xyz")
# Where the name of a package is not that of its module.
_MODULES = {"pycollada": "collada", "pillow": "PIL"}


def read_scene(content: bytes, path: Path, max_bytes: int | None) -> RawMesh:
    """All meshes of a file, one after the other, each moved by its own transform.

    Raises:
        UnreadableError: it is damaged, has what is not read, or a package is missing.
        TooLargeError: it announces more than the limit.
        Exception: each loader of trimesh fails in its own way.
    """
    suffix = path.suffix.lower()
    _check_packages(_PACKAGES.get(suffix, ()))
    tree = None
    if suffix in _GLTF:
        tree = gltf_tree(content, path)
        check_gltf(tree, path, max_bytes)
        if needs_draco(tree):
            _check_packages(("DracoPy",))
    elif suffix in _ARCHIVES:
        check_archive(content, "mesh file", path, max_bytes=max_bytes)
    elif suffix == ".drc":
        return _from_draco(content)
    parts = _parts(content, path, skip_materials=True)
    meshes = [part for part in parts if _is_mesh(part)]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = [np.asarray(mesh.vertices, np.float64).reshape(-1, 3) for mesh in meshes]
    faces = [
        np.asarray(mesh.faces, np.int64).reshape(-1, 3) + start
        for mesh, start in zip(meshes, starts, strict=False)
    ]
    if not meshes:
        vertices = [np.zeros((sum(_points(part) for part in parts), 3))]
    kept, dropped = gltf_extras(tree) if tree is not None else (_looks(parts), ())

    def rewrite(moved: np.ndarray) -> bytes:
        return _written(content, path, starts, moved)

    return RawMesh(
        np.concatenate(vertices),
        np.concatenate([np.zeros((0, 3), np.int64), *faces]),
        extras=kept,
        dropped=dropped,
        rewrite=rewrite if suffix in _GLTF else None,
        lines=sum(len(getattr(part, "entities", ())) for part in parts),
    )


def _check_packages(names: tuple[str, ...]) -> None:
    missing = [name for name in names if find_spec(_MODULES.get(name, name)) is None]
    if missing:
        raise UnreadableError(
            f"reading it needs {' and '.join(missing)}: pip install {' '.join(missing)}"
        )


def _parts(content: bytes, path: Path, **options: Any) -> list[Any]:
    import trimesh
    from trimesh.resolvers import FilePathResolver

    return trimesh.load_scene(
        io.BytesIO(content),
        file_type=path.suffix.lower()[1:],
        resolver=FilePathResolver(str(path)),
        process=False,
        **(options if path.suffix.lower() in _GLTF else {}),
    ).dump()


def _is_mesh(part: Any) -> bool:
    import trimesh

    return isinstance(part, trimesh.Trimesh) and len(part.faces) > 0


def _points(part: Any) -> int:
    vertices = getattr(part, "vertices", None)
    return 0 if vertices is None else len(vertices)


def _looks(parts: list[Any]) -> tuple[str, ...]:
    kinds = {getattr(getattr(part, "visual", None), "kind", None) for part in parts}
    names = {"texture": "materials and texture coordinates", "vertex": "vertex colors"}
    return tuple(name for kind, name in (names | {"face": "face colors"}).items() if kind in kinds)


def _from_draco(content: bytes) -> RawMesh:
    import DracoPy

    mesh = DracoPy.decode(content)
    faces = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)
    return RawMesh(np.asarray(mesh.points, np.float64).reshape(-1, 3), faces)


def _written(content: bytes, path: Path, starts: np.ndarray, moved: np.ndarray) -> bytes:
    """A .glb of the same meshes and materials, with other positions."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    meshes = [part for part in _parts(content, path) if _is_mesh(part)]
    for start, mesh in zip(starts, meshes, strict=False):
        points = np.asarray(moved[start : start + len(mesh.vertices)], np.float64)
        mesh = trimesh.Trimesh(points, mesh.faces, visual=mesh.visual, process=False)
        scene.add_geometry(mesh)
    return export_glb(scene)
