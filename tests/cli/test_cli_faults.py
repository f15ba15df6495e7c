"""The command line where files, disks and pipes fail: one line, an exit code, no traceback."""

import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import box
from helpers_body import ball_arrays

from spt_jax.cli.main import main
from spt_jax.cli.terminal import CommandError
from spt_jax.view.files import open_file, open_upload

SUFFIXES = ["ply", "obj", "off", "stl", "glb", "gltf", "3mf", "dae", "step", "drc", "xyz", "npz"]


@pytest.fixture
def clean(tmp_path):
    trimesh.Trimesh(*box(), process=False).export(tmp_path / "a.ply")
    return str(tmp_path / "a.ply")


@pytest.fixture
def full():
    if not os.path.exists("/dev/full"):
        pytest.skip("the system has no /dev/full")
    with open("/dev/full", "w") as stream:
        yield stream


@pytest.fixture
def closed_pipe():
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stream:
        yield stream


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_a_full_disk_under_the_output(clean, words, full, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdout", full)
    assert main(["check", clean, *words]) == 2
    assert capsys.readouterr().err == (
        "spt-jax: standard output must be writable: got No space left on device; send it "
        "elsewhere\n"
    )


def test_a_full_disk_under_the_errors(full, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stderr", full)
    assert main(["check", "missing.ply"]) == 2
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("words", [["check"], ["check", "--json"], ["--help"]])
def test_a_pipe_whose_reader_has_gone(clean, words, closed_pipe, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdout", closed_pipe)
    assert main([*words, *([clean] if words[0] == "check" else [])]) == 141
    assert capsys.readouterr().err == ""


def test_an_output_that_knows_no_cubes(clean, monkeypatch):
    ascii_only = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", ascii_only)
    assert main(["check", clean]) == 0
    assert b"0 unit\\xb3" in ascii_only.buffer.getvalue()


def test_a_stream_that_is_closed_is_nothing_to_write_to(clean, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["check", clean]) == 0


@pytest.mark.parametrize("command", ["check", "untangle"])
@pytest.mark.parametrize("content", [b"", b"\0", b"nonsense\n" * 9, bytes(range(256)) * 9])
def test_no_file_brings_a_traceback(command, content, tmp_path, capsys):
    for suffix in SUFFIXES:
        file = tmp_path / f"odd [bold]name\n.{suffix}"
        file.write_bytes(content)
        words = ["--out", str(tmp_path / "out")] if command == "untangle" else []
        assert main([command, str(file), *words]) == 2
        seen = capsys.readouterr()
        assert seen.out == "" and seen.err.startswith("spt-jax: ") and seen.err.count("\n") == 1
        assert "odd [bold]name" in seen.err
    assert not (tmp_path / "out").exists()


def test_what_is_no_file(tmp_path, capsys):
    for path in (tmp_path, "/dev/null", "a" * 5000 + ".ply", "a\0.ply"):
        assert main(["check", str(path)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(5, "Input/output error"), "must be readable: got .*a.ply.*Input/output error"),
        (MemoryError(), "must fit into memory: got .*a.ply"),
        (RecursionError(), "must not be nested so deeply: got .*a.ply"),
    ],
)
def test_errors_of_the_machine_have_the_file(error, said, clean, capsys, monkeypatch):
    import re

    def fail(content):
        raise error

    monkeypatch.setattr("spt_jax.io.meshes.reading.read_ply", fail)
    assert main(["check", clean]) == 2
    seen = capsys.readouterr().err
    assert re.search(rf"spt-jax: mesh file {said}", seen) and seen.count("\n") == 1


def test_a_measurement_that_does_not_fit_into_memory(clean, capsys, monkeypatch):
    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr("spt_jax._report.intersection_report", fail)
    assert main(["check", clean]) == 2
    assert capsys.readouterr().err.startswith("spt-jax: there is not enough memory for this;")


def test_limits_are_told_and_can_be_raised(clean, tmp_path, capsys):
    assert main(["check", clean, "--max-bytes", "100"]) == 2
    assert "raise max_bytes (--max-bytes)" in capsys.readouterr().err
    assert main(["check", clean, "--max-bytes", "1000000", "--quiet"]) == 0
    np.savez_compressed(tmp_path / "a.npz", poses=np.zeros((9000, 66)))
    words = ["untangle", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out")]
    assert main([*words, "--max-bytes", "100000"]) == 2
    assert "must not take more than 100,000 bytes: got 4,752,000" in capsys.readouterr().err


@pytest.mark.parametrize("given", ["keypoints", "camera", "image", "body"])
def test_every_file_of_a_fit_is_held_to_the_limit_and_lets_it_be_raised(
    given, tmp_path, capsys, monkeypatch, rng
):
    np.savez(tmp_path / "small.npz", keypoints=100 * rng.random((1, 17, 2)), layout="coco17")
    np.savez(tmp_path / "camera.npz", matrix=np.ones((3, 4)), focal=np.ones(999))
    np.savez(tmp_path / "body.npz", **ball_arrays())
    np.savez(tmp_path / "keypoints.npz", keypoints=np.ones((9, 17, 3)), layout="coco17")
    PIL = pytest.importorskip("PIL.Image")
    PIL.new("RGB", (60, 60)).save(tmp_path / "image.png")
    file = next(tmp_path.glob(f"{given}.*"))
    words = ["fit", str(tmp_path / "small.npz"), "--out", str(tmp_path / "out"), "--quiet"]
    words += [f"--{given}", str(file)]
    words = ["fit", str(file), *words[2:5]] if given == "keypoints" else words
    assert main([*words, "--max-bytes", "2000"]) == 2
    seen = capsys.readouterr().err
    assert file.name in seen and "must not take more than 2,000 bytes" in seen
    assert "raise max_bytes (--max-bytes)" in seen and seen.count("\n") == 1
    monkeypatch.setattr("spt_jax.cli.fitting.fit_everyone", _stop)
    main([*words, "--max-bytes", "1000000"])
    assert "must not take" not in capsys.readouterr().err


def _stop(*_, **__):
    raise CommandError("far enough")


def test_a_view_s_files_are_held_to_the_limit_and_let_it_be_raised(clean, tmp_path, capsys):
    pytest.importorskip("viser")
    assert main(["view", clean, "--quiet", "--max-bytes", "100"]) == 2
    seen = capsys.readouterr().err
    assert "raise max_bytes (--max-bytes)" in seen and seen.count("\n") == 1
    np.savez(tmp_path / "body.npz", **ball_arrays())
    np.savez_compressed(tmp_path / "poses.npz", poses=np.zeros((9000, 66)))
    for file in (Path(clean), tmp_path / "body.npz", tmp_path / "poses.npz"):
        for opened in (
            lambda limit, file=file: open_file(file, max_bytes=limit),
            lambda limit, file=file: open_upload(file.name, file.read_bytes(), max_bytes=limit),
        ):
            with pytest.raises(ValueError, match=f"{file.stem}.*--max-bytes"):
                opened(100)
            opened(10_000_000)


def test_what_was_done_to_read_a_file_is_said(tmp_path, capsys):
    trimesh.Trimesh(*box(), process=False).export(tmp_path / "a.stl")
    with open(tmp_path / "a.stl", "ab") as file:
        file.write(b"\0\0")
    note = "2 bytes after the last triangle are left out"
    assert main(["check", str(tmp_path / "a.stl")]) == 0
    assert capsys.readouterr().err == f"note: {note}\n"
    assert main(["check", str(tmp_path / "a.stl"), "--json"]) == 0
    assert f'"{note}"' in capsys.readouterr().out
    assert main(["untangle", str(tmp_path / "a.stl"), "--out", str(tmp_path / "out")]) == 0
    assert f"note: {note}\n" in capsys.readouterr().err
