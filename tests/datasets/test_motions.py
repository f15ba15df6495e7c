"""Folders of motions: cleaned, measured, summed up, and read by others."""

import csv
import json
import re

import jax
import numpy as np
import pytest
from helpers_motion import snap, tongs
from helpers_penalty import compiled_names

from spt_jax import datasets, load_body
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.cli.main import main
from spt_jax.datasets.motion_tasks import CleanMotions, MeasureMotions
from spt_jax.io import load_poses
from spt_jax.metrics import motion_overlap
from spt_jax.untangle.motion_input import up_of

LAYOUT = SMPL_LAYOUTS[22]


def as_smpl(motion):
    """A motion of the tongs as one of SMPL's body: the arms are joints of that name."""
    pose = np.zeros((len(motion), 22, 3))
    for row, name in enumerate(tongs().joint_names[1:], start=1):
        pose[:, LAYOUT.index(name)] = motion[:, row]
    pose[:, 15] = 0.3  # of the head, which the tongs do not have
    return pose


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A motion that collides, two people of whom one does, a calm one, and what is no motion."""
    folder = tmp_path_factory.mktemp("motions")
    pose = as_smpl(snap())
    calm = as_smpl(0.1 * snap())
    (folder / "a").mkdir()
    np.savez(
        folder / "a" / "snap.npz",
        poses=pose.reshape(41, -1),
        trans=np.zeros((41, 3)),
        mocap_framerate=30.0,
        gender="female",
        extra=np.arange(3),
    )
    two = np.stack([pose, calm])
    np.savez(
        folder / "two.npz",
        root_orient=two[:, :, 0],
        pose_body=two[:, :, 1:].reshape(2, 41, 63),
        trans=np.zeros((2, 41, 3)),
        betas=np.zeros((2, 16)),
    )
    np.save(folder / "calm.npy", calm)
    np.savez(folder / "mesh.npz", vertices=np.zeros((4, 3)))
    (folder / "cut.npz").write_bytes((folder / "two.npz").read_bytes()[:300])
    (folder / "LICENSE.txt").write_text("mine")
    return folder


@pytest.fixture
def with_tongs(monkeypatch):
    monkeypatch.setattr("spt_jax.body.load_body", lambda *_, **__: tongs())


@pytest.fixture(scope="module")
def cleaned(folder, tmp_path_factory):
    """What `spt-jax clean` writes, its words, and its exit code."""
    out = tmp_path_factory.mktemp("cleaned") / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("spt_jax.body.load_body", lambda *_, **__: tongs())
        code = main(
            ["clean", str(folder), "--out", str(out), "--processes", "0", "--pictures", "0"]
        )
    return out, code


def frames_that_collide(path):
    body = tongs()
    found = {}
    for track in load_poses(path):
        pose = np.asarray(body.pose_from_smpl(track.pose.astype(np.float32)))
        overlap = motion_overlap(
            np.asarray(body(pose).vertices), body.faces, rest_surface=body.rest_surface
        )
        found[track.name] = int((~overlap.is_free).sum())
    return found


@pytest.mark.long
def test_every_motion_is_free_in_its_own_structure(folder, cleaned):
    out, code = cleaned
    assert code == 1  # a file is cut
    assert frames_that_collide(folder / "a" / "snap.npz")["snap"] > 3
    assert frames_that_collide(out / "a" / "snap.npz") == {"snap": 0}
    assert frames_that_collide(out / "two.npz") == {"0": 0, "1": 0}
    with np.load(out / "a" / "snap.npz") as found, np.load(folder / "a" / "snap.npz") as given:
        assert found.files == given.files
        assert all(np.array_equal(found[k], given[k]) for k in given.files if k != "poses")
        # Joints that the body does not have stand as they did.
        head = slice(45, 48)
        np.testing.assert_array_equal(found["poses"][:, head], given["poses"][:, head])
    np.testing.assert_array_equal(np.load(out / "calm.npy"), np.load(folder / "calm.npy"))


@pytest.mark.long
def test_the_manifest_says_what_happened(folder, cleaned):
    out, _ = cleaned
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    by_name = {row["name"]: row for row in rows}
    status = {name: row["status"] for name, row in by_name.items()}
    assert status == {
        "a/snap.npz": "done",
        "calm.npy": "done",
        "cut.npz": "failed",
        "mesh.npz": "unknown",
        "two.npz": "done",
    }
    one, two = by_name["a/snap.npz"], by_name["two.npz"]
    before = frames_that_collide(folder / "a" / "snap.npz")["snap"]
    assert one["colliding_frames_before"] == before and one["colliding_frames_after"] == 0
    assert (
        41 - before <= one["frames_by_depth_before"][0] < 41
    )  # some collide with no vertex inside
    assert one["frames_by_volume_before"][0] == 41 - before
    assert sum(one["frames_by_volume_before"]) == sum(one["frames_by_depth_after"]) == 41
    assert two["frames"] == 82 and [p["person"] for p in two["people"]] == ["0", "1"]
    assert two["people"][1]["moved_frames"] == 0 == two["people"][1]["largest_displacement"]
    assert one["largest_displacement"] > one["mean_displacement"] > 0
    assert one["frame_rate"] == 30.0 and two["frame_rate"] is None
    summary = json.loads((out / "summary.json").read_text())
    assert summary["others"] == {".txt": 1} and summary["figures"]["frames"] == 164
    assert summary["figures"]["largest_depth_before"] == one["largest_depth_before"]
    with open(out / "people.csv", newline="") as stream:
        people = list(csv.DictReader(stream))
    assert [(p["name"], p["person"]) for p in people][-2:] == [("two.npz", "0"), ("two.npz", "1")]
    with open(out / "manifest.csv", newline="") as stream:
        assert len(list(csv.reader(stream))) == 6


@pytest.fixture(scope="module")
def measured(folder, tmp_path_factory):
    """What `spt-jax measure` writes."""
    out = tmp_path_factory.mktemp("measured") / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("spt_jax.body.load_body", lambda *_, **__: tongs())
        words = ["--out", str(out), "--processes", "0", "--pictures", "0"]
        assert main(["measure", str(folder), *words]) == 1  # a file is cut
    return out


def test_pandas_and_duckdb_read_the_rows_as_they_are(measured):
    pandas, duckdb = pytest.importorskip("pandas"), pytest.importorskip("duckdb")
    frame = pandas.read_json(measured / "manifest.jsonl", lines=True)
    assert frame.set_index("name").loc["two.npz", "frames"] == 82
    assert pandas.read_csv(measured / "manifest.csv").frames.sum() == 164
    query = "select sum(frames) from '{}' where status = 'done'"
    for name in ("manifest.jsonl", "manifest.csv"):
        assert duckdb.sql(query.format(measured / name)).fetchall() == [(164,)]


def test_the_report_of_a_measured_folder(measured):
    page = (measured / "report.html").read_text()
    for words in (
        *("The worst 2", "a/snap.npz", "By folder", "By person", "two.npz: 0", "cut.npz"),
        *("not used: extra", "1 file of another kind", "mesh.npz", "heights are logarithms"),
    ):
        assert words in page, words
    assert page.count("<rect") == 2 * 9 and "after" not in page.split("</style>")[1]


@pytest.mark.long
def test_the_report_opens_without_anything_else(cleaned):
    out, _ = cleaned
    page = (out / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and "<script" not in page
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page)
    for words in ("The worst 2", "a/snap.npz", "By folder", "By person", "two.npz: 0", "cut.npz"):
        assert words in page, words
    assert "No pictures: no pictures were asked for" in page
    # Each figure is drawn: as many bars as there are bins, before and after, and two keys each.
    assert page.count("<rect") == 2 * (2 * 9 + 2)


def test_measuring_changes_nothing_and_counts_what_collides(folder, measured):
    before = {name: path.read_bytes() for name, path in files_in(folder).items()}
    assert set(before) == {
        *("a/snap.npz", "calm.npy", "two.npz", "mesh.npz", "cut.npz", "LICENSE.txt")
    }
    assert not set(before) & set(files_in(measured))
    rows = [json.loads(line) for line in (measured / "manifest.jsonl").read_text().splitlines()]
    for row in rows:
        if row["status"] == "done":
            found = {one["person"]: one["colliding_frames"] for one in row["people"]}
            assert found == frames_that_collide(folder / row["name"])
            assert row["outputs"] == [] and "colliding_frames_after" not in row


def files_in(folder):
    """The files of a folder by name, but for what a run keeps for itself."""
    return {
        path.relative_to(folder).as_posix(): path
        for path in folder.rglob("*")
        if path.is_file() and ".spt-jax" not in path.parts
    }


@pytest.mark.long
@pytest.mark.usefixtures("with_tongs")
def test_measured_again_nothing_collides(cleaned, measured, tmp_path, capsys):
    words = ["--processes", "0", "--pictures", "0", "--json"]
    # Files of the run itself are not looked at.
    assert main(["measure", str(cleaned[0]), "--out", str(tmp_path), *words]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["by_status"] == {"done": 3} and summary["figures"]["colliding_frames"] == 0
    before = json.loads((measured / "summary.json").read_text())["figures"]
    figures = json.loads((cleaned[0] / "summary.json").read_text())["figures"]
    for name in ("colliding_frames", "largest_depth", "mean_volume", "rejected"):
        np.testing.assert_allclose(before[name], figures[f"{name}_before"], rtol=1e-5)


@pytest.mark.long
@pytest.mark.usefixtures("with_tongs")
def test_in_amass_layout_each_person_has_a_file(folder, tmp_path):
    datasets.clean(folder, tmp_path, structure="amass", processes=0, pictures=0)
    assert {p.name for p in tmp_path.rglob("*.np?")} == {
        "snap.npz",
        "calm.npy.npz",
        "two_0.npz",
        "two_1.npz",
    }
    (track,) = load_poses(tmp_path / "a" / "snap.npz")
    assert track.gender == "female" and track.frame_rate == 30.0
    assert frames_that_collide(tmp_path / "two_0.npz") == {"two_0": 0}


def test_faults_of_the_caller(folder, tmp_path, capsys):
    for error, said, options in (
        (ValueError, "structure must be", {"structure": "bvh"}),
        (ValueError, "frame_rate must be finite and positive", {"frame_rate": 0.0}),
        (TypeError, "margin must be a number", {"margin": "wide"}),
        (FileNotFoundError, "body model must exist", {"body": str(tmp_path / "none.npz")}),
    ):
        with pytest.raises(error, match=said):
            datasets.clean(folder, tmp_path / "out", processes=0, **options)
    assert main(["clean", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("spt-jax: folder must exist: got ")
    assert not list(tmp_path.iterdir())


def compiled_after_the_first(task, tmp_path):
    """What is compiled for files of other lengths, after one of 41 frames.

    Without what JAX compiles to copy, fill and cast an array, a few milliseconds each.
    """
    task.start()
    pose = as_smpl(snap())
    for number, rows in enumerate((slice(None), slice(5, 28), slice(20, 21), slice(8, 36))):
        np.save(tmp_path / f"{number}.npy", pose[rows])
    out = tmp_path / "out"
    out.mkdir()
    with compiled_names() as said:
        jax.jit(lambda x: 2 * x)(1.0)
    assert said  # the count counts
    said = []
    for number in range(4):
        with compiled_names() as names:
            row = task.work(tmp_path / f"{number}.npy", out, lambda *_: None)
        said.append(names)
        assert row["frames"] == (41, 23, 1, 28)[number]
    small = ("stage", "broadcast_in_dim", "reshape", "_where", "convert_element_type")
    found = [name for names in said[1:] for name in names]
    return [name for name in found if not any(f"jit({op})" in name for op in small)]


@pytest.mark.usefixtures("with_tongs")
def test_measuring_compiles_once_for_files_of_all_lengths(tmp_path):
    assert not compiled_after_the_first(MeasureMotions(), tmp_path)


@pytest.mark.long
@pytest.mark.usefixtures("with_tongs")
def test_cleaning_compiles_once_for_files_of_all_lengths(tmp_path):
    assert not compiled_after_the_first(CleanMotions(), tmp_path)


def test_which_way_is_up():
    body = load_body()
    turn = np.zeros((5, *body.pose_shape), np.float32)
    assert up_of(body, turn) == (0.0, 1.0, 0.0)
    turn[:, 0, 0] = np.pi / 2 + 0.2  # as AMASS has it, leaning
    assert up_of(body, turn) == (0.0, 0.0, 1.0)
    turn[:, 0, 0] = np.pi
    assert up_of(body, turn) == (0.0, -1.0, 0.0)


def test_a_task_travels_to_another_process_without_its_body():
    import pickle

    task = CleanMotions(fade=0.1)
    assert pickle.loads(pickle.dumps(task)) == task
    assert task.settings()["fade"] == 0.1 and task.settings()["body"] == "anny"
