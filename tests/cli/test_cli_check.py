"""`spt-jax check`: its words and its three exit codes."""

import json
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from helpers import box, inverted, join

from spt_jax.cli.main import main


def write(path, mesh):
    trimesh.Trimesh(*mesh, process=False).export(path)
    return str(path)


def test_check_of_a_clean_mesh(tmp_path, capsys):
    assert main(["check", write(tmp_path / "a.ply", box()), "--rays", "64"]) == 0
    assert "it does not self-intersect" in capsys.readouterr().out


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_verdict_follows_from_pairs_and_from_volume(dtype, tmp_path, capsys):
    """Beams that meet at corners: many pairs, next to no volume, and rays that see nothing of it;
    one in another: volume and no pairs; one on another: neither."""
    beams = join(box((4, 0.01, 0.01)), box((0.01, 4, 0.01)), box((0.01, 0.01, 4)))
    nested, touching = join(box(), box((0.5, 0.5, 0.5))), join(box(), box(center=(1, 0, 0)))
    for mesh, code in ((beams, 1), (nested, 1), (touching, 0)):
        path = tmp_path / "a.off"
        lines = ["OFF", f"{len(mesh[0])} {len(mesh[1])} 0"]
        lines += [" ".join(map(repr, row)) for row in mesh[0].astype(dtype).tolist()]
        lines += [f"3 {a} {b} {c}" for a, b, c in mesh[1].tolist()]
        path.write_text("\n".join(lines))
        for rays in ([], ["--rays", "16"]):
            assert main(["check", str(path), *rays]) == code
            text = capsys.readouterr().out
            assert ("it self-intersects" in text) == bool(code)
            assert ("it does not self-intersect" in text) == (not code)
        assert main(["check", str(path), "--json"]) == code
        found = json.loads(capsys.readouterr().out)["intersection"]
        assert found["is_free"] == (not code) and found["exact"]
        assert (found["intersecting_pairs"] > 0) == (mesh is beams)


def test_a_mesh_whose_exact_sums_do_not_close_is_warned_of(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("spt_jax.overlap.exact.ExactOverlap.sound", property(lambda self: False))
    mesh = write(tmp_path / "a.ply", join(box(), box(center=(0.53, 0.1, 0.2))))
    assert main(["check", mesh]) == 1
    seen = capsys.readouterr()
    assert seen.err.startswith("warning: the exact sums do not close") and seen.err.count("\n") == 1
    assert "it self-intersects" in seen.out
    assert main(["check", mesh, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["intersection"]["exact"] and "rays were cast" in found["warning"]
    assert main(["check", mesh, "--rays", "64"]) == 1  # which were asked for
    assert capsys.readouterr().err == ""


def test_check_of_a_mesh_that_intersects_itself(tmp_path, capsys):
    mesh = write(tmp_path / "a.stl", join(box(), box(center=(0.53, 0.1, 0.2))))
    assert main(["check", mesh, "--rays", "64"]) == 1
    text = capsys.readouterr().out
    assert "it self-intersects" in text and "overlap volume" in text


@pytest.mark.parametrize(
    ("mesh", "seen"),
    [
        ((box()[0], box()[1][:4]), "an open sheet: 1 hole of"),
        (inverted(box()), "1 inverted component of 1"),
        ((box()[0], np.concatenate([box()[1][1:], box()[1][:1, ::-1]])), "3 edges that both"),
    ],
)
def test_check_of_a_mesh_that_cannot_be_judged(mesh, seen, tmp_path, capsys):
    assert main(["check", write(tmp_path / "a.ply", mesh)]) == 2
    text = capsys.readouterr().out
    assert seen in text and "overlap volume" not in text


def test_check_of_what_is_no_mesh(tmp_path, capsys):
    (tmp_path / "a.ply").write_text("ply\nnonsense")
    for name in ("a.ply", "missing.ply", "a.xyz2"):
        assert main(["check", str(tmp_path / name)]) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.startswith("spt-jax: mesh file must ")
        assert captured.err.count("\n") == 1
    assert main(["check", write(tmp_path / "b.ply", box()), "--rays", "0"]) == 2
    assert "rays must be from 1 to 4096 a side: got 0" in capsys.readouterr().err


def test_check_as_json(tmp_path, capsys):
    def checked(path, code):
        assert main(["check", str(path), "--json", "--rays", "32"]) == code
        captured = capsys.readouterr()
        found = json.loads(captured.out)
        assert captured.err == "" and found["exit_code"] == code
        return found

    clean = checked(write(tmp_path / "a.ply", box()), 0)
    assert clean["mesh"]["components"] == 1 and clean["intersection"]["volume"] == 0
    pair = checked(write(tmp_path / "b.ply", join(box(), box(center=(0.5, 0, 0)))), 1)
    assert pair["intersection"]["volume"] == pytest.approx(0.5, rel=0.1)
    hole = checked(write(tmp_path / "c.ply", (box()[0], box()[1][1:])), 0)
    assert hole["mesh"]["boundary_edges"] == hole["mesh"]["largest_hole"]["edges"] == 3
    assert hole["intersection"]["holes"][0]["edges"] == 3 and hole["mesh"]["ok"]
    sheet = checked(write(tmp_path / "s.ply", (box()[0], box()[1][:4])), 2)
    assert sheet["mesh"]["open_sheets"] == 1 and sheet["intersection"] is None
    missing = checked(tmp_path / "d.ply", 2)
    assert "must exist" in missing["error"] and missing["mesh"] is None


def test_check_quiet_says_it_with_the_exit_code(tmp_path, capsys):
    assert main(["check", write(tmp_path / "a.ply", box()), "--rays", "32", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_check_as_a_process(tmp_path):
    path = write(tmp_path / "a.ply", join(box(), box(center=(0.5, 0, 0))))
    command = [sys.executable, "-m", "spt_jax", "check", path, "--rays", "64"]
    found = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert found.returncode == 1 and found.stderr == ""
    assert "penetrating" in found.stdout and "\x1b" not in found.stdout
