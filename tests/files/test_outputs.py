import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from trimesh.visual import ColorVisuals

from spt_jax.files.outputs import atomic_write, ensure_folder, write_json
from spt_jax.io.mesh_files import (
    BODY_COLOR,
    INVERTED_COLOR,
    PENETRATING_COLOR,
    as_mesh_arrays,
    read_mesh,
    write_mesh,
)


def cube():
    box = trimesh.creation.box()
    return np.array(box.vertices), np.array(box.faces)


def is_closed(vertices, faces):
    return trimesh.Trimesh(vertices, faces, process=False).is_watertight


def labelled_cube():
    vertices, faces = cube()
    return vertices * np.pi, faces, np.array([0, 1, -1, 0, 0, 1, 0, -1], np.int8)


COLOURS = {0: BODY_COLOR, 1: PENETRATING_COLOR, -1: INVERTED_COLOR}


def test_ply_opens_elsewhere_with_the_same_colors(tmp_path):
    vertices, faces, labels = labelled_cube()
    write_mesh(tmp_path / "a.ply", vertices, faces, labels)
    mesh = trimesh.load_mesh(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, vertices, rtol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    expected = [(*COLOURS[label], 255) for label in labels.tolist()]
    assert isinstance(mesh.visual, ColorVisuals)
    np.testing.assert_array_equal(mesh.visual.vertex_colors, expected)


def test_glb_opens_elsewhere_with_linear_colors_and_a_material_that_is_no_metal(tmp_path):
    vertices, faces, labels = labelled_cube()
    write_mesh(tmp_path / "a.glb", vertices, faces, labels)
    (mesh,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    np.testing.assert_allclose(mesh.vertices, vertices, rtol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert mesh.visual.material.metallicFactor == 0
    linear = mesh.visual.vertex_attributes["color"][:, :3] / 255
    srgb = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    expected = np.array([COLOURS[label] for label in labels.tolist()])
    # One step of a dark linear byte is up to a dozen sRGB steps.
    np.testing.assert_allclose(np.where(linear > 0, srgb, 0) * 255, expected, atol=14)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_written_meshes_read_back(tmp_path, suffix):
    vertices, faces, _ = labelled_cube()
    write_mesh(tmp_path / f"a{suffix}", jnp.asarray(vertices, jnp.float32), jnp.asarray(faces))
    read, triangles = read_mesh(tmp_path / f"a{suffix}")
    assert read.dtype == np.float64 and triangles.dtype == np.int64
    np.testing.assert_allclose(read, vertices, rtol=1e-6)
    np.testing.assert_array_equal(triangles, faces)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{suffix}"]


def test_double_precision_is_kept(tmp_path):
    """In a .ply to the bit, of meshes near the origin and far from it; in a .glb as far as its
    float32 about the mesh's middle goes. What float32 holds is stored so."""
    vertices, faces, _ = labelled_cube()
    sizes = {}
    for name, points in (
        ("single", vertices.astype(np.float32).astype(np.float64)),
        ("double", vertices),
        ("far", vertices + np.array([4e6, -3e5, 12.5])),
    ):
        for suffix in (".ply", ".glb"):
            file = tmp_path / f"{name}{suffix}"
            write_mesh(file, points, faces)
            read, triangles = read_mesh(file)
            np.testing.assert_array_equal(triangles, faces)
            off = np.abs(read - points).max()
            assert off == 0 if suffix == ".ply" else off < 3e-7
        header = (tmp_path / f"{name}.ply").read_bytes().split(b"end_header")[0]
        assert (b"property double x" in header) == (name != "single")
        sizes[name] = len((tmp_path / f"{name}.ply").read_bytes())
    assert sizes["single"] < sizes["double"] == sizes["far"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, ValueError])
def test_an_interrupted_write_leaves_what_was_there(tmp_path, monkeypatch, error):
    vertices, faces, _ = labelled_cube()
    file = tmp_path / "a.ply"
    for before in (None, b"old"):
        if before is not None:
            file.write_bytes(before)

        def half(self, data):
            with open(self, "wb") as stream:
                stream.write(data[:10])
            raise error("stop")

        with monkeypatch.context() as patch:
            patch.setattr(Path, "write_bytes", half)
            with pytest.raises(error, match="stop"):
                write_mesh(file, vertices, faces)
        assert [p.read_bytes() for p in tmp_path.iterdir()] == ([] if before is None else [before])


def test_folders_that_cannot_be_written_are_named(tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    vertices, faces, _ = labelled_cube()
    with pytest.raises(NotADirectoryError, match=r"out must be a folder.*file.*Not a directory"):
        write_mesh(blocker / "a.ply", vertices, faces)
    with pytest.raises(FileNotFoundError, match=r"out must be a folder.*No such file"):
        write_mesh(tmp_path / "missing" / "a.ply", vertices, faces)
    with pytest.raises(OSError, match="out must be a folder"):
        ensure_folder(blocker / "below")
    with pytest.raises(OSError, match="out must be a folder"):
        ensure_folder(blocker)
    with pytest.raises(IsADirectoryError, match="must name a file"), atomic_write(tmp_path):
        pass


def test_permission_denied_is_said(tmp_path, monkeypatch):
    def denied(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "touch", denied)
    with pytest.raises(PermissionError, match=r"can be written: got .* \(Permission denied\)"):
        write_json(tmp_path / "a.json", {})


def test_ensure_folder_makes_parents_and_leaves_nothing(tmp_path):
    folder = ensure_folder(tmp_path / "a" / "b")
    assert folder.is_dir() and not list(folder.iterdir())
    assert ensure_folder(str(folder)) == folder


def test_write_json(tmp_path):
    value = {"a": np.float32(0.5), "b": jnp.arange(3), "c": [np.int64(2), None], "d": Path("x")}
    write_json(tmp_path / "a.json", value)
    expected = {"a": 0.5, "b": [0, 1, 2], "c": [2, None], "d": "x"}
    assert json.loads((tmp_path / "a.json").read_text()) == expected
    with pytest.raises(ValueError, match="must be finite"):
        write_json(tmp_path / "b.json", {"a": np.array([np.nan])})
    with pytest.raises(TypeError, match="got set"):
        write_json(tmp_path / "b.json", {"a": {1}})
    assert not (tmp_path / "b.json").exists()


@pytest.mark.parametrize("suffix", ["stl", "obj", "glb", "off", "ply"])
def test_a_closed_cube_reads_as_closed(tmp_path, suffix):
    vertices, faces = cube()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"c.{suffix}")
    read, triangles = read_mesh(tmp_path / f"c.{suffix}")
    assert len(read) == 8 and is_closed(read, triangles)
    np.testing.assert_allclose(read[triangles], vertices[faces])


def test_obj_with_texture_normal_and_material_seams_reads_as_closed(tmp_path):
    vertices, faces = cube()
    lines = ["mtllib none.mtl", "o cube"]
    lines += [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"vt {i / 36} 0.5" for i in range(36)] + [f"vn 0 0 {i + 1}" for i in range(12)]
    for i, face in enumerate(faces + 1):
        if i in (0, 6):
            lines.append(f"usemtl m{i}")
        lines.append("f " + " ".join(f"{v}/{3 * i + k + 1}/{i + 1}" for k, v in enumerate(face)))
    (tmp_path / "c.obj").write_text("\n".join(lines))
    read, triangles = read_mesh(tmp_path / "c.obj")
    assert is_closed(read, triangles)
    np.testing.assert_array_equal(read, vertices)
    np.testing.assert_array_equal(triangles, faces)


def test_obj_polygons_and_relative_indices(tmp_path):
    (tmp_path / "p.obj").write_text(
        "v 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf 1 2 \\\n 3 4\n"
    )
    vertices, faces = read_mesh(tmp_path / "p.obj")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])
    (tmp_path / "q.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n")
    with pytest.raises(ValueError, match=r"q\.obj.*got index 3 for 3 vertices"):
        read_mesh(tmp_path / "q.obj")


def test_glb_with_split_vertices_reads_as_closed(tmp_path):
    vertices, faces = cube()
    soup = trimesh.Trimesh(
        vertices[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    soup.export(tmp_path / "c.glb")
    read, triangles = read_mesh(tmp_path / "c.glb")
    assert len(read) == 8 and is_closed(read, triangles)


@pytest.mark.parametrize("suffix", ["obj", "glb", "ply"])
def test_closed_parts_that_touch_stay_apart(tmp_path, suffix):
    vertices, faces = cube()
    both = np.concatenate([vertices, vertices + np.array([1.0, 0, 0])])
    mesh = trimesh.Trimesh(both, np.concatenate([faces, faces + 8]), process=False)
    mesh.export(tmp_path / f"c.{suffix}")
    read, triangles = read_mesh(tmp_path / f"c.{suffix}")
    np.testing.assert_allclose(read, both)
    np.testing.assert_array_equal(triangles, mesh.faces)


def test_scene_transforms_are_applied_and_mirrors_keep_the_outside_out(tmp_path):
    box = trimesh.creation.box()
    scene = trimesh.Scene(box)
    mirror = np.diag([-2.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = 5
    scene.add_geometry(box, transform=mirror)
    scene.export(tmp_path / "s.glb")
    read, triangles = read_mesh(tmp_path / "s.glb")
    mesh = trimesh.Trimesh(read, triangles, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(3)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.5, -0.5], [6, 0.5, 0.5]])


def test_mesh_files_that_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="mesh file must exist"):
        read_mesh(tmp_path / "none.ply")
    with pytest.raises(ValueError, match="got the folder"):
        read_mesh(tmp_path)
    (tmp_path / "a.blend").write_text("")
    with pytest.raises(ValueError, match="must have one of the suffixes"):
        read_mesh(tmp_path / "a.blend")
    (tmp_path / "a.ply").write_text("ply\n")
    with pytest.raises(ValueError, match=r"readable \.ply file"):
        read_mesh(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("# nothing\n")
    with pytest.raises(ValueError, match="must hold triangles"):
        read_mesh(tmp_path / "a.obj")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "p.ply")
    with pytest.raises(
        ValueError, match=r"must hold triangles.*point cloud of 3 points.*reconstruct"
    ):
        read_mesh(tmp_path / "p.ply")
    (tmp_path / "n.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match=r"n\.off.*vertices must be finite.*vertex 1"):
        read_mesh(tmp_path / "n.off")


def test_arrays_that_are_refused(tmp_path):
    vertices, faces = cube()
    for arguments, message in [
        ((vertices[:, :2], faces), r"vertices must be \(V, 3\)"),
        ((vertices, faces.astype(float)), "faces must be"),
        ((vertices, faces[:0]), "at least one triangle"),
        ((vertices, faces + 1), "got index 8 for 8 vertices"),
        ((vertices, faces - 1), "got index -1"),
        ((vertices, faces, np.full(8, 2)), "labels must be"),
        ((vertices, faces, np.zeros(7, int)), "labels must be"),
    ]:
        with pytest.raises(ValueError, match=message):
            as_mesh_arrays(*arguments)
    with pytest.raises(ValueError, match=r"\.glb or \.ply"):
        write_mesh(tmp_path / "a.obj", vertices, faces)
