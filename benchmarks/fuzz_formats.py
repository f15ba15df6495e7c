"""Files of every format that is read, written anew each time with what they mean beside them.

Every writer here draws how it writes what means the same: the order of keys, white space, line
ends, how numbers are spelt, fields that nobody knows. What must be read is the same each time.
"""

import base64
import io
import json
import pickle
import runpy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import trimesh
from scipy.spatial.transform import Rotation

from spt_jax.body import load_body
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.io.mesh_files import read_mesh
from spt_jax.io.pose_files import load_poses, read_poses
from spt_jax.keypoints import LAYOUTS, read_keypoints
from spt_jax.show.overlay import read_image

# The tests' own writers: a module beside no package, so that it is found by its path.
_HELPERS = Path(__file__).parents[1] / "tests" / "helpers_poses.py"
MADE: dict[str, Callable[[], Any]] = runpy.run_path(str(_HELPERS), run_name="helpers_poses")["MADE"]

Arrays = list[np.ndarray]
Generator = np.random.Generator


class Written(NamedTuple):
    """A file's content, what it must be read as, and where it has them its parts."""

    content: bytes
    truth: Arrays
    parts: Any = None  # what the content encodes: a dictionary of arrays, or JSON


class Format(NamedTuple):
    """How a kind of file is written and read.

    Attributes:
        suffix: of its name.
        write: a random file.
        read: what comes back, as arrays.
        text: whether it has lines, the last of which may be cut without a trace.
        counted: whether it says how much there is of it.
        summed: whether checksums guard all of its bytes.
        close: how far from what was written what is read may be, in each number.
    """

    suffix: str
    write: Callable[[Generator], Written]
    read: Callable[[Path], Arrays]
    text: bool = False
    counted: bool = True
    summed: bool = False
    close: float = 0.0


# Meshes: what counts is the corners of each triangle, in order.


def _mesh(rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """A closed solid whose coordinates float32 holds."""
    solid = trimesh.creation.box() if rng.integers(2) else trimesh.creation.icosahedron()
    vertices = (np.array(solid.vertices) * rng.uniform(0.1, 9, 3) + rng.normal(size=3)).astype("f4")
    return vertices.astype(np.float64), np.array(solid.faces, np.int64)


def read_corners(path: Path) -> Arrays:
    """The corners of a mesh file's triangles; IndexError for a face out of range."""
    vertices, faces = read_mesh(path)
    if len(faces) and faces.min() < 0:
        raise IndexError(f"face index {faces.min()}")
    return [vertices[faces]]


def _number(rng: Generator, x: float) -> str:
    return (repr(float(x)), f"{x:.17g}", f"{x:.17e}", f"{x:+.17E}")[rng.integers(4)]


def _lines(rng: Generator, lines: Sequence[str]) -> bytes:
    end = ("\n", "\r\n")[rng.integers(2)]
    gap = (" ", "  ", "\t")[rng.integers(3)]
    return (end.join(line.replace(" ", gap) for line in lines) + end).encode()


def _numbers(rng: Generator, row) -> str:
    return " ".join(_number(rng, x) for x in row)


def _obj(rng: Generator) -> Written:
    vertices, faces = _mesh(rng)
    lines = ["# a comment", "o thing"] if rng.integers(2) else []
    lines += [f"v {_numbers(rng, row)}" for row in vertices]
    way = rng.integers(4)
    if way == 1:
        lines += ["vn 0 0 1", "s off"]
    rows = faces - len(vertices) if way == 2 else faces + 1
    corner = "{}//1" if way == 1 else "{}"
    lines += ["f " + " ".join(corner.format(k) for k in row) for row in rows]
    return Written(_lines(rng, lines), [vertices[faces]])


def _off(rng: Generator) -> Written:
    vertices, faces = _mesh(rng)
    lines = [
        "OFF",
        *(["# a comment"] if rng.integers(2) else []),
        f"{len(vertices)} {len(faces)} 0",
    ]
    lines += [_numbers(rng, row) for row in vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    return Written(_lines(rng, lines), [vertices[faces]])


def _ply(rng: Generator) -> Written:
    vertices, faces = _mesh(rng)
    kind = ("ascii", "binary_little_endian", "binary_big_endian")[rng.integers(3)]
    real, extra = ("float", "double")[rng.integers(2)], bool(rng.integers(2))
    header = ["ply", f"format {kind} 1.0"]
    header += ["comment nothing"] if rng.integers(2) else []
    header += [f"element vertex {len(vertices)}", *(f"property {real} {axis}" for axis in "xyz")]
    header += ["property uchar quality"] if extra else []
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    if kind == "ascii":
        rows = [_numbers(rng, row) + (" 7" if extra else "") for row in vertices]
        rows += [f"3 {a} {b} {c}" for a, b, c in faces]
        return Written("\n".join([*header, *rows, ""]).encode(), [vertices[faces]])
    order = "<" if "little" in kind else ">"
    fields = [("p", order + {"float": "f4", "double": "f8"}[real], 3)]
    table = np.zeros(len(vertices), fields + ([("q", "u1")] if extra else []))
    table["p"] = vertices
    rows = np.zeros(len(faces), [("n", "u1"), ("f", order + "i4", 3)])
    rows["n"], rows["f"] = 3, faces
    content = ("\n".join([*header, ""])).encode() + table.tobytes() + rows.tobytes()
    return Written(content, [vertices[faces]])


def _stl(rng: Generator) -> Written:
    vertices, faces = _mesh(rng)
    corners = vertices[faces]
    if rng.integers(2):
        rows = np.zeros(len(faces), [("n", "<f4", 3), ("p", "<f4", (3, 3)), ("a", "<u2")])
        rows["p"] = corners
        head = rng.integers(32, 127, 80).astype(np.uint8).tobytes()
        return Written(head + np.uint32(len(faces)).tobytes() + rows.tobytes(), [corners])
    lines = ["solid thing"]
    for triangle in corners:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {_numbers(rng, row)}" for row in triangle] + ["endloop", "endfacet"]
    return Written(_lines(rng, [*lines, "endsolid thing"]), [corners])


def _gltf(rng: Generator) -> tuple[dict[str, Any], bytes, Arrays]:
    vertices, faces = _mesh(rng)
    indices = faces.astype(("<u2", "<u4")[rng.integers(2)])
    points = vertices.astype("<f4")
    data = points.tobytes() + indices.tobytes()
    data += b"\0" * (-len(data) % 4)
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    component = 5123 if indices.itemsize == 2 else 5125
    count, size = len(vertices), faces.size
    scene: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}
            | {"min": low, "max": high},
            {"bufferView": 1, "componentType": component, "count": size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": indices.nbytes},
        ],
        "buffers": [{"byteLength": len(data)}],
    }
    if rng.integers(2):
        scene["extras"] = {"unknown": [1, 2]}
    return scene, data, [vertices[faces]]


def encode_glb(text: bytes, data: bytes) -> bytes:
    """A .glb of its two chunks."""
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        np.uint32(len(c)).tobytes() + name + c for name, c in ((b"JSON", text), (b"BIN\0", data))
    )
    return b"glTF" + np.array([2, 12 + len(chunks)], "<u4").tobytes() + chunks


def _glb(rng: Generator) -> Written:
    scene, data, truth = _gltf(rng)
    return Written(encode_glb(as_json(rng, scene), data), truth)


def _gltf_text(rng: Generator) -> Written:
    scene, data, truth = _gltf(rng)
    start = "data:application/octet-stream;base64,"
    scene["buffers"][0]["uri"] = start + base64.b64encode(data).decode()
    return Written(as_json(rng, scene), truth, scene)


def as_json(rng: Generator, value: Any) -> bytes:
    """JSON with its keys in any order, and white space as it comes."""

    def shuffled(node: Any) -> Any:
        if isinstance(node, dict):
            keys = list(node)
            return {keys[k]: shuffled(node[keys[k]]) for k in rng.permutation(len(keys))}
        return [shuffled(entry) for entry in node] if isinstance(node, list) else node

    indent = (None, 1, "\t")[rng.integers(3)]
    text = json.dumps(shuffled(value), indent=indent)
    return (text.replace("\n", "\r\n") if rng.integers(2) else text).encode()


# Poses and bodies: dictionaries of arrays.


def as_npz(rng: Generator, arrays: dict[str, np.ndarray]) -> bytes:
    """An .npz with its arrays in any order, packed or not."""
    names, file = list(arrays), io.BytesIO()
    save = np.savez_compressed if rng.integers(2) else np.savez
    save(file, **{names[k]: arrays[names[k]] for k in rng.permutation(len(names))})  # pyright: ignore
    return file.getvalue()


def _poses(rng: Generator) -> Written:
    joints, frames = (22, 24, 52, 55)[rng.integers(4)], int(rng.integers(1, 4))
    pose, shift = rng.normal(size=(frames, joints, 3)), rng.normal(size=(frames, 3))
    shape = rng.normal(size=10)
    arrays: dict[str, Any]
    if joints == 22 and rng.integers(2):
        arrays = {"global_orient": pose[:, 0], "body_pose": pose[:, 1:].reshape(frames, -1)}
    else:
        stored = pose.reshape(frames, -1) if rng.integers(2) else np.asfortranarray(pose)
        arrays = {("poses", "pose")[rng.integers(2)]: stored}
    arrays[("betas", "shape")[rng.integers(2)]] = shape
    arrays[("trans", "transl", "translation")[rng.integers(3)]] = shift
    if rng.integers(2):
        arrays |= {"gender": np.array("neutral"), "mocap_framerate": np.array(120.0)}
    return Written(as_npz(rng, arrays), [pose, shape, shift], arrays)


def _read_poses(path: Path) -> Arrays:
    found = read_poses(path)
    return [x for x in (found.pose, found.shape, found.translation) if x is not None]


def _smpl(rng: Generator) -> dict[str, Any]:
    joints, count = 24, 30
    parents = np.array([-1, 0, 0, 0, *range(1, 21)])
    assert len(SMPL_LAYOUTS[joints]) == joints
    weights = rng.random((count, joints)) * (rng.random((count, joints)) < 0.2)
    weights[:, 0] += 0.1
    regressor = rng.random((joints, count))
    return {
        "v_template": rng.normal(size=(count, 3)),
        "shapedirs": 0.1 * rng.normal(size=(count, 3, 4)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([parents, range(joints)], np.int64).astype(np.uint32),
        "f": np.array([np.arange(k, k + 3) for k in range(count - 2)], np.uint32),
    }


def _truth_of_body(arrays: dict[str, Any]) -> Arrays:
    single = [np.asarray(arrays[name], np.float32) for name in ("v_template", "shapedirs")]
    return [*single, np.asarray(arrays["f"], np.int32)]


def _read_body(path: Path) -> Arrays:
    body = load_body(path)
    return [np.asarray(x) for x in (body.template, body.shape_basis, body.faces)]


def _body_npz(rng: Generator) -> Written:
    arrays = _smpl(rng)
    truth = _truth_of_body(arrays)
    if rng.integers(2):
        arrays["unknown"] = np.arange(3)
    return Written(as_npz(rng, arrays), truth, arrays)


def as_pickle(rng: Generator, arrays: dict[str, Any]) -> bytes:
    """A pickle of any protocol."""
    return pickle.dumps(arrays, protocol=int(rng.integers(0, 6)))


def _body_pkl(rng: Generator) -> Written:
    arrays = _smpl(rng)
    truth = _truth_of_body(arrays)
    if rng.integers(2):
        arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    if rng.integers(2):
        arrays["bs_type"] = "lrotmin"
    return Written(as_pickle(rng, arrays), truth, arrays)


# Keypoints: the same people, in the layouts of several programs.


def _keypoints(rng: Generator) -> Written:
    ways = ("coco", "results", "mmpose", "openpose", "alphapose", "names", "own")
    way = ways[rng.integers(len(ways))]
    people = int(rng.integers(1, 4))
    count = {"openpose": 25, "alphapose": 18}.get(way, 17)
    points = rng.uniform(1, 400, (people, count, 2)).round(2)
    trust = rng.choice([0.0, 0.5, 1.0], (people, count), p=[0.2, 0.3, 0.5])
    trust[:, :4] = 1.0
    rows = np.concatenate([points, trust[..., None]], axis=-1)
    truth: Arrays = [np.where(trust[..., None] > 0, points, 0.0), trust]
    flat = [row.ravel().tolist() for row in rows]
    unknown = {"unknown": "field"} if rng.integers(2) else {}
    content: Any
    if way == "coco":
        flags = np.concatenate([points, (2 * trust)[..., None]], axis=-1)
        content = {"annotations": [{"keypoints": f.ravel().tolist(), **unknown} for f in flags]}
    elif way == "results":
        content = [{"image_id": 1, "keypoints": row, "score": 0.9, **unknown} for row in flat]
    elif way == "mmpose":
        scores = [
            {"keypoints": p.tolist(), "keypoint_scores": t.tolist()}
            for p, t in zip(points, trust, strict=True)
        ]
        content = {"instance_info": [{"frame_id": 1, "instances": scores}]}
    elif way == "openpose":
        content = {"version": 1.3, "people": [{"pose_keypoints_2d": row} for row in flat]}
    elif way == "alphapose":
        content = {"a.jpg": {"version": "0.3", "bodies": [{"joints": row} for row in flat]}}
    elif way == "names":
        names = rng.permutation(LAYOUTS["coco17"].names).tolist()
        content = {"names": names, "people": rows.tolist(), **unknown}
    else:
        content = {"layout": "coco17", "people": rows.tolist(), **unknown}
    return Written(as_json(rng, content), truth, content)


def _keypoint_table(rng: Generator) -> Written:
    """A table of DeepLabCut's."""
    names = rng.permutation(LAYOUTS["coco17"].names)[: int(rng.integers(2, 17))].tolist()
    frames = int(rng.integers(1, 5))
    points = rng.uniform(1, 400, (frames, len(names), 2)).round(2)
    trust = rng.choice([0.5, 0.75, 1.0], (frames, len(names)))
    rows = np.concatenate([points, trust[..., None]], axis=-1).reshape(frames, -1)
    head = [["scorer", *["net"] * rows.shape[1]]]
    head.append(["bodyparts", *(name for name in names for _ in range(3))])
    head.append(["coords", *("x", "y", "likelihood") * len(names)])
    lines = [",".join(row) for row in head]
    lines += [",".join(map(str, (k, *row))) for k, row in enumerate(rows.tolist())]
    return Written("\n".join([*lines, ""]).encode(), [points, trust])


def _keypoint_arrays(rng: Generator) -> Written:
    people = int(rng.integers(1, 4))
    points = rng.uniform(1, 400, (people, 17, 2))
    trust = rng.choice([0.5, 0.75, 1.0], (people, 17))
    name = ("confidence", "scores", "keypoint_scores")[rng.integers(3)]
    arrays: dict[str, Any] = {"keypoints": points, name: trust, "layout": np.array("coco17")}
    if rng.integers(3) == 0:
        arrays = {"keypoints": np.concatenate([points, trust[..., None]], axis=-1)}
        arrays["layout"] = np.array("coco17")
    return Written(as_npz(rng, arrays), [points, trust], arrays)


def _read_keypoints(path: Path) -> Arrays:
    people = read_keypoints(path).people
    if not people:
        return []
    if len({len(person.points) for person in people}) > 1:
        return [array for person in people for array in (person.points, person.confidence)]
    return [np.stack([p.points for p in people]), np.stack([p.confidence for p in people])]


def _image(rng: Generator) -> Written:
    from PIL import Image, PngImagePlugin

    picture = rng.integers(0, 256, (int(rng.integers(16, 24)), 18, 3)).astype(np.uint8)
    kind = ("PNG", "BMP", "PPM", "TIFF", "TGA")[rng.integers(5)]
    options: dict[str, Any] = {}
    if kind == "PNG":
        about = PngImagePlugin.PngInfo()
        about.add_text("unknown", "field")
        options = {"compress_level": int(rng.integers(0, 10)), "pnginfo": about}
    file = io.BytesIO()
    Image.fromarray(picture).save(file, kind, **options)
    return Written(file.getvalue(), [picture])


# Poses in every structure, as the tests make them.


def _of_structure(name: str) -> Format:
    """A structure's file, in another order or protocol where that means the same."""
    one = MADE[name]()
    truth = [_matrices(pose) for pose in one.poses.values()]
    npz, plain = one.suffix == ".npz", one.suffix == ".pkl" and b"joblib" not in one.content[:300]

    def write(rng: Generator) -> Written:
        if npz:
            with np.load(io.BytesIO(one.content), allow_pickle=True) as archive:
                arrays = dict(archive)
            return Written(as_npz(rng, arrays), truth, arrays)
        if one.suffix == ".json":
            value = json.loads(one.content)
            return Written(as_json(rng, value), truth, value)
        if plain and one.content[:1] == b"\x80":
            value = pickle.loads(one.content)
            return Written(as_pickle(rng, value), truth, value)
        return Written(one.content, truth)

    packed = npz or one.suffix == ".pt" or one.content[:1] == b"\x78"
    text = one.suffix == ".bvh"
    return Format(one.suffix, write, _read_tracks, text=text, summed=packed, close=1e-6)


def _matrices(pose: np.ndarray) -> np.ndarray:
    flat = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix()
    return flat.reshape(*pose.shape, 3)


def _read_tracks(path: Path) -> Arrays:
    tracks = load_poses(path)
    for track in tracks:  # whatever else is read is finite and of a size that goes with the poses
        for array in (track.translation, track.shape, track.expression, track.left_hand):
            if array is not None and not np.isfinite(array).all():
                return [array]
    return [_matrices(track.pose) for track in tracks]


FORMATS = {
    "OBJ": Format(".obj", _obj, read_corners, text=True, counted=False),
    "OFF": Format(".off", _off, read_corners, text=True),
    "PLY": Format(".ply", _ply, read_corners, text=True),
    "STL": Format(".stl", _stl, read_corners, text=True),
    "GLB": Format(".glb", _glb, read_corners),
    "glTF": Format(".gltf", _gltf_text, read_corners),
    "poses, npz": Format(".npz", _poses, _read_poses, summed=True),
    **{f"poses, {name}": _of_structure(name) for name in MADE},
    "body, npz": Format(".npz", _body_npz, _read_body, summed=True),
    "body, pickle": Format(".pkl", _body_pkl, _read_body),
    "keypoints, JSON": Format(".json", _keypoints, _read_keypoints),
    "keypoints, DeepLabCut": Format(
        ".csv", _keypoint_table, _read_keypoints, text=True, counted=False
    ),
    "keypoints, npz": Format(".npz", _keypoint_arrays, _read_keypoints, summed=True),
    "image": Format(".img", _image, lambda path: [read_image(path)], counted=False),
}
