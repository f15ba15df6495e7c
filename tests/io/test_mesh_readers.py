"""Mesh files as people have them: every format, its oddities, and files that lie."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from helpers import box, random_rotation, signed_volume

from spt_jax._mesh_check import check_mesh
from spt_jax.files.limits import TooLargeError
from spt_jax.io.mesh_files import open_mesh, read_mesh
from spt_jax.io.meshes.polygons import polygon_triangles
from spt_jax.io.meshes.seams import closed_seams

_INNER = 0.4


def star(points=5):
    """A star-shaped polygon of concave corners, counter-clockwise, and its area."""
    angle = np.pi / 2 + np.pi * np.arange(2 * points) / points
    radius = np.where(np.arange(2 * points) % 2, _INNER, 1.0)
    corners = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return corners, points * _INNER * np.sin(np.pi / points)


def star_prism():
    """Vertices, polygons and volume of a prism over a star: concave tops, and quadrilaterals."""
    flat, area = star()
    count = len(flat)
    vertices = np.concatenate([np.c_[flat, np.zeros(count)], np.c_[flat, np.full(count, 0.5)]])
    k = np.arange(count)
    after = (k + 1) % count
    sides = np.stack([k, after, after + count, k + count], axis=1).tolist()
    return vertices, [k[::-1].tolist(), (k + count).tolist(), *sides], 0.5 * area


def write_obj(path, vertices, polygons):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in polygon) for polygon in polygons]
    path.write_text("\n".join(lines))


def write_off(path, vertices, polygons):
    lines = ["OFF", f"{len(vertices)} {len(polygons)} 0"]
    lines += [" ".join(map(repr, row)) for row in vertices.tolist()]
    lines += [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    path.write_text("\n".join(lines))


def write_ply(path, vertices, polygons, form="ascii"):
    header = [
        "ply",
        f"format {form} 1.0",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(polygons)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    if form == "ascii":
        rows = [" ".join(map(repr, row)) for row in vertices.tolist()]
        # A line break within each row, and rows that share a line.
        rows += [f"{len(p)}\n" + " ".join(map(str, p)) for p in polygons]
        body = "\n".join(rows).encode()
    else:
        order = "<" if "little" in form else ">"
        body = vertices.astype(order + "f8").tobytes()
        for polygon in polygons:
            body += struct.pack(f"{order}B{len(polygon)}i", len(polygon), *polygon)
    path.write_bytes("\n".join(header).encode() + body)


def write_big(path, *mesh):
    write_ply(path, *mesh, form="binary_big_endian")


def write_little(path, *mesh):
    write_ply(path, *mesh, form="binary_little_endian")


@pytest.mark.parametrize(
    ("suffix", "write"),
    [
        ("obj", write_obj),
        ("off", write_off),
        ("ply", write_ply),
        ("ply", write_big),
        ("ply", write_little),
    ],
)
def test_polygons_of_any_shape_become_the_solid_that_they_bound(tmp_path, rng, suffix, write):
    vertices, polygons, volume = star_prism()
    for rotation in (np.eye(3), random_rotation(rng)):
        turned = vertices @ rotation.T
        write(tmp_path / f"a.{suffix}", turned, polygons)
        found = open_mesh(tmp_path / f"a.{suffix}")
        np.testing.assert_array_equal(found.vertices, turned)
        assert found.faces.shape == (36, 3) and found.notes == () and found.raw.double
        assert check_mesh(found.vertices, found.faces).ok
        assert signed_volume(found.vertices, found.faces) == pytest.approx(volume, rel=1e-12)
        # Every triangle lies the way its polygon does: none covers what another takes back.
        area = trimesh.Trimesh(found.vertices, found.faces, process=False).area
        assert area == pytest.approx(2 * volume / 0.5 + 0.5 * perimeter(), rel=1e-12)


def perimeter():
    flat, _ = star()
    return np.linalg.norm(np.roll(flat, -1, axis=0) - flat, axis=1).sum()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_triangles_of_a_polygon_cover_it_once(rng, dtype):
    for count in (4, 5, 6, 9, 17, 40):
        angle = 2 * np.pi * np.arange(count) / count
        radius = rng.uniform(0.2, 1.0, count)
        flat = np.c_[radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)]
        points = (flat @ random_rotation(rng).T).astype(dtype).astype(np.float64)
        area = 0.5 * np.sum(radius * np.roll(radius, -1)) * np.sin(2 * np.pi / count)
        places, owner, crossed = polygon_triangles(points, np.arange(count), np.array([count]))
        assert places.shape == (count - 2, 3) and not owner.any() and crossed == 0
        a, b, c = points[places].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a) / 2
        assert np.linalg.norm(normal.sum(axis=0)) == pytest.approx(area, rel=1e-5)
        assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(area, rel=1e-5)


def test_polygons_with_straight_corners_slits_and_crossings():
    square = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 2, 0], [1, 2, 0], [0, 2, 0]], float)
    places, _, crossed = polygon_triangles(square, np.arange(6), np.array([6]))
    a, b, c = square[places].transpose(1, 0, 2)
    assert crossed == 0 and (np.cross(b - a, c - a)[:, 2] > 0).all()
    # A hole, joined to the outline by a slit that is run through both ways.
    outer, inner = [[0, 0], [4, 0], [4, 4], [0, 4]], [[1, 1], [1, 3], [3, 3], [3, 1]]
    ring = np.array([*outer, outer[0], *inner, inner[0]], float)
    ring = np.c_[ring, np.zeros(len(ring))]
    places, _, crossed = polygon_triangles(ring, np.arange(10), np.array([10]))
    a, b, c = ring[places].transpose(1, 0, 2)
    double_area = np.cross(b - a, c - a)[:, 2]
    assert crossed == 0 and (double_area >= 0).all() and double_area.sum() == pytest.approx(24)
    bow = np.array([[0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 2, 0], [-1, 1, 0]], float)
    assert polygon_triangles(bow, np.arange(5), np.array([5]))[2] == 1


def soup(mesh):
    vertices, faces = mesh
    return vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)


@pytest.mark.parametrize("double", [False, True])
def test_corners_are_joined_within_rounding_and_not_beyond(double):
    vertices, faces = soup(box(center=(0.5, 0.5, 0.5)))
    step = np.spacing(1.0) if double else float(np.spacing(np.float32(1)))
    for moved, closed in ((1e-17, True), (3 * step, True), (40 * step, False)):
        points = vertices.copy()
        points[7] += moved
        joined, triangles, rows, collapsed = closed_seams(points, faces, double)
        assert (check_mesh(joined, triangles).holes == 0) == closed and collapsed == 0
        assert len(joined) == (8 if closed else 9)
        assert np.abs(joined[rows] - points).max() <= moved


def test_what_is_closed_is_not_joined(tmp_path):
    a, b = box(), box(center=(1.0, 0, 0))
    vertices = np.concatenate([a[0], b[0]])
    faces = np.concatenate([a[1], b[1] + 8])
    joined, triangles, rows, _ = closed_seams(vertices, faces, True)
    np.testing.assert_array_equal(joined, vertices)
    np.testing.assert_array_equal(triangles, faces)
    np.testing.assert_array_equal(rows, np.arange(16))


def stl_text(mesh, end="endsolid"):
    lines = ["solid part"]
    for corners in mesh[0][mesh[1]].tolist():
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += [f"  vertex {x!r} {y!r} {z!r}" for x, y, z in corners]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, f"{end} part", ""])


def test_stl_as_people_have_it(tmp_path):
    file, mesh = tmp_path / "a.stl", box(center=(0.5, 0.5, 0.5))
    for end in ("endsolid", "end solid"):
        text = stl_text(mesh, end)
        one_line = " ".join(text.split())
        for content in (text, text.replace("\n", "\r\n"), text.upper(), text + text, one_line):
            file.write_text(content)
            assert open_mesh(file).raw.faces.shape == (12 * content.upper().count("SOLID") // 2, 3)
    noisy = stl_text(mesh).replace("vertex 0.0 0.0 0.0", "vertex 1e-17 0.0 0.0", 1)
    file.write_text(noisy)
    assert check_mesh(*read_mesh(file)).ok
    for wrong, message in (
        (stl_text(mesh).replace("vertex 1.0", "vertex", 1), "triangle 1 must have three vertices"),
        (stl_text(mesh)[:-200], "does not end with endsolid; it is cut"),
        (stl_text(mesh)[: stl_text(mesh).rfind("facet")], "does not end with endsolid; it is cut"),
        (stl_text(mesh).replace("1.0", "1.0.0", 1), "does not hold numbers"),
    ):
        file.write_text(wrong)
        with pytest.raises(ValueError, match=rf"a\.stl.*{message}"):
            read_mesh(file)
    trimesh.Trimesh(*mesh, process=False).export(file)
    content = file.read_bytes()
    file.write_bytes(content + b"\0\0")
    assert open_mesh(file).notes == ("2 bytes after the last triangle are left out",)
    file.write_bytes(content[:80] + struct.pack("<I", 4_000_000_000) + content[84:])
    with pytest.raises(ValueError, match=r"announces 4,000,000,000 triangles.*and has 684; it is"):
        read_mesh(file)


def test_seams_of_texture_in_a_ply_are_closed(tmp_path):
    vertices, faces = box()
    corners, triangles = soup((vertices, faces))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(corners)}\n"
    header += "".join(f"property float {name}\n" for name in "xyzst")
    header += f"element face {len(faces)}\nproperty list uchar int vertex_index\nend_header\n"
    rows = [" ".join(map(repr, [*row, k / 40, 0.5])) for k, row in enumerate(corners.tolist())]
    rows += [f"3 {a} {b} {c}" for a, b, c in triangles.tolist()]
    (tmp_path / "a.ply").write_text(header + "\n".join(rows))
    found = open_mesh(tmp_path / "a.ply")
    assert len(found.vertices) == 8 and check_mesh(found.vertices, found.faces).ok
    assert found.raw.extras == ("texture coordinates",) and len(found.raw.vertices) == 36


def test_triangle_strips_in_a_ply(tmp_path):
    """A tetrahedron as one strip, and as two in one list."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    header = "ply\nformat ascii 1.0\nelement vertex 4\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    rows = "\n".join(" ".join(map(str, row)) for row in vertices.tolist())
    for strip in ([1, 0, 2, 3, 1, 0], [1, 0, 2, 3, -1, 2, 3, 1, -1, 3, 0, 1]):
        (tmp_path / "a.ply").write_text(
            header + rows + f"\n{len(strip)} {' '.join(map(str, strip))}"
        )
        found, faces = read_mesh(tmp_path / "a.ply")
        assert len(faces) == 4 and check_mesh(found, faces).ok
        assert signed_volume(found, faces) == pytest.approx(1 / 6)


def test_ply_that_announces_what_it_does_not_have(tmp_path):
    vertices, polygons, _ = star_prism()
    file = tmp_path / "a.ply"
    write_ply(file, vertices, polygons, "binary_little_endian")
    whole = file.read_bytes()
    text = tmp_path / "b.ply"
    write_ply(text, vertices, polygons)
    for content, message in (
        (whole.replace(b"vertex 20", b"vertex 9999999999999"), "announces 9,999,999,999,999 rows"),
        (whole.replace(b"face 12", b"face 13"), "ends at face 12 of 13; it is cut"),
        (whole[:-3], "it is cut"),
        (whole.replace(b"list uchar", b"list uint"), "it is cut|list of"),
        (whole.replace(b"end_header", b"end_heade"), 'no line "end_header"'),
        (whole.replace(b"property double z", b"property double w"), "x, y and z"),
        (whole.replace(b"element face", b"oddity face"), "header has the line 'oddity face 12'"),
        (text.read_bytes() + b" nonsense", "something else than numbers"),
        (text.read_bytes()[:-1] + b"1.5", "whole numbers of the type int: got"),
        (text.read_bytes()[:-2] + b"77", "got index 77 for 20 vertices"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.ply.*({message})"):
            read_mesh(file)
    file.write_bytes(whole + b"\0\0")
    assert open_mesh(file).notes == ("2 bytes after the last row are left out",)
    with pytest.raises(TooLargeError, match=r"a\.ply' must not take more than 100 bytes"):
        read_mesh(file, max_bytes=100)


def test_off_as_people_have_it(tmp_path):
    vertices, polygons, volume = star_prism()
    file = tmp_path / "a.off"
    write_off(file, vertices, polygons)
    plain = file.read_text()
    colored = plain.replace("OFF\n20 12 0\n", "# made by hand\n\n OFF 20 12 0\n") + " 255 0 0"
    broken = plain.replace("\n4 ", "\n4\n ")
    for content in (colored, broken, plain.replace("OFF\n", "OFF")):
        file.write_text(content)
        found, faces = read_mesh(file)
        assert signed_volume(found, faces) == pytest.approx(volume)
    for content, message in (
        (plain.replace("20 12 0", "20 13 0"), "ends at face 12 of 13; it is cut"),
        (plain.replace("20 12 0", "20 999999999 0"), "announces 20 vertices and 999,999,999 faces"),
        (plain.replace("OFF", "4OFF"), "another space"),
        (plain.replace("OFF", "FOO"), "must begin with OFF"),
        (plain.replace("\n4 0 1", "\n-4 0 1"), "announces -4 corners"),
        (plain.replace("\n4 0 1", "\n4 0 99"), "got index 99 for 20 vertices"),
    ):
        file.write_text(content)
        with pytest.raises(ValueError, match=rf"a\.off.*{message}"):
            read_mesh(file)


def test_obj_lines_that_are_damaged_are_named(tmp_path):
    file = tmp_path / "a.obj"
    for content, message in (
        ("v 0 0\nf 1 2 3", "line 1 is 'v 0 0'"),
        ("v 0 0 0\nv 1 x 0", "line 2 is 'v 1 x 0'"),
        ("v 0 0 0\nf 0 1 1", "line 2 is 'f 0 1 1' .indices count from 1"),
        ("v 0 0 0\nf 1 1 99999999999999999999", "beyond all bounds"),
        ("v 0 0 0\nf 1 1 -3", "got index -2 for 1 vertices"),
    ):
        file.write_text(content)
        with pytest.raises(ValueError, match=rf"a\.obj.*{message}"):
            read_mesh(file)
    file.write_text("v 0 0 0 # here\nv 1 0 0\nv 0 1 0\nf 1 2\nf 1 2 3 # a triangle\n")
    assert open_mesh(file).notes == ("1 face of fewer than three corners left out",)


def test_what_has_no_triangles_is_told_apart(tmp_path):
    for content, message in (
        ("v 0 0 0\nv 1 0 0\n", "a point cloud of 2 points and no faces; reconstruct a surface"),
        ("v 0 0 0\nv 1 0 0\nl 1 2\n", "1 lines or curves and no faces; a wireframe is no surface"),
        ("# empty\n", "with nothing in it; export the mesh again"),
    ):
        (tmp_path / "a.obj").write_text(content)
        with pytest.raises(ValueError, match=message):
            read_mesh(tmp_path / "a.obj")


def glb(tree, binary=b""):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def unpacked_glb(mesh):
    """JSON and binary part of a mesh as trimesh writes it."""
    content = trimesh.Trimesh(*mesh, process=False).export(file_type="glb")
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def test_gltf_that_announces_too_much_or_would_be_read_wrongly(tmp_path):
    tree, binary = unpacked_glb(box())
    file = tmp_path / "a.glb"
    file.write_bytes(glb(tree, binary))
    assert check_mesh(*read_mesh(file)).ok
    position = tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]

    def changed(**values):
        accessors = [dict(accessor) for accessor in tree["accessors"]]
        accessors[position].update(values)
        return tree | {"accessors": accessors}

    def unfilled():
        found = changed(count=10**12)
        del found["accessors"][position]["bufferView"]
        return found

    gpu = {
        "nodes": [node | {"extensions": {"EXT_mesh_gpu_instancing": {}}} for node in tree["nodes"]]
    }
    outside = {"buffers": [{"byteLength": 4, "uri": "../a.bin"}]}
    missing = {"buffers": [{"byteLength": 4, "uri": "a%20b.bin"}]}
    packed = {"buffers": [{"byteLength": 4, "uri": "data:application/octet-stream;base1e9,AAAA"}]}
    for content, message in (
        (glb(changed(count=10**9), binary), "announces 12,000,000,000 bytes of a view that has"),
        (glb(unfilled(), binary), "must not take more than 1,073,741,824 bytes: got 12,0"),
        (glb(changed(sparse={}), binary), "sparse accessor; export it without"),
        (glb(changed(normalized=True), binary), "normalized whole numbers"),
        (glb(changed(count="x"), binary), "announces 'x' entries"),
        (glb(tree | {"extensionsRequired": ["EXT_meshopt_compression"]}, binary), "EXT_meshopt"),
        (glb(tree | gpu, binary), "EXT_mesh_gpu_instancing"),
        (glb(tree | outside, binary), "buffer 0 must lie beside it"),
        (glb(tree | missing, binary), "buffer 0 is missing: 'a%20b.bin'"),
        (glb(tree | packed, binary), "buffer 0 must be in base64: got 'data:"),
        (glb(tree, binary)[:200], "announces .* bytes and has 200; it is cut"),
        (b"glTF" + struct.pack("<I", 1) + bytes(20), "it is glTF 1"),
        (b"[" * 99_999, 'must begin with "glTF"'),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=rf"a\.glb.*{message}|{message}.*a\.glb"):
            read_mesh(file)
    (tmp_path / "a.gltf").write_bytes(b"[" * 99_999)
    with pytest.raises(ValueError, match="must not be nested so deeply"):
        read_mesh(tmp_path / "a.gltf")


def test_a_missing_package_is_named_with_what_installs_it(tmp_path, monkeypatch):
    monkeypatch.setattr("spt_jax.io.meshes.scenes.find_spec", lambda name: None)
    for suffix, packages in (
        ("3mf", "networkx lxml"),
        ("dae", "pycollada"),
        ("step", "cascadio"),
        ("drc", "DracoPy"),
    ):
        (tmp_path / f"a.{suffix}").write_bytes(b"")
        with pytest.raises(
            ValueError, match=rf"a\.{suffix}'; reading it needs .*pip install {packages}"
        ):
            read_mesh(tmp_path / f"a.{suffix}")
    tree, binary = unpacked_glb(box())
    tree["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}
    (tmp_path / "a.glb").write_bytes(glb(tree, binary))
    with pytest.raises(ValueError, match="pip install DracoPy"):
        read_mesh(tmp_path / "a.glb")
    for name, advice in (("a.obj.gz", "unpack it first"), ("a.dxf", "convert it to")):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(ValueError, match=f"must have one of the suffixes.*{advice}"):
            read_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", ["stl", "obj", "off", "ply", "glb"])
def test_damaged_files_are_refused_by_name_or_read(tmp_path, suffix):
    mesh = trimesh.Trimesh(*box(), process=False)
    whole = io.BytesIO()
    mesh.export(whole, file_type=suffix)
    file = tmp_path / f"a.{suffix}"
    for seed in range(60):
        rng = np.random.default_rng(seed)
        content = bytearray(whole.getvalue())
        for place in rng.integers(0, len(content), rng.integers(1, 4)):
            content[place] = rng.integers(256)
        if seed % 4 == 0:
            content = content[: rng.integers(len(content))]
        file.write_bytes(content)
        try:
            vertices, faces = read_mesh(file)
        except ValueError as error:
            assert file.name in str(error)
        else:
            assert np.isfinite(vertices).all() and 0 <= faces.min() <= faces.max() < len(vertices)


def test_lines_of_a_ply_that_say_more_than_the_header(tmp_path):
    vertices, polygons, volume = star_prism()
    file = tmp_path / "a.ply"
    write_ply(file, vertices, polygons)
    header, body = file.read_text().replace("\n4\n", "\n4 ").split("end_header\n")
    lines = body.replace("\n10\n", "\n10 ").splitlines()
    file.write_text(header + "end_header\n" + "\n".join(f"{line} 7 8" for line in lines))
    found = open_mesh(file)
    assert signed_volume(found.vertices, found.faces) == pytest.approx(volume)
    assert found.notes == (
        "numbers at the ends of lines that its header does not name are left out",
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_lists_of_differing_lengths_between_other_properties(tmp_path, order):
    """Polygons of a binary .ply with a number before the list and a color behind it."""
    vertices, polygons, volume = star_prism()
    form = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{form}_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += f"element face {len(polygons)}\nproperty short part\n"
    header += "property list ushort uint vertex_index\nproperty uchar red\nend_header\n"
    body = vertices.astype(order + "f8").tobytes()
    for k, polygon in enumerate(polygons):
        row = (k, len(polygon), *polygon, 200 + k)
        body += struct.pack(f"{order}hH{len(polygon)}IB", *row)
    file = tmp_path / "a.ply"
    file.write_bytes(header.encode() + body)
    opened = open_mesh(file)
    assert signed_volume(opened.vertices, opened.faces) == pytest.approx(volume)
    opened.write(tmp_path / "b.ply", opened.vertices)
    raw = trimesh.load_mesh(tmp_path / "b.ply", process=False).metadata["_ply_raw"]["face"]["data"]
    owners = np.repeat(np.arange(12), [8, 8] + [2] * 10)
    np.testing.assert_array_equal(raw["part"], owners)
    np.testing.assert_array_equal(raw["red"], 200 + owners)
    file.write_bytes(header.encode() + body[:-4])
    with pytest.raises(ValueError, match="ends at face 11 of 12; it is cut"):
        read_mesh(file)


def test_a_glb_under_the_name_of_a_gltf_is_refused_by_that_name(tmp_path):
    """trimesh looks for another file then, and names that one alone; the fuzz found it."""
    path = tmp_path / "thing.gltf"
    path.write_bytes(trimesh.creation.box().export(file_type="glb"))
    with pytest.raises(ValueError, match=r"thing\.gltf.*it is a \.glb under another name"):
        read_mesh(path)
