"""A mesh that is written with other positions keeps what its file had, or says what it lost."""

import json
import shutil

import numpy as np
import pytest
import trimesh
from helpers import box, join
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from spt_jax._mesh_check import check_mesh
from spt_jax.cli.main import main
from spt_jax.io.mesh_files import open_mesh, read_mesh

OVERLAPPING = join(box(), box(center=(0.53, 0.1, 0.2)))
KEPT = ("vt ", "usemtl ", "mtllib ", "g ", "# ")


def write_obj(folder):
    """Two boxes of quadrilaterals that overlap, with texture coordinates, a material, a picture."""
    quads = [[1, 2, 4, 3], [5, 7, 8, 6], [1, 5, 6, 2], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]]
    lines = ["# made by hand", "mtllib two parts.mtl"]
    for center in ((0, 0, 0), (0.53, 0.1, 0.2)):
        for x in (-0.5, 0.5):
            for y in (-0.5, 0.5):
                for z in (-0.5, 0.5):
                    p = np.add(center, (x, y, z)).tolist()
                    lines.append(f"v {p[0]!r} {p[1]!r} {p[2]!r} 0.2 0.3 0.4")
    lines += [f"vt 0.{k} 0.5" for k in range(4)]
    for part in (0, 8):
        lines += [f"g part{part}", "usemtl red"]
        for quad in quads:
            lines.append("f " + " ".join(f"{i + part}/{k + 1}" for k, i in enumerate(quad)))
    (folder / "a.obj").write_text("\n".join(lines))
    (folder / "two parts.mtl").write_text("newmtl red\nKd 1 0 0\nmap_Kd -s 1 1 1 red.png\n")
    Image.new("RGB", (2, 2), "red").save(folder / "red.png")
    return folder / "a.obj"


def test_obj_keeps_all_but_positions_and_brings_its_materials(tmp_path):
    file = write_obj(tmp_path)
    opened = open_mesh(file)
    assert opened.raw.extras == ("vertex colors", "texture coordinates", "materials")
    assert check_mesh(opened.vertices, opened.faces).ok
    out = tmp_path / "out"
    out.mkdir()
    moved = opened.vertices + 1 / 3
    assert opened.write(out / "b.obj", moved) == ()
    read, faces = read_mesh(out / "b.obj")
    np.testing.assert_array_equal(read, moved)
    np.testing.assert_array_equal(faces, opened.faces)
    before, after = (f.read_text().splitlines() for f in (file, out / "b.obj"))
    assert [x for x in after if x.startswith(KEPT)] == [x for x in before if x.startswith(KEPT)]
    assert all(line.endswith(" 0.2 0.3 0.4") for line in after if line.startswith("v "))
    corners = [line.split()[1:] for line in after if line.startswith("f ")]
    assert len(corners) == 24 and all("/" in corner for line in corners for corner in line)
    assert sorted(path.name for path in out.iterdir()) == ["b.obj", "red.png", "two parts.mtl"]
    (tmp_path / "red.png").unlink()
    shutil.rmtree(out)
    out.mkdir()
    (note,) = opened.write(out / "b.obj", moved)
    assert note == "b.obj names files that were not found: red.png"
    (note,) = opened.write(out / "b.ply", moved)
    assert note == "left out in b.ply: vertex colors, texture coordinates, materials"


def test_names_in_a_mesh_reach_nothing_outside_of_its_folder(tmp_path):
    (tmp_path / "secret.mtl").write_text("newmtl x")
    inner, out = tmp_path / "in", tmp_path / "out"
    inner.mkdir()
    out.mkdir()
    file = write_obj(inner)
    file.write_text(file.read_text().replace("two parts.mtl", "../secret.mtl"))
    opened = open_mesh(file)
    (note,) = opened.write(out / "b.obj", opened.vertices)
    assert note.endswith("were not found: ../secret.mtl")
    assert [path.name for path in out.iterdir()] == ["b.obj"]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_keeps_colors_and_texture_coordinates(tmp_path, form, dtype):
    vertices, faces = box()
    names = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("s", "f4"), ("red", "u1"), ("green", "u1")]
    rows = np.zeros(8, [*names, ("blue", "u1")])
    for k, axis in enumerate("xyz"):
        rows[axis] = vertices[:, k]
    rows["s"], rows["red"] = np.arange(8) / 8, np.arange(8)
    kinds = {"f4": "float", "u1": "uchar"}
    head = ["ply", f"format {form} 1.0", "comment kept", "element vertex 8"]
    head += [f"property {kinds[rows.dtype[name].str[1:]]} {name}" for name in rows.dtype.names]
    head += ["element face 12", "property list uchar int vertex_indices", "property uchar red"]
    if form == "ascii":
        body = "\n".join(" ".join(map(str, row.tolist())) for row in rows) + "\n"
        body += "\n".join(f"3 {a} {b} {c} {k}" for k, (a, b, c) in enumerate(faces.tolist()))
        body = body.encode()
    else:
        packed = np.zeros(12, [("n", "u1"), ("corners", "<i4", 3), ("red", "u1")])
        packed["n"], packed["corners"], packed["red"] = 3, faces, np.arange(12)
        body = rows.tobytes() + packed.tobytes()
    file = tmp_path / "a.ply"
    file.write_bytes("\n".join([*head, "end_header\n"]).encode() + body)
    opened = open_mesh(file)
    moved = (opened.vertices * np.pi).astype(dtype)
    assert opened.write(tmp_path / "b.ply", moved) == ()
    again = open_mesh(tmp_path / "b.ply")
    np.testing.assert_array_equal(again.vertices, moved)
    np.testing.assert_array_equal(again.faces, faces)
    assert again.raw.extras == ("texture coordinates", "colors")
    mesh = trimesh.load_mesh(tmp_path / "b.ply", process=False)
    raw = mesh.metadata["_ply_raw"]
    np.testing.assert_array_equal(raw["vertex"]["data"]["red"], np.arange(8))
    np.testing.assert_allclose(raw["vertex"]["data"]["s"], np.arange(8) / 8)
    np.testing.assert_array_equal(raw["face"]["data"]["red"], np.arange(12))
    assert b"comment kept" in (tmp_path / "b.ply").read_bytes()


def test_off_keeps_colors_of_vertices_and_faces(tmp_path):
    vertices, faces = box()
    lines = ["COFF", "8 12 0"] + [f"{x} {y} {z} 9 8 7 6" for x, y, z in vertices.tolist()]
    lines += [f"3 {a} {b} {c} {k} 0 0" for k, (a, b, c) in enumerate(faces.tolist())]
    (tmp_path / "a.off").write_text("\n".join(lines))
    opened = open_mesh(tmp_path / "a.off")
    moved = opened.vertices / 3
    assert opened.write(tmp_path / "b.off", moved) == ()
    written = (tmp_path / "b.off").read_text().splitlines()
    assert written[0] == "COFF" and all(line.endswith(" 9 8 7 6") for line in written[2:10])
    assert [line.split()[-3] for line in written[10:]] == [str(k) for k in range(12)]
    np.testing.assert_array_equal(read_mesh(tmp_path / "b.off")[0], moved)


def textured_glb(path):
    """Two overlapping boxes, each corner of a face its own vertex, with a picture on them."""
    vertices, faces = OVERLAPPING
    corners = vertices[faces].reshape(-1, 3)
    uv = np.random.default_rng(0).random((len(corners), 2))
    picture = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    material = PBRMaterial(name="skin", baseColorTexture=picture)
    visual = TextureVisuals(uv=uv, material=material)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    mesh = trimesh.Trimesh(corners, triangles, visual=visual, process=False)
    mesh.vertex_normals  # noqa: B018
    mesh.export(path, include_normals=True)
    return uv


def test_glb_keeps_materials_pictures_and_texture_coordinates(tmp_path, capsys):
    uv = textured_glb(tmp_path / "a.glb")
    out = tmp_path / "out"
    assert main(["untangle", str(tmp_path / "a.glb"), "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "note: left out in a_untangled.glb: normals" in said
    report = json.loads((out / "report.json").read_text())
    assert report["notes"] == ["left out in a_untangled.glb: normals"]
    (mesh,) = trimesh.load_scene(out / "a_untangled.glb", process=False).geometry.values()
    np.testing.assert_allclose(mesh.visual.uv, uv, atol=1e-6)
    assert mesh.visual.material.name == "skin"
    seen = np.asarray(mesh.visual.material.baseColorTexture)
    np.testing.assert_array_equal(seen[..., :3], np.arange(48).reshape(4, 4, 3))
    assert len(mesh.vertices) == 72
    vertices = read_mesh(out / "a_untangled.glb")[0]
    assert len(vertices) == 16 and main(["check", str(out / "a_untangled.glb"), "--quiet"]) == 0


def test_stl_says_what_it_loses(tmp_path):
    trimesh.Trimesh(*box(), process=False).export(tmp_path / "a.stl")
    content = bytearray((tmp_path / "a.stl").read_bytes())
    content[132:134] = b"\x1f\x80"
    (tmp_path / "a.stl").write_bytes(content)
    opened = open_mesh(tmp_path / "a.stl")
    notes = opened.write(tmp_path / "b.stl", opened.vertices.astype(np.float32))
    assert notes == ("left out in b.stl: attributes or colors of triangles",)
