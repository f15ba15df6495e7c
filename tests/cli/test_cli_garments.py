"""`spt-jax check --solids` and `untangle --fixed`: an open mesh beside closed ones."""

import json

import numpy as np
import pytest
import trimesh

from spt_jax.cli.main import main
from spt_jax.io import read_mesh


@pytest.fixture
def files(tmp_path):
    """A band around a ball, that reaches into it on two sides; and an open band wider than long."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    band = trimesh.creation.cylinder(radius=0.205, height=0.1, sections=32)
    sides = band.faces[np.abs(band.face_normals[:, 2]) < 0.5]
    garment = trimesh.Trimesh(band.vertices * [0.93, 1.07, 1.0], sides)
    garment.remove_unreferenced_vertices()
    paths = tmp_path / "garment.obj", tmp_path / "body.obj"
    for mesh, path in zip((garment, ball), paths, strict=True):
        mesh.export(path)
    return tuple(map(str, paths))


def test_a_garment_is_judged_and_freed_beside_a_body(files, tmp_path, capsys):
    garment, body = files
    out = tmp_path / "out"
    assert main(["check", garment, "--solids", body, "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["solids"] == body and report["intersection"]["depth"] > 0.001
    assert main(["untangle", garment, "--fixed", body, "--out", str(out), "--meshes"]) == 0
    freed = out / "garment_untangled.obj"
    report = json.loads((out / "report.json").read_text())
    assert report["is_free"] and report["settings"]["fixed"] == body
    assert report["meshes"] == ["garment_before.glb", "garment_after.glb"]
    before, after = read_mesh(garment), read_mesh(freed)
    np.testing.assert_array_equal(before[1], after[1])  # the body is not in it
    assert 0 < np.abs(before[0] - after[0]).max() < 0.02
    capsys.readouterr()
    assert main(["check", str(freed), "--solids", body]) == 0
    assert "nothing of it lies in body.obj" in capsys.readouterr().out
    scene = trimesh.load_scene(out / "garment_before.glb")
    assert sum(len(part.faces) for part in scene.geometry.values()) == 64 + 320


def test_what_does_not_stand_beside_a_mesh_is_refused(files, tmp_path, capsys):
    garment, body = files
    sheet = tmp_path / "sheet.obj"
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(sheet)
    out = ["--out", str(tmp_path / "out")]
    for words, message in (
        (["untangle", garment, "--fixed", str(sheet), *out], "fixed must be a mesh of closed"),
        (["untangle", garment, "--fixed", "none.obj", *out], "mesh file must exist: got 'none"),
        (["untangle", "poses.npz", "--fixed", body, *out], "fixed is for meshes: got it with a"),
        (["check", garment, "--solids", body, "--rays", "8"], "rays cannot be cast at an open"),
    ):
        assert main(words) == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert main(["check", garment, "--solids", str(sheet)]) == 2
    assert "sheet.obj cannot be judged before" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
