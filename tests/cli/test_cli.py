"""`spt-jax demo` and `spt-jax untangle`, in this process and in one of their own."""

import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers_body import synthetic_smpl
from trimesh.visual import ColorVisuals

from spt_jax import Step
from spt_jax.body import load_mocap
from spt_jax.cli import main as cli
from spt_jax.cli.demo import DEMO_FRAMES
from spt_jax.cli.main import main
from spt_jax.cli.motions import select_frames
from spt_jax.io.pose_files import read_poses, write_poses


@pytest.fixture
def calls(monkeypatch):
    """The arguments of every call of a stand-in for untangle_pose, which unbends the pose."""
    made = []

    def stand_in(body, pose, *, shape=None, translation=None, on_step=None, **options):
        made.append(dict(pose=pose, shape=shape, translation=translation, **options))
        on_step(Step(0, 1, np.zeros((4, 3)), np.asarray(pose)))
        on_step(Step(1, 2, np.zeros((4, 3)), np.asarray(pose)))
        pose = 0.05 * pose
        vertices = body(pose, shape, translation).vertices
        return SimpleNamespace(
            pose=pose,
            vertices=vertices,
            steps=np.int32(7),
            is_free=np.bool_(True),
            reason="collision-free",
        )

    replace_untangle_pose(monkeypatch, stand_in)
    return made


def replace_untangle_pose(monkeypatch, function):
    monkeypatch.setattr("spt_jax.untangle.pose.untangle_pose", function)


def files_in(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def mocap_file(path, names):
    mocap = load_mocap()
    pose = mocap.pose[[mocap.names.index(name) for name in names]]
    np.savez(path, pose=pose, name=np.array(names), joints=np.array(mocap.joints))
    return str(path)


@pytest.mark.parametrize("words", [[], ["demo"], ["check"], ["untangle"]])
def test_help(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert "usage: spt-jax" in text and ("--quiet" in text or not words)
    assert all(command in text for command in ("demo", "check", "untangle")) or words


def test_an_unknown_command_exits_with_2(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["tangle"])
    assert stop.value.code == 2


def test_the_demo_frames_are_bundled_and_distinct():
    assert set(DEMO_FRAMES) <= set(load_mocap().names)
    assert len(set(DEMO_FRAMES)) == len(DEMO_FRAMES) >= 4


def test_demo_without_pictures(calls, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    assert main(["demo", "--out", str(tmp_path / "a" / "b"), "--frames", "2"]) == 0
    folder = tmp_path / "a" / "b"
    meshes = [
        f"{name}_{when}{suffix}"
        for name in ("backflip_0022", "punch_0013")
        for when in ("after", "before")
        for suffix in (".glb", ".ply")
    ]
    assert files_in(folder) == sorted([*meshes, "poses.npz", "report.json"])
    captured = capsys.readouterr()
    assert "The picture was left out: pictures need pyvista" in captured.err
    assert "spt-jax[viz]" in captured.err
    assert "punch/0013" in captured.out and "cm³" in captured.out and "\x1b" not in captured.out
    # Nothing is left out: the skin is freed of its folds, too.
    assert "left out as folds: 0.00 cm³ and 0 intersecting pairs before" in captured.out

    report = json.loads((folder / "report.json").read_text())
    assert report["picture"] is None and "pyvista" in report["picture_left_out"]
    assert sorted(report["meshes"]) == sorted(meshes)
    assert {"jax", "numpy", "spt-jax"} <= set(report["versions"])
    assert [frame["name"] for frame in report["frames"]] == list(DEMO_FRAMES[:2])
    for frame in report["frames"]:
        assert frame["before"]["volume"] > 1e-5 > frame["after"]["volume"]
        assert frame["steps"] == 7 and frame["seconds"] > 0
        assert frame["is_free"] and frame["reason"] == "collision-free"
    poses = read_poses(folder / "poses.npz")
    assert poses.names == list(DEMO_FRAMES[:2]) and poses.pose.shape == (2, 52, 3)
    np.testing.assert_allclose(poses.pose, [0.05 * call["pose"] for call in calls])
    mesh = trimesh.load_mesh(folder / "punch_0013_before.ply", process=False)
    assert isinstance(mesh.visual, ColorVisuals)
    assert len(mesh.vertices) == 12272 and len(np.unique(mesh.visual.vertex_colors, axis=0)) == 2


def test_demo_draws(calls, tmp_path, capsys):
    pytest.importorskip("pyvista")
    assert main(["demo", "--out", str(tmp_path), "--frames", "1", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    report = json.loads((tmp_path / "report.json").read_text())
    drawn = (tmp_path / "before_after.png").exists()
    assert drawn == (report["picture"] == "before_after.png") == (not report["picture_left_out"])


def test_demo_has_so_many_frames(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "a"), "--frames", "9"]) == 2
    assert "frames must be from 1 to 8: got 9" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("command", ["demo", "untangle"])
def test_a_folder_that_cannot_be_written_is_found_before_the_work(command, calls, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    words = [mocap_file(tmp_path / "m.npz", ["walk/0005"])] if command == "untangle" else []
    assert main([command, *words, "--out", str(tmp_path / "file" / "below")]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("spt-jax: out must be a folder that can be written: got ")
    assert captured.err.count("\n") == 1 and captured.out == ""
    assert calls == [] and (tmp_path / "file").read_text() == ""


@pytest.mark.parametrize("command", ["demo", "untangle"])
def test_interrupted_while_it_works(command, tmp_path, capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    replace_untangle_pose(monkeypatch, interrupt)
    words = [mocap_file(tmp_path / "m.npz", ["walk/0005"])] if command == "untangle" else []
    out = tmp_path / "out"
    assert main([command, *words, "--out", str(out)]) == 130
    captured = capsys.readouterr()
    assert captured.err == "spt-jax: interrupted; no file is left half-written\n"
    assert captured.out == "" and files_in(out) == []


@pytest.mark.skipif(sys.platform == "win32", reason="SIGINT is sent to a process")
def test_ctrl_c_ends_the_process_cleanly_in_the_middle_of_a_computation(tmp_path):
    out = tmp_path / "out"
    # What a shell runs in the background, and all that it starts, ignores Ctrl-C: heard again here.
    heard = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    )
    demo = ["-m", "spt_jax", "demo", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, "-c", heard, *demo],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        for _ in range(600):
            if out.exists():
                break
            time.sleep(0.1)
        time.sleep(5)  # well into the first frame, whose solver calls back into Python
        process.send_signal(signal.SIGINT)
        printed = process.communicate(timeout=60)
    finally:
        process.kill()
    assert printed == ("", "spt-jax: interrupted; no file is left half-written\n")
    assert process.returncode == 130 and files_in(out) == []


@pytest.mark.skipif(sys.platform == "win32", reason="SIGINT is sent to a process")
def test_ctrl_c_that_python_ignores_is_raised_again():
    script = """
import os, signal, time
from spt_jax.cli.interrupts import hear_again

class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)  # it is raised here, where Python ignores it

signal.signal(signal.SIGINT, signal.default_int_handler)
hear_again()
try:
    thing = Finalized()
    del thing
    print("ignored", flush=True)
    time.sleep(30)
except KeyboardInterrupt:
    print("heard")
"""
    command = [sys.executable, "-c", script]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=25)
    assert (ended.stdout, ended.stderr, ended.returncode) == ("ignored\nheard\n", "", 0)


def test_ctrl_c_within_a_callback_is_an_interruption_too(tmp_path, capsys, monkeypatch):
    def hears(*_, **__):
        raise KeyboardInterrupt

    def calls_back(*_, **__):
        jax.jit(lambda x: jax.pure_callback(hears, x, x))(jnp.zeros(3)).block_until_ready()

    monkeypatch.setattr("spt_jax.body.load_body", calls_back)
    file = mocap_file(tmp_path / "m.npz", ["walk/0005"])
    assert main(["untangle", file, "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "spt-jax: interrupted; no file is left half-written\n"


def test_interrupted_while_it_writes(calls, tmp_path, capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", interrupt)
    file = mocap_file(tmp_path / "m.npz", ["walk/0005"])
    out = tmp_path / "out"
    assert main(["untangle", file, "--out", str(out), "--rays", "64", "--meshes"]) == 130
    meshes = ["walk_0005_after.glb", "walk_0005_before.glb"]
    kept = ["unfinished", *(f"unfinished/{name}" for name in ("000000.npz", "manifest.json"))]
    assert [name for name in files_in(out) if name != "unfinished/lock"] == [*kept, *meshes]
    for name in meshes:
        assert len(trimesh.load_scene(out / name).geometry) == 1


def test_untangle_of_chosen_frames(calls, tmp_path, capsys):
    names = ["walk/0005", "walk/0006", "punch/0013", "run/0018"]
    file = mocap_file(tmp_path / "m.npz", names)
    out = tmp_path / "out"
    words = ["untangle", file, "--out", str(out), "--frames", "punch/0013,0-1", "--rays", "128"]
    assert main([*words, "--meshes"]) == 0
    text = capsys.readouterr().out
    assert "punch/0013" in text and "run/0018" not in text and "6 meshes" in text
    assert "3 frames, 3 collision-free: " in text
    (line,) = [line for line in text.splitlines() if line.startswith("left out as folds: ")]
    assert read_poses(out / "poses.npz").names == ["punch/0013", "walk/0005", "walk/0006"]
    assert [call["rays"] for call in calls] == [64] * 3  # half of what the report is made with
    assert len(list(out.glob("*.glb"))) == 6
    report = json.loads((out / "report.json").read_text())
    assert report["settings"]["rays"] == 128 and len(report["meshes"]) == 6
    counts = [frame["before"] for frame in report["frames"]]
    pairs = sum(c["total_intersecting_pairs"] - c["intersecting_pairs"] for c in counts)
    volume = sum(f["before"]["total_volume"] - f["before"]["volume"] for f in report["frames"])
    assert (
        f"{1e6 * volume:.2f} cm³ and {pairs} intersecting pairs before, " in line
        and pairs > 0 < volume
    )

    assert main([*words, "--json"]) == 0
    captured = capsys.readouterr()
    assert [frame["name"] for frame in json.loads(captured.out)["frames"]] == [
        "punch/0013",
        "walk/0005",
        "walk/0006",
    ]


def test_what_is_a_fold_is_set_from_the_command_line(calls, tmp_path, capsys):
    file = mocap_file(tmp_path / "m.npz", ["run/0005"])
    counted = {}
    for words in ([], ["--fold-distance", "0"], ["--fold-distance", "9"], ["--folds", "count"]):
        assert main(["untangle", file, "--out", str(tmp_path / "out"), *words]) == 0
        text = capsys.readouterr().out
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        (frame,) = report["frames"]
        found = frame["before"]
        counted[" ".join(words)] = found["intersecting_pairs"]
        left = found["total_intersecting_pairs"] - found["intersecting_pairs"]
        assert f"and {left} intersecting pairs before" in text
        volume = 1e6 * (frame["before"]["total_volume"] - frame["before"]["volume"])
        assert f"left out as folds: {volume:.2f} cm³" in text
    assert [call["fold_distance"] for call in calls] == [None, 0.0, 9.0, None]
    assert counted[""] == counted["--fold-distance 9"] == 0
    assert counted["--fold-distance 0"] > 50 < counted["--folds count"]
    assert counted["--folds count"] == found["total_intersecting_pairs"]


def test_a_pose_that_cannot_be_measured_is_named(calls, tmp_path, capsys):
    pose = np.zeros((1, 22, 3))
    write_poses(tmp_path / "far.npz", pose, translation=np.full((1, 3), 1e5), names=["far/away"])
    out = tmp_path / "out"
    assert main(["untangle", str(tmp_path / "far.npz"), "--out", str(out)]) == 2
    seen = capsys.readouterr()
    assert seen.err.startswith("spt-jax: far/away: vertices must not be farther from the origin")
    assert seen.err.count("\n") == 1 and seen.out == "" and files_in(out) == []


def test_a_surface_that_cannot_be_measured_is_one_line_wherever_it_comes_up(monkeypatch, capsys):
    from spt_jax.overlap.measure import Unmeasurable

    def fail(*_, **__):
        raise Unmeasurable("vertices must be finite:\ngot NaN")

    replace_untangle_pose(monkeypatch, fail)
    monkeypatch.setattr("spt_jax.files.outputs.ensure_folder", lambda path: path)
    assert main(["demo", "--frames", "1", "--quiet"]) == 2
    said = "spt-jax: punch/0013: vertices must be finite: got NaN\n"
    assert capsys.readouterr() == ("", said)

    def command() -> int:
        return fail()

    monkeypatch.setitem(cli._COMMANDS, "demo", command)
    assert main(["demo"]) == 2
    assert capsys.readouterr() == ("", "spt-jax: vertices must be finite: got NaN\n")


def test_untangle_frees_a_real_pose(tmp_path, capsys):
    file = mocap_file(tmp_path / "m.npz", ["crawl/0092"])
    out = tmp_path / "out"
    words = ["untangle", file, "--out", str(out), "--rays", "128", "--folds", "count"]
    assert main(words) == 0
    (frame,) = json.loads((out / "report.json").read_text())["frames"]
    assert frame["before"]["volume"] > 1e-5
    assert frame["after"]["volume"] < 0.1 * frame["before"]["volume"]
    assert frame["steps"] > 0
    assert read_poses(out / "poses.npz").pose.shape == (1, 52, 3)


def test_untangle_keeps_translation_and_leaves_out_what_the_body_lacks(calls, tmp_path, capsys):
    pose = np.zeros((2, 55, 3))
    pose[1, 22] = 0.1  # the jaw
    file = tmp_path / "smplx.npz"
    write_poses(file, pose, shape=np.ones(16), translation=np.array([[1.0, 2, 3], [4, 5, 6]]))
    out = tmp_path / "out"
    assert main(["untangle", str(file), "--out", str(out), "--rays", "32", "--frames", "1"]) == 0
    notes = capsys.readouterr().err
    assert "the body lacks jaw;" in notes and "its mean shape is used" in notes
    written = read_poses(out / "poses.npz")
    assert written.shape is None and written.pose.shape == (1, 52, 3)
    np.testing.assert_array_equal(written.translation, [[4, 5, 6]])
    np.testing.assert_array_equal(calls[0]["translation"], [4, 5, 6])
    assert len(json.loads((out / "report.json").read_text())["notes"]) == 2


def test_untangle_of_a_body_file(calls, tmp_path, capsys, rng):
    model = tmp_path / "model.npz"
    np.savez(model, **synthetic_smpl(rng, joints=24, components=10))
    shape = rng.normal(size=(3, 16))
    write_poses(tmp_path / "amass.npz", rng.normal(size=(3, 52, 3)), shape=shape)
    out = tmp_path / "out"
    words = ["untangle", str(tmp_path / "amass.npz"), "--body", str(model), "--out", str(out)]
    assert main([*words, "--rays", "32"]) == 0
    written = read_poses(out / "poses.npz")
    assert written.pose.shape == (3, 24, 3)
    np.testing.assert_allclose(written.shape, shape[:, :10], rtol=1e-6)
    np.testing.assert_allclose([call["shape"] for call in calls], shape[:, :10], rtol=1e-6)
    notes = json.loads((out / "report.json").read_text())["notes"]
    assert any("after the body's 10 are left out" in note for note in notes)
    assert any("left_index1, left_index2" in note for note in notes)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "4"], "frames must be rows 0 to 1, ranges of them or names such as 'walk/00"),
        (["--frames", "1-0"], "got '1-0'"),
        (["--frames", "0,jog"], "got 'jog'; separate several by commas"),
        (["--rays", "-1"], "rays must be from 1"),
        (["--fold-distance", "-0.1"], "fold_distance must be finite and not negative: got -0.1"),
        (["--body", "missing.npz"], "no body model file at missing.npz"),
    ],
)
def test_untangle_of_bad_input(words, message, calls, tmp_path, capsys):
    file = mocap_file(tmp_path / "m.npz", ["walk/0005", "walk/0006"])
    assert main(["untangle", file, "--out", str(tmp_path / "out"), *words]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1
    assert captured.err.startswith("spt-jax: ") and calls == []


def test_untangle_of_what_is_no_pose_file(tmp_path, capsys):
    (tmp_path / "a.npz").write_text("nonsense")
    for name in ("a.npz", "missing.npz"):
        assert main(["untangle", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
        assert "pose file must " in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_error_of_ours_keeps_its_traceback(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise ValueError("a bug")

    replace_untangle_pose(monkeypatch, fail)
    file = mocap_file(tmp_path / "m.npz", ["walk/0005"])
    with pytest.raises(ValueError, match="a bug"):
        main(["untangle", file, "--out", str(tmp_path / "out"), "--rays", "32"])
    assert files_in(tmp_path / "out") == []


def test_select_frames():
    names = ["a/0", "a/1", "b-2", "3"]
    assert select_frames(names, "all") == [0, 1, 2, 3]
    assert select_frames(names, "b-2, 0-1,1") == [2, 0, 1]
    assert select_frames(names, "3,2") == [3, 2]
    for wrong in ("", "1-9", "-1", "1-", "c"):
        with pytest.raises(ValueError, match="frames must be rows 0 to 3"):
            select_frames(names, wrong)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a pseudo-terminal is needed")
def test_progress_shows_on_a_terminal(tmp_path):
    import pty

    code = (
        "from spt_jax.cli.terminal import progress_bar\n"
        "with progress_bar(2) as state:\n"
        "    state('walk/0005: stage 1', done=1)\n"
        "print('done')\n"
    )
    ours, theirs = pty.openpty()
    try:
        found = subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=theirs, timeout=120
        )
        seen = os.read(ours, 65536).decode()
    finally:
        os.close(ours)
        os.close(theirs)
    assert found.stdout == b"done\n" and "walk/0005: stage 1" in seen
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120)
    assert found.stdout == b"done\n" and found.stderr == b""
