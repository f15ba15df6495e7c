"""glTF as its specification has it, slowly: a reader of its own, and a writer of small rigs."""

import base64
import json
import struct

import numpy as np

_FORMATS = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}
_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def glb(tree, data):
    """A .glb of a JSON and one buffer."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = data + b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unpacked(content):
    """JSON and buffers of a .glb or a .gltf with buffers inside."""
    if content[:4] != b"glTF":
        tree = json.loads(content)
        return tree, [base64.b64decode(b["uri"].split(",", 1)[1]) for b in tree["buffers"]]
    (length,) = struct.unpack_from("<I", content, 12)
    return json.loads(content[20 : 20 + length]), [content[28 + length :]]


def slow_accessor(tree, buffers, index):
    """Number by number."""
    accessor = tree["accessors"][index]
    form, width = _FORMATS[accessor["componentType"]], _COUNTS[accessor["type"]]
    size = struct.calcsize(form)

    def elements(holder, count, width, form):
        view = tree["bufferViews"][holder["bufferView"]]
        start = view.get("byteOffset", 0) + holder.get("byteOffset", 0)
        stride = view.get("byteStride", width * struct.calcsize(form))
        data = buffers[view["buffer"]]
        return [
            list(struct.unpack_from(f"<{width}{form}", data, start + k * stride))
            for k in range(count)
        ]

    rows = [[0] * width for _ in range(accessor["count"])]
    if "bufferView" in accessor:
        rows = elements(accessor, accessor["count"], width, form)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        at = elements(
            sparse["indices"], sparse["count"], 1, _FORMATS[sparse["indices"]["componentType"]]
        )
        for (k,), row in zip(
            at, elements(sparse["values"], sparse["count"], width, form), strict=True
        ):
            rows[k] = row
    if accessor.get("normalized"):
        most = 2 ** (8 * size - (form.islower())) - 1
        rows = [[max(x / most, -1.0) for x in row] for row in rows]
    return np.array(rows, float)


def _turn(q):
    x, y, z, w = np.asarray(q, float) / np.linalg.norm(q)
    # v' = v + 2 w (u x v) + 2 u x (u x v), column by column.
    u = np.array([x, y, z])
    columns = [e + 2 * w * np.cross(u, e) + 2 * np.cross(u, np.cross(u, e)) for e in np.eye(3)]
    return np.stack(columns, axis=1)


def _local(node):
    matrix = np.eye(4)
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    matrix[:3, :3] = _turn(node.get("rotation", [0, 0, 0, 1])) @ np.diag(node.get("scale", [1] * 3))
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _slerp(one, other, t):
    cosine = one @ other
    other, cosine = (other, cosine) if cosine >= 0 else (-other, -cosine)
    angle = np.arccos(min(cosine, 1.0))
    if angle < 1e-9:
        return one
    return (np.sin((1 - t) * angle) * one + np.sin(t * angle) * other) / np.sin(angle)


def _sampled(tree, buffers, sampler, path, time, width):
    keys = slow_accessor(tree, buffers, sampler["input"])[:, 0]
    values = slow_accessor(tree, buffers, sampler["output"]).reshape(-1, width)
    way = sampler.get("interpolation", "LINEAR")
    spline = way == "CUBICSPLINE"
    if time <= keys[0] or len(keys) == 1:
        return values[1 if spline else 0]
    if time >= keys[-1]:
        return values[-2 if spline else -1]
    k = max(j for j in range(len(keys)) if keys[j] <= time)
    span = keys[k + 1] - keys[k]
    t = (time - keys[k]) / span
    if way == "STEP":
        return values[k]
    if spline:
        v0, b, a, v1 = values[3 * k + 1], values[3 * k + 2], values[3 * k + 3], values[3 * k + 4]
        found = (2 * t**3 - 3 * t**2 + 1) * v0 + span * (t**3 - 2 * t**2 + t) * b
        return found + (-2 * t**3 + 3 * t**2) * v1 + span * (t**3 - t**2) * a
    if path == "rotation":
        return _slerp(values[k], values[k + 1], t)
    return (1 - t) * values[k] + t * values[k + 1]


def slow_vertices(content, animation=None, time=0.0):
    """Every vertex of every mesh that a skin or a joint moves, in the order of its node."""
    tree, buffers = unpacked(content)
    nodes = json.loads(json.dumps(tree["nodes"]))
    counts = {
        k: len(tree["meshes"][node["mesh"]]["primitives"][0].get("targets", []))
        for k, node in enumerate(nodes)
        if "mesh" in node
    }
    if animation is not None:
        given = next(a for a in tree["animations"] if a["name"] == animation)
        for channel in given["channels"]:
            node, path = channel["target"]["node"], channel["target"]["path"]
            width = {"rotation": 4, "weights": counts.get(node)}.get(path, 3)
            sampler = given["samplers"][channel["sampler"]]
            value = _sampled(tree, buffers, sampler, path, time, width)
            nodes[node][path] = value.tolist()
    up = {child: k for k, node in enumerate(nodes) for child in node.get("children", [])}

    def world(k):
        local = _local(nodes[k])
        return world(up[k]) @ local if k in up else local

    joints = {j for skin in tree["skins"] for j in skin["joints"]}

    def hangs(k):
        return k in joints or (k in up and hangs(up[k]))

    found = []
    for k, node in enumerate(nodes):
        if "mesh" not in node or not ("skin" in node or hangs(k)):
            continue
        mesh = tree["meshes"][node["mesh"]]
        weights = node.get("weights", mesh.get("weights", [0] * counts[k]))
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            points = slow_accessor(tree, buffers, attributes["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if "POSITION" in target:
                    points += weight * slow_accessor(tree, buffers, target["POSITION"])
            if "skin" not in node:
                found += [(world(k) @ [*p, 1])[:3] for p in points]
                continue
            skin = tree["skins"][node["skin"]]
            bind = np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
            if "inverseBindMatrices" in skin:
                rows = slow_accessor(tree, buffers, skin["inverseBindMatrices"])
                bind = rows.reshape(-1, 4, 4).transpose(0, 2, 1)
            motion = [world(j) @ m for j, m in zip(skin["joints"], bind, strict=True)]
            sets = [n for n in range(9) if f"JOINTS_{n}" in attributes]
            j = np.hstack([slow_accessor(tree, buffers, attributes[f"JOINTS_{n}"]) for n in sets])
            w = np.hstack([slow_accessor(tree, buffers, attributes[f"WEIGHTS_{n}"]) for n in sets])
            for p, own, weight in zip(points, j.astype(int), w, strict=True):
                matrix = np.einsum("k,kab->ab", weight, np.array(motion)[own])
                found.append((matrix @ [*p, 1])[:3] / weight.sum())
    return np.array(found)


class RigWriter:
    """A glTF that is put together by hand; `accessor` appends an array and returns its number."""

    def __init__(self):
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}
        self.data = b""

    def view(self, content, stride=None):
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.tree["bufferViews"].append(view | ({"byteStride": stride} if stride else {}))
        self.data += content
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values, kind, component=5126, *, pad=0, **more):
        values = np.asarray(values, dtype="<" + _FORMATS[component]).reshape(-1, _COUNTS[kind])
        rows = [row.tobytes() + b"\7" * pad for row in values]
        stride = len(rows[0]) if pad else None
        one = {
            "bufferView": self.view(b"".join(rows), stride),
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if kind != "MAT4" and component == 5126:
            one |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.tree["accessors"].append(one | more)
        return len(self.tree["accessors"]) - 1

    def content(self):
        self.tree["buffers"] = [{"byteLength": len(self.data)}]
        return glb(self.tree, self.data)


def tube(rings, sectors, radius=10.0, height=100.0, seam=True):
    """A closed tube along y with its first column twice, as a texture's seam leaves it."""
    columns = sectors + seam
    angle = 2 * np.pi * (np.arange(columns) % sectors) / sectors
    y = np.repeat(np.linspace(0, height, rings), columns)
    x, z = np.tile(radius * np.cos(angle), rings), np.tile(radius * np.sin(angle), rings)
    points = [*np.stack([x, y, z], axis=1), [0, 0, 0], [0, height, 0]]
    faces = []
    for ring in range(rings - 1):
        for k in range(sectors):
            a = ring * columns + k
            b = ring * columns + (k + 1 if seam else (k + 1) % sectors)
            c, d = a + columns, b + columns
            faces += [[a, c, b], [b, c, d]]
    bottom, top, last = len(points) - 2, len(points) - 1, (rings - 1) * columns
    for k in range(sectors):
        nxt = k + 1 if seam else (k + 1) % sectors
        faces += [[bottom, k, nxt], [top, last + nxt, last + k]]
    return np.array(points, float), np.array(faces)


def quaternion(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return [*(np.sin(angle / 2) * axis), np.cos(angle / 2)]


def hard_rig(*, mirrored=False):
    """A character with what rigs have: see the comments."""
    w, rng = RigWriter(), np.random.default_rng(3)
    # A scene node that turns and scales, as exporters to y-up centimetres leave it; a joint below a
    # node that is none; a joint with a matrix; one with an uneven scale; and a hung mesh.
    size = [-0.01, 0.01, 0.01] if mirrored else [0.01, 0.01, 0.01]
    matrix = np.eye(4)
    matrix[:3, :3] = _turn(quaternion([1, 2, 3], 0.3)) * 1.1
    matrix[:3, 3] = [1, 24, 2]
    nodes = [
        {"name": "Armature", "rotation": quaternion([1, 0, 0], -0.4), "scale": size},
        {"name": "root", "translation": [3, 1, 2], "rotation": quaternion([0, 1, 1], 0.2)},
        {"name": "between", "translation": [0, 5, 0], "scale": [1.2, 1.2, 1.2]},
        {"name": "spine", "translation": [0, 20, 1], "scale": [1.0, 0.8, 1.1]},
        {"name": "matrix", "matrix": matrix.T.ravel().tolist()},
        {"name": "tip", "translation": [0, 22, 0], "rotation": quaternion([1, 1, 0], 0.5)},
        {"name": "skin A", "mesh": 0, "skin": 0, "translation": [100, 100, 100]},
        {"name": "skin B", "mesh": 1, "skin": 1},
        {"name": "hat", "mesh": 2, "translation": [0, 15, 0], "scale": [0.5, 0.5, 0.5]},
        {"name": "floor", "mesh": 2},
    ]
    children = {0: [1, 6, 7], 1: [2], 2: [3], 3: [4], 4: [5], 5: [8]}
    for k, below in children.items():
        nodes[k]["children"] = below
    joints, up = [1, 3, 4, 5], {c: k for k, cs in children.items() for c in cs}

    def world(k):
        local = _local(nodes[k])
        return world(up[k]) @ local if k in up else local

    # Bound before the tip was turned, so that its own rotation is no rest pose.
    straight = {k: world(k) for k in joints}
    straight[5] = world(4) @ _local({"translation": [0, 22, 0]})
    space = world(0) @ _local({"translation": [0.5, 0, 0], "scale": [2, 2, 2]})
    bind_a = np.stack([np.linalg.inv(straight[j]) @ space for j in joints])
    # The other skin: other joints in another order, another space, and the spine bound elsewhere.
    order = [4, 3, 1]
    bind_b = np.stack([np.linalg.inv(straight[j]) for j in order])
    bind_b[1] = np.linalg.inv(straight[3] @ _local({"rotation": quaternion([0, 0, 1], 0.2)}))

    points, faces = tube(9, 6)
    half = np.split(faces, [len(faces) // 2])
    weights = rng.dirichlet(np.ones(8) * 0.4, len(points))
    # A vertex of the seam is one vertex, with one skin.
    for ring in range(9):
        weights[ring * 7 + 6] = weights[ring * 7]
    bytes_of = np.floor(weights * 255).astype(int)
    bytes_of[:, 0] += 255 - bytes_of.sum(axis=1)
    local = rng.integers(0, 4, (len(points), 8))
    for ring in range(9):
        local[ring * 7 + 6] = local[ring * 7]
    position = w.accessor(points / 2, "VEC3", pad=8)
    sets = {}
    for n in range(2):
        columns = slice(4 * n, 4 * n + 4)
        sets[f"JOINTS_{n}"] = w.accessor(local[:, columns], "VEC4", 5121)
        sets[f"WEIGHTS_{n}"] = w.accessor(bytes_of[:, columns], "VEC4", 5121, normalized=True)
    bulge = np.zeros((len(points), 3))
    bulge[:, 0] = points[:, 0] * np.sin(points[:, 1] / 30)
    dense = w.accessor(bulge, "VEC3")
    changed = [63, 64]  # the two caps' middles
    sparse = {
        "componentType": 5126,
        "count": len(points),
        "type": "VEC3",
        "min": [0, -3, 0],
        "max": [0, 4, 0],
        "sparse": {
            "count": 2,
            "indices": {
                "bufferView": w.view(np.array(changed, "<u2").tobytes()),
                "componentType": 5123,
            },
            "values": {"bufferView": w.view(np.array([[0, -3, 0], [0, 4, 0]], "<f4").tobytes())},
        },
    }
    w.tree["accessors"].append(sparse)
    targets = [{"POSITION": dense}, {"POSITION": len(w.tree["accessors"]) - 1}]
    first = [
        {
            "attributes": {"POSITION": position, **sets},
            "indices": w.accessor(part.ravel(), "SCALAR", 5123),
            "targets": targets,
        }
        for part in half
    ]
    more, corners = tube(5, 5, radius=6.0, seam=False)
    more = (straight[1] @ np.c_[more * 0.7 + [20, 0, 0], np.ones(len(more))].T).T[:, :3]
    if mirrored:
        corners = corners[:, [0, 2, 1]]
    second = {
        "attributes": {
            "POSITION": w.accessor(more, "VEC3"),
            "JOINTS_0": w.accessor(rng.integers(0, 3, (len(more), 4)), "VEC4", 5123),
            "WEIGHTS_0": w.accessor(rng.dirichlet(np.ones(4), len(more)), "VEC4"),
        },
        "indices": w.accessor(corners.ravel(), "SCALAR", 5121),
    }
    hat, brim = tube(3, 4, radius=8.0, height=10.0, seam=False)
    third = {"attributes": {"POSITION": w.accessor(hat, "VEC3")}}
    third["indices"] = w.accessor(brim.ravel(), "SCALAR", 5125)
    w.tree |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 9]}],
        "nodes": nodes,
        "meshes": [
            {
                "name": "A",
                "primitives": first,
                "weights": [0.0, 0.5],
                "extras": {"targetNames": ["bulge", "caps"]},
            },
            {"name": "B", "primitives": [second]},
            {"name": "C", "primitives": [third]},
        ],
        "skins": [
            {
                "joints": joints,
                "inverseBindMatrices": w.accessor(bind_a.transpose(0, 2, 1), "MAT4"),
            },
            {"joints": order, "inverseBindMatrices": w.accessor(bind_b.transpose(0, 2, 1), "MAT4")},
        ],
    }
    keys = np.array([0.0, 0.4, 1.0])
    turns = np.array([quaternion(rng.normal(size=3), a) for a in (0.2, 1.9, -1.2)])
    spline = np.stack([0.3 * rng.normal(size=(3, 4)), turns, 0.3 * rng.normal(size=(3, 4))], axis=1)
    tracks = [
        (1, "rotation", "LINEAR", turns),
        (1, "translation", "LINEAR", [[3, 1, 2], [9, 4, -2], [0, 0, 0]]),
        (3, "rotation", "CUBICSPLINE", spline),
        (3, "scale", "STEP", [[1, 1, 1], [1.0, 0.8, 1.3], [0.9, 1.1, 1]]),
        (5, "translation", "LINEAR", [[0, 22, 0], [2, 26, 0], [0, 22, 0]]),
        (6, "weights", "LINEAR", [[0, 0.5], [1.0, 0.0], [0.2, 1.0]]),
    ]
    kinds = {"rotation": "VEC4", "weights": "SCALAR"}
    times = w.accessor(keys, "SCALAR")
    animation = {"name": "all", "samplers": [], "channels": []}
    for node, path, way, values in tracks:
        output = w.accessor(np.asarray(values), kinds.get(path, "VEC3"))
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]), "target": target})
        animation["samplers"].append({"input": times, "output": output, "interpolation": way})
    w.tree["animations"] = [animation]
    return w.content()
