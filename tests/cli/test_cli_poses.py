"""`spt-jax untangle` and `view` with the pose files of every structure."""

import json

import helpers_poses as made
import numpy as np
import pytest
from helpers_body import synthetic_hand, synthetic_smpl
from helpers_poses import MADE, as_matrix
from test_cli import calls as calls  # the fixture
from test_cli import files_in

from spt_jax.body import expression_as_shape, load_body
from spt_jax.cli.main import main
from spt_jax.io.pose_files import MotionFile, load_poses, open_poses
from spt_jax.view import files
from spt_jax.view.scene import Scene


def written(folder, name):
    one = MADE[name]()
    file = folder / f"{name}{one.suffix}"
    file.write_bytes(one.content)
    return file


def run(file, out, *words):
    return main(["untangle", str(file), "--out", str(out), "--rays", "16", "--quiet", *words])


@pytest.mark.parametrize("name", ["amass", "gvhmr", "romp", "bvh"])
def test_a_file_of_any_structure_is_untangled(name, calls, tmp_path):
    file, out = written(tmp_path, name), tmp_path / "out"
    assert run(file, out, "--frames", "0") == 0
    track = load_poses(file)[0]
    found = "poses.npz" if name != "romp" else "poses_0.npz"
    assert files_in(out) == sorted([found, "report.json"])
    (again,) = load_poses(out / found)
    assert (again.frame_rate, again.gender) == (track.frame_rate, track.gender)
    assert again.names == [track.names[0]]
    if track.translation is not None:
        np.testing.assert_allclose(again.translation, track.translation[:1], rtol=1e-6)
    report = json.loads((out / "report.json").read_text())
    assert report["structure"] == open_poses(file).structure and report["files"] == [found]
    assert len(calls) == 1


def test_like_input_writes_the_files_own_structure(calls, tmp_path, capsys):
    file, out = written(tmp_path, "wham"), tmp_path / "out"
    words = ["untangle", str(file), "--out", str(out), "--rays", "16", "--frames", "1"]
    assert main([*words, "--like-input"]) == 0
    captured = capsys.readouterr()
    assert "note: not used: verts" in captured.err
    assert "note: wham_untangled.pkl keeps what followed from the poses before: verts" in (
        captured.err
    )
    assert "poses.npz, wham_untangled.pkl, report.json" in captured.out
    before, after = open_poses(file), open_poses(out / "wham_untangled.pkl")
    assert after.structure == before.structure
    (old,), (new,) = before.tracks, after.tracks
    np.testing.assert_array_equal(new.pose[[0, 2]], old.pose[[0, 2]])
    # The stand-in unbends what the body has; SMPL's hands it does not have.
    np.testing.assert_allclose(
        as_matrix(new.pose[1, :22]), as_matrix(0.05 * old.pose[1, :22]), atol=1e-6
    )
    np.testing.assert_array_equal(new.pose[1, 22:], old.pose[1, 22:])
    np.testing.assert_array_equal(new.translation, old.translation)


def test_people_are_chosen_and_written_one_by_one(calls, tmp_path):
    file, out = written(tmp_path, "phalp"), tmp_path / "out"
    assert run(file, out, "--frames", "0,3", "--like-input") == 0
    assert files_in(out) == [
        "phalp_untangled.pkl",
        "poses_1.npz",
        "poses_4.npz",
        "report.json",
    ]
    assert [len(load_poses(out / f"poses_{name}.npz")[0].pose) for name in "14"] == [1, 1]
    both, old = load_poses(out / "phalp_untangled.pkl"), load_poses(file)
    for new, was in zip(both, old, strict=True):
        assert (new.pose[0] != was.pose[0]).any() and (new.pose[1:] == was.pose[1:]).all()
    assert run(file, tmp_path / "one", "--people", "4", "--frames", "0") == 0
    assert files_in(tmp_path / "one") == ["poses_4.npz", "report.json"]
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.pkl", made.joblib({"what": np.zeros(3)}), "in a structure that is known"),
        ("x.pt", b"\x00", "begins like none of them"),
        ("x.c3d", b"\x02P", "begins like none of them"),
        ("x.json", b"[]", "in a structure that is known"),
        ("x", b"hello", "begins like none of them"),
    ],
)
def test_an_unknown_pose_file_hears_nothing_of_meshes(name, content, message, tmp_path, capsys):
    (tmp_path / name).write_bytes(content)
    assert run(tmp_path / name, tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert message in error and name in error and "mesh" not in error
    with pytest.raises(ValueError, match=message):
        files.open_file(tmp_path / name)


def test_the_options_of_pose_files_are_refused_for_a_mesh(tmp_path, capsys):
    for words in (["--people", "1"], ["--like-input"], ["--keep-contact"]):
        assert run(tmp_path / "a.obj", tmp_path / "out", *words) == 2
        assert "is for pose files: got it with a mesh" in capsys.readouterr().err


def test_the_view_shows_each_person(tmp_path):
    opened = files.open_file(written(tmp_path, "bev_video"))
    assert isinstance(opened, MotionFile)
    motions, notes = files.motions_of(opened, "video.npz", load_body(), embedded=True)
    assert list(motions) == ["video.npz: 3", "video.npz: 8"]
    assert motions["video.npz: 3"].pose.shape == (3, 52, 3)
    assert len(notes) == len(set(notes)) and any("BEV's eleventh" in note for note in notes)


def test_an_uploaded_pose_file_is_called_after_its_own_name(tmp_path):
    content = written(tmp_path, "threedpw").read_bytes()
    opened = files.open_upload("court.pkl", content)
    assert isinstance(opened, MotionFile)
    assert [track.names[0] for track in opened.tracks] == ["court/0/0000", "court/1/0000"]


def test_a_pickled_body_model_is_still_a_body(tmp_path, rng):
    import pickle

    from helpers_body import synthetic_smpl

    model = synthetic_smpl(rng, joints=24)
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(model, protocol=2))
    opened = files.open_file(tmp_path / "model.pkl")
    assert isinstance(opened, Scene) and opened.body is not None


def test_hand_components_drive_the_fingers_of_a_body_that_has_some(calls, tmp_path, capsys, rng):
    smpl = synthetic_smpl(rng, 55, 30, 20) | synthetic_hand(rng, ("l", "r"))
    smpl["hands_componentsl"] = smpl["hands_componentsl"][:6]  # fewer than the file has
    np.savez(tmp_path / "model.npz", **smpl)
    file = written(tmp_path, "smplifyx")
    words = ["untangle", str(file), "--out", str(tmp_path / "out"), "--rays", "16"]
    assert main([*words, "--body", str(tmp_path / "model.npz"), "--like-input"]) == 0
    fingers = np.asarray(calls[0]["pose"])[25:]
    want = smpl["hands_meanr"] + smpl["hands_componentsr"][:12].sum(axis=0)
    np.testing.assert_allclose(fingers[15:].ravel(), want, rtol=1e-5, atol=1e-6)
    assert not fingers[:15].any()
    said = " ".join(capsys.readouterr().err.split())
    assert "the body has 6 components of the left hand, the file 12" in said
    assert "keeps the components of the right hand as they were" in said
    # Ten of the file's components are expressions, and follow the shape.
    face = load_poses(file)[0].expression
    assert face is not None and face.any()
    np.testing.assert_allclose(calls[0]["shape"][10:], face[0], rtol=1e-6)
    (again,) = load_poses(tmp_path / "out" / "poses.npz")
    assert again.shape is not None and again.expression is not None
    np.testing.assert_allclose(again.expression, face, rtol=1e-6)
    np.testing.assert_array_equal(again.shape[0], calls[0]["shape"][:10])
    body = load_body(tmp_path / "model.npz")
    one = body(calls[0]["pose"], again.shape[0], expression=again.expression[0]).vertices
    both = expression_as_shape(body)(calls[0]["pose"], calls[0]["shape"]).vertices
    np.testing.assert_allclose(one, both, atol=1e-5)


def test_expressions_that_the_body_lacks_are_named(calls, tmp_path, capsys):
    file = written(tmp_path, "smplifyx")
    assert main(["untangle", str(file), "--out", str(tmp_path / "out"), "--rays", "16"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "the body has no expressions: those of the file are left out" in said
