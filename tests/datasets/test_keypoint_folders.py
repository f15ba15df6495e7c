"""`spt-jax fit FOLDER`: rows, exit codes, what an end leaves, and parts of a folder."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_motion import tongs

from spt_jax import RESULTS
from spt_jax.cli.main import main
from spt_jax.fit.result import FitResult
from spt_jax.io import load_poses


@pytest.fixture
def fitted(monkeypatch):
    """The keypoints that a stand-in for fit_pose was given; its poses tell people apart."""
    given = []

    def stand_in(body, keypoints, camera, **_):
        given.append(np.asarray(keypoints))
        pose = jnp.zeros(body.pose_shape).at[0, 0].set(float(keypoints[0, 0]) / 1000)
        return FitResult(
            pose=pose,
            shape=jnp.zeros(body.num_shape),
            translation=jnp.array([0.0, 0.0, 4.0]),
            vertices=body(jnp.zeros(body.pose_shape)).vertices,
            joints=jnp.zeros(body.pose_shape),
            keypoints=keypoints + jnp.array([[3.0, 0.0]]),
            steps=jnp.array(7),
            terms={"total": jnp.array(1.0)},
            status=RESULTS.successful,
        )

    monkeypatch.setattr("spt_jax.fit.fit_pose", stand_in)
    return given


def openpose(path, firsts):
    """People of OpenPose's 25 keypoints, the first of which begins at some x."""
    path.parent.mkdir(parents=True, exist_ok=True)
    people = []
    for first in firsts:
        rows = np.stack([first + np.arange(25.0), 200 + 3 * np.arange(25.0), np.ones(25)], axis=1)
        people.append({"pose_keypoints_2d": rows.ravel().tolist()})
    path.write_text(json.dumps({"version": 1.3, "people": people}))


@pytest.fixture
def folder(tmp_path):
    """Two files of one name, three people in all, and a file with nobody."""
    folder = tmp_path / "in"
    openpose(folder / "a" / "same.json", [100, 120])
    openpose(folder / "b" / "same.json", [140])
    openpose(folder / "nobody.json", [])
    return folder


def run(folder, out, *words):
    return main(["fit", str(folder), "--out", str(out), "--processes", "0", "--quiet", *words])


def rows_in(out):
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    return {row["name"]: row for row in rows}


def results_in(out):
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*.npz"))}


def test_files_of_one_name_in_two_folders_stay_apart(folder, fitted, tmp_path):
    out = tmp_path / "out"
    assert run(folder, out) == 0
    rows = rows_in(out)
    assert {name: (row["status"], row["people_count"]) for name, row in rows.items()} == {
        "a/same.json": ("done", 2),
        "b/same.json": ("done", 1),
        "nobody.json": ("done", 0),
    }
    assert results_in(out).keys() == {"a/same.json.npz", "b/same.json.npz"}
    for name, turns in (("a", [0.1, 0.12]), ("b", [0.14])):
        [track] = load_poses(out / name / "same.json.npz")
        np.testing.assert_allclose(track.pose[:, 0, 0], turns, rtol=1e-6)
    assert rows["a/same.json"]["people"][0]["mean_pixels_off"] == pytest.approx(3, abs=1e-4)


def test_what_was_done_before_an_end_is_kept_to_the_bit(folder, fitted, tmp_path, monkeypatch):
    from spt_jax import fit

    out, stand_in = tmp_path / "out", fit.fit_pose

    def ended(body, keypoints, *rest, **options):
        if keypoints[0, 0] == 140:
            raise KeyboardInterrupt
        return stand_in(body, keypoints, *rest, **options)

    with monkeypatch.context() as patched:
        patched.setattr("spt_jax.fit.fit_pose", ended)
        assert run(folder, out) == 130
    before = results_in(out)
    assert before.keys() == {"a/same.json.npz"}
    fitted.clear()
    assert run(folder, out) == 0
    assert [points[0, 0] for points in fitted] == [140]
    after = results_in(out)
    assert after["a/same.json.npz"] == before["a/same.json.npz"] and len(after) == 2
    fitted.clear()
    assert run(folder, out) == 0 and not fitted and results_in(out) == after


def test_a_bad_file_has_a_row_that_names_it_and_its_field(folder, fitted, tmp_path):
    good = (folder / "b" / "same.json").read_text()
    (folder / "cut.json").write_text(good[:60])
    short = json.loads(good)
    short["people"][0]["pose_keypoints_2d"].pop()
    (folder / "short.json").write_text(json.dumps(short))
    np.savez(folder / "motion.npz", poses=np.zeros((4, 66)), trans=np.zeros((4, 3)))
    out = tmp_path / "out"
    assert run(folder, out) == 1
    rows = rows_in(out)
    status = {name: row["status"] for name, row in rows.items() if row["status"] != "done"}
    assert status == {"cut.json": "failed", "short.json": "failed", "motion.npz": "unknown"}
    assert "cut.json" in rows["cut.json"]["message"]
    for said in ("pose_keypoints_2d of person 0 in", "short.json", "got 74 numbers"):
        assert said in rows["short.json"]["message"]
    assert "spt-jax clean takes" in rows["motion.npz"]["message"]
    assert results_in(out).keys() == {"a/same.json.npz", "b/same.json.npz"}


def test_shards_do_the_whole_between_them(folder, fitted, tmp_path):
    out = tmp_path / "out"
    for number in range(6):
        openpose(folder / f"{number}.json", [150 + number])
    assert run(folder, out, "--shard", "0/2") == 0
    first = results_in(out)
    assert 0 < len(fitted) < 9
    assert run(folder, out, "--shard", "1/2") == 0
    assert len(fitted) == 9 == len({points[0, 0] for points in fitted})  # nobody twice
    assert len(rows_in(out)) == 9 and first.items() < results_in(out).items()
    whole = tmp_path / "whole"
    assert run(folder, whole) == 0 and results_in(whole).keys() == results_in(out).keys()


def test_faults_of_the_caller_end_with_two_and_write_nothing(folder, fitted, tmp_path):
    for words in (("--shard", "2/2"), ("--robust", "-1"), ("--focal", "500")):
        assert run(folder, tmp_path / "out", *words) == 2
    assert run(folder, folder) == 2
    assert not (tmp_path / "out").exists() and not fitted


@pytest.mark.parametrize("one_file", [False, True])
def test_a_body_whose_poses_no_file_holds_is_refused_before_anything_is_fitted(
    folder, fitted, tmp_path, monkeypatch, capsys, one_file
):
    monkeypatch.setattr("spt_jax.body.load_body", lambda *_, **__: tongs())
    out = tmp_path / "out"
    given = folder / "a" / "same.json" if one_file else folder
    words = ["fit", str(given), "--out", str(out), "--quiet"]
    assert main(words if one_file else [*words, "--processes", "0"]) == 2
    assert "body must have 22, 24, 52 or 55 joints, whose poses can be" in capsys.readouterr().err
    assert fitted == [] and results_in(out) == {}
