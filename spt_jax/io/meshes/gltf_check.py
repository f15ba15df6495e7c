"""glTF: what its JSON announces, held against what there is and what is read of it."""

import base64
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from spt_jax.files.limits import check_bytes, parse_json
from spt_jax.io.meshes.raw import UnreadableError

_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# Extensions that change where a surface is, and that trimesh 5.2 knows.
_SHAPE = frozenset({"KHR_draco_mesh_compression", "KHR_mesh_quantization"})
# Those that do not change it begin with these.
_LOOKS = (
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "MSFT_texture",
)


def gltf_tree(content: bytes, path: Path) -> dict[str, Any]:
    """The JSON of a .glb or .gltf file.

    Raises:
        UnreadableError, ValueError: there is none, or it is cut.
    """
    text = content
    if content[:4] == b"glTF":
        version, length, chunk = (int.from_bytes(content[k : k + 4], "little") for k in (4, 8, 12))
        if path.suffix.lower() == ".gltf":
            raise UnreadableError("it is a .glb under another name; rename it")
        if version != 2:
            raise UnreadableError(f"it is glTF {version}; export glTF 2")
        if length > len(content) or 20 + chunk > len(content) or content[16:20] != b"JSON":
            raise UnreadableError(
                f"it announces {length:,} bytes and has {len(content):,}; it is cut"
            )
        text = content[20 : 20 + chunk]
    elif path.suffix.lower() == ".glb":
        raise UnreadableError('a .glb must begin with "glTF"')
    tree = parse_json(text, "the JSON of mesh file", path)
    if not isinstance(tree, dict):
        raise UnreadableError("its JSON must be an object")
    return tree


def check_gltf(tree: dict[str, Any], path: Path, max_bytes: int | None) -> None:
    """Raise where a glTF announces more than there is, or what would be read wrongly.

    Raises:
        TooLargeError: its arrays take more than the limit.
        UnreadableError: a feature that changes the shape and is not read; a file that is missing.
        ValueError, KeyError, TypeError, IndexError: its JSON is none of glTF's.
    """
    check_extensions(tree)
    views = tree.get("bufferViews", [])
    total = 0
    for accessor in tree.get("accessors", ()):
        size = accessor["count"] * _NUMBERS[accessor["type"]] * _BYTES[accessor["componentType"]]
        if not isinstance(size, int) or size < 0:
            raise UnreadableError(f"an accessor announces {accessor['count']!r} entries")
        total += size
        if "bufferView" in accessor and "byteStride" not in views[accessor["bufferView"]]:
            there = views[accessor["bufferView"]]["byteLength"] - accessor.get("byteOffset", 0)
            if size > there:
                raise UnreadableError(
                    f"an accessor announces {size:,} bytes of a view that has {there:,}"
                )
    check_bytes("the arrays of mesh file", path, total, max_bytes)
    for primitive in primitives(tree):
        shape = [primitive.get("attributes", {}).get("POSITION"), primitive.get("indices")]
        for accessor in (tree["accessors"][index] for index in shape if index is not None):
            if "sparse" in accessor:
                raise UnreadableError("its positions are a sparse accessor; export it without")
            if accessor.get("normalized"):
                raise UnreadableError("its positions are normalized whole numbers; export floats")
    _check_buffers(tree, path, max_bytes)


def check_extensions(tree: dict[str, Any]) -> None:
    """Raise where a glTF needs an extension that is not read.

    Raises:
        UnreadableError: it does.
    """
    unknown = [
        name
        for name in tree.get("extensionsRequired", ())
        if name not in _SHAPE and not str(name).startswith(_LOOKS)
    ]
    if unknown:
        raise UnreadableError(f"it needs {', '.join(map(str, unknown))}; export it without")
    for node in tree.get("nodes", ()):
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            raise UnreadableError("it has instances by EXT_mesh_gpu_instancing; export it without")


def file_of_uri(uri: str, folder: Path, what: str) -> Path:
    """The file beside a glTF that a URI names.

    Raises:
        UnreadableError: it is missing, or lies anywhere else.
    """
    inside = folder.resolve()
    file = (inside / unquote(uri)).resolve()
    if "://" in uri or not file.is_relative_to(inside):
        raise UnreadableError(f"{what} must lie beside it: got {uri[:80]!r}")
    if not file.is_file():
        raise UnreadableError(f"{what} is missing: {uri[:80]!r}; put it beside it")
    return file


def primitives(tree: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Every primitive of every mesh."""
    for mesh in tree.get("meshes", ()):
        yield from mesh.get("primitives", ())


def needs_draco(tree: dict[str, Any]) -> bool:
    """Whether a primitive is packed by Draco."""
    name = "KHR_draco_mesh_compression"
    return any(name in primitive.get("extensions", {}) for primitive in primitives(tree))


def gltf_extras(tree: dict[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What a glTF has beside its shape: what writing it again keeps, and what it drops."""
    keys = {key for primitive in primitives(tree) for key in primitive.get("attributes", {})}
    kept = {
        "materials": tree.get("materials"),
        "texture coordinates": "TEXCOORD_0" in keys,
        "vertex colors": "COLOR_0" in keys,
    }
    dropped = {
        "normals": "NORMAL" in keys,
        "skeletons": tree.get("skins"),
        "animations": tree.get("animations"),
        "shape keys": any(primitive.get("targets") for primitive in primitives(tree)),
        "cameras": tree.get("cameras"),
        "second texture coordinates": "TEXCOORD_1" in keys,
    }
    return tuple(k for k, v in kept.items() if v), tuple(k for k, v in dropped.items() if v)


def _check_buffers(tree: dict[str, Any], path: Path, max_bytes: int | None) -> None:
    total, folder = 0, path.parent
    for number, buffer in enumerate(tree.get("buffers", ())):
        uri = buffer.get("uri")
        if uri is None:
            continue
        if uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            if not kind.endswith(";base64"):  # trimesh would look for a file of this name
                raise UnreadableError(f"buffer {number} must be in base64: got {kind[:80]!r}")
            there = len(base64.b64decode(text))
        else:
            there = file_of_uri(uri, folder, f"buffer {number}").stat().st_size
        if there < buffer["byteLength"]:
            raise UnreadableError(
                f"buffer {number} announces {buffer['byteLength']:,} bytes and has {there:,}"
            )
        total += there
    check_bytes("the buffers of mesh file", path, math.ceil(total), max_bytes)
