"""`spt-jax untangle` of frames that follow each other: one motion, or a scene of people."""

import json
import pickle

import numpy as np
import pytest
from helpers_motion import smpl_tongs, snap

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.cli import motion_frames
from spt_jax.cli.main import main
from spt_jax.io.pose_files import load_poses, write_poses
from spt_jax.untangle import motion as motion_module

LAYOUT = SMPL_LAYOUTS[22]


@pytest.fixture(autouse=True)
def small_body(monkeypatch):
    monkeypatch.setattr("spt_jax.body.load_body", lambda *_, **__: smpl_tongs())


def as_smpl(pose):
    found = np.zeros((len(pose), 22, 3), np.float32)
    found[:, 0] = pose[:, 0]
    found[:, LAYOUT.index("left_ankle")] = pose[:, 1]
    found[:, LAYOUT.index("right_wrist")] = pose[:, 2]
    return found


def motion_file(path, pose, **given):
    names = [f"snap/{k:04d}" for k in range(len(pose))]
    write_poses(path, as_smpl(pose), names=names, **given)
    return str(path)


@pytest.mark.slow
def test_a_motion_is_freed_as_a_whole(tmp_path, capsys):
    pose = snap()[12:29]
    file, out = motion_file(tmp_path / "m.npz", pose, frame_rate=60.0), tmp_path / "out"
    assert main(["untangle", file, "--out", str(out), "--meshes"]) == 0
    captured = capsys.readouterr()
    assert "17 frames, " in captured.out and " 0 after; the public rule" in captured.out
    assert "up is taken to be" in captured.err and "frame rate" not in captured.err
    assert sorted(path.name for path in out.iterdir()) == ["motion.glb", "poses.npz", "report.json"]
    (found,) = load_poses(out / "poses.npz")
    assert found.frame_rate == 60.0 and found.names[0] == "snap/0000"
    report = json.loads((out / "report.json").read_text())
    assert report["settings"]["frames_per_second"] == 60.0
    (one,) = report["motions"]
    assert one["frames"] == one["free_frames"] == 17 and one["after"]["colliding_frames"] == 0
    assert one["before"]["colliding_frames"] > 3 and one["mean_displacement"] > 0
    result = motion_module.untangle_motion(
        smpl_tongs(), as_smpl(pose), frames_per_second=60.0, up=tuple(report["settings"]["up"])
    )
    np.testing.assert_allclose(found.pose, result.pose, atol=1e-6)

    words = ["untangle", file, "--out", str(out), "--fps", "30", "--up", "y", "--json"]
    assert main([*words, "--quiet"]) == 0
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert captured.err == "" and report["settings"]["frames_per_second"] == 30.0
    assert report["settings"]["up"] == [0.0, 1.0, 0.0]


@pytest.mark.long
def test_frame_by_frame_where_that_is_said(tmp_path, capsys, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("no motion was asked for")

    monkeypatch.setattr("spt_jax.untangle.motion.untangle_motion", refuse)
    file = motion_file(tmp_path / "m.npz", snap()[18:20])
    words = ["untangle", file, "--out", str(tmp_path / "out")]
    assert main([*words, "--frame-by-frame"]) == 0
    assert "2 frames, 2 collision-free" in capsys.readouterr().out
    assert main([*words, "--frames", "0"]) == 0
    assert main([*words, "--folds", "count", "--keep-contact"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["settings"]["contacts"] == "found"
    assert "the motion is freed frame by frame" in capsys.readouterr().err
    assert main(["untangle", file, "--out", str(tmp_path / "out"), "--up", "q"]) == 2


@pytest.mark.long
def test_two_tracks_are_one_scene(tmp_path, capsys):
    pose = np.zeros((9, 2, 3, 3), np.float32)
    bump = np.exp(-(((np.arange(9) - 4) / 1.5) ** 2) / 2)
    pose[:, 0, 2, 2], pose[:, 1, 1, 2] = -0.3 * bump, 0.3 * bump
    people = {}
    for k in range(2):
        smpl = as_smpl(pose[:, k])
        people[k] = {
            "pose": np.concatenate([smpl, np.zeros((9, 2, 3))], axis=1).reshape(9, 72),
            "trans": np.tile([0.42 * k, 0.01 * k, 0.0], (9, 1)),
            "betas": np.zeros((9, 10)),
            "verts": np.zeros((9, 4, 3)),
            "frame_ids": np.arange(9),
        }
    file = tmp_path / "wham_output.pkl"
    file.write_bytes(pickle.dumps(people))
    out = tmp_path / "out"
    words = ["untangle", str(file), "--out", str(out)]
    assert main([*words, "--together"]) == 0
    captured = capsys.readouterr()
    assert "2 people as one scene" in captured.err
    assert "within people: 0 frames collide before, 0 after" in captured.out
    assert "between people: " in captured.out and "between people: 0" not in captured.out
    report = json.loads((out / "report.json").read_text())
    assert [one["people"] for one in report["motions"]] == [2]
    assert report["motions"][0]["between_after"]["colliding_frames"] == 0
    assert len(report["files"]) == 2
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [one["people"] for one in report["motions"]] == [1, 1]
    assert not any(one["before"]["colliding_frames"] for one in report["motions"])


@pytest.mark.long
def test_a_run_that_was_ended_goes_on(tmp_path, capsys, monkeypatch):
    pose = np.concatenate([snap(frames=31), snap(frames=31, lean=0.6)])
    file = motion_file(tmp_path / "m.npz", pose)
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert main(["untangle", file, "--out", str(whole)]) == 0
    freed, seen = motion_frames.untangle_pieces, []

    def ended(*arguments, state, **options):
        def told(text, done=None):
            if "round" in text:
                seen.append(text.partition("frames ")[2].partition(",")[0])
            if len(set(seen)) > 1:
                raise KeyboardInterrupt
            state(text, done)

        return freed(*arguments, state=told, **options)

    monkeypatch.setattr("spt_jax.cli.motion_command.untangle_pieces", ended)
    assert main(["untangle", file, "--out", str(out)]) == 130
    assert list(out.glob("unfinished/motion_000/window_*.npz")) and not (out / "poses.npz").exists()
    monkeypatch.setattr("spt_jax.cli.motion_command.untangle_pieces", freed)
    assert main(["untangle", file, "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["poses.npz", "report.json"]
    for name in ("pose", "poses"):
        with np.load(whole / "poses.npz") as one, np.load(out / "poses.npz") as other:
            if name in one:
                np.testing.assert_array_equal(one[name], other[name])


def test_frames_that_do_not_follow_are_not_one_motion(tmp_path):
    from spt_jax.cli.motions import chosen

    pose = np.zeros((8, 3, 3), np.float32)
    names = [f"{'walk' if k < 5 else 'run'}/{k:04d}" for k in range(8)]
    write_poses(tmp_path / "m.npz", as_smpl(pose), names=names)
    asked = chosen(tmp_path / "m.npz", "all", "0-1,3-7", None)
    pieces = motion_frames.pieces_of(asked, together=True)
    assert [piece.rows for piece in pieces] == [((0, 1),), ((2, 3),), ((4, 5, 6),)]
