"""Runs that were ended go on where they were, and end with the same bytes."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from helpers_body import synthetic_smpl

from spt_jax import RESULTS
from spt_jax.cli import fitted
from spt_jax.cli.kept import frame_arrays, frame_of
from spt_jax.cli.main import main
from spt_jax.cli.unfinished import UnfinishedRun, digest, manifest_of
from spt_jax.fit.result import FitResult
from spt_jax.overlap.caps import Hole

NAMES = ["walk/0005", "punch/0013"]


def unbend(body, pose, *, shape=None, translation=None, share=0.5, **_):
    """In place of `untangle_pose`."""
    pose = np.float32(share) * pose
    vertices = body(pose, shape, translation).vertices
    return SimpleNamespace(
        pose=pose, vertices=vertices, steps=7, is_free=np.bool_(True), reason="collision-free"
    )


def stand(body, keypoints, camera, *, confidence, **_):
    """In place of `fit_pose`: bodies at rest, 4 m away, whose shape tells the person."""
    where, flip = jnp.array([0.0, 0.0, 4.0]), jnp.array([1.0, -1.0, -1.0])
    return FitResult(
        pose=jnp.zeros((body.num_joints, 3)).at[0, 0].set(jnp.pi),
        shape=jnp.full(body.num_shape, jnp.mean(keypoints) / 1000),
        translation=where,
        vertices=body.template * flip[None] + where[None],
        joints=body.joint_template * flip[None] + where[None],
        keypoints=jnp.asarray(keypoints) + 1 / 3,
        steps=jnp.array(7),
        terms={"total": jnp.sum(confidence) / 3},
        status=RESULTS.successful,
    )


class Counted:
    """A function that ends the run at a call: by Ctrl-C, or as a fault of ours."""

    def __init__(self, function, end=None, error=KeyboardInterrupt):
        self.function, self.end, self.error, self.calls = function, end, error, 0

    def __call__(self, *args, **options):
        if self.calls == self.end:
            raise self.error
        self.calls += 1
        return self.function(*args, **options)


def inputs(folder):
    """A small body, two poses and the keypoints of two people: the words for the two commands."""
    rng = np.random.default_rng(0)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.uint32)  # quick to measure
    np.savez(folder / "body.npz", **synthetic_smpl(rng, joints=24) | {"f": faces})
    np.savez(folder / "poses.npz", poses=0.1 * rng.normal(size=(2, 72)), name=np.array(NAMES))
    points = np.concatenate([rng.uniform(50, 400, (2, 24, 2)), np.full((2, 24, 1), 0.5)], axis=2)
    np.savez(folder / "points.npz", keypoints=points, layout="smpl24")
    body = ["--body", str(folder / "body.npz")]
    return {
        "untangle": ["untangle", str(folder / "poses.npz"), *body, "--meshes"],
        "fit": ["fit", str(folder / "points.npz"), *body, "--focal", "700"],
    }


@pytest.fixture
def command(tmp_path, monkeypatch, request):
    """Run `untangle` of two frames or `fit` of two people into a folder; the work's calls."""
    monkeypatch.setattr(fitted, "draw", lambda *_: ([], "no time"))
    words = inputs(tmp_path)[request.param]

    def run(out, *more, **ended):
        counted = Counted({"untangle": unbend, "fit": stand}[request.param], **ended)
        for place in ("spt_jax.untangle.pose.untangle_pose", "spt_jax.fit.pose.fit_pose"):
            monkeypatch.setattr(place, counted)
        return main([*words, "--out", str(out), *more]), counted.calls

    return run


def without_times(value):
    if isinstance(value, dict):
        return {name: without_times(v) for name, v in value.items() if name != "seconds"}
    return list(map(without_times, value)) if isinstance(value, list) else value


def contents(folder: Path):
    """The bytes of every file, and of a report what is no time."""
    found = {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    if "report.json" in found:
        found["report.json"] = without_times(json.loads(found["report.json"]))
    return found


BOTH = pytest.mark.parametrize("command", ["untangle", "fit"], indirect=True)


@BOTH
def test_a_run_that_was_ended_goes_on_and_ends_with_the_same_bytes(command, tmp_path, capsys):
    whole, ended = tmp_path / "whole", tmp_path / "ended"
    assert command(whole) == (0, 2)
    assert "unfinished" not in capsys.readouterr().err
    assert command(ended, end=1) == (130, 1)
    said = capsys.readouterr().err
    assert f"1 done and kept in {ended / 'unfinished'}; the same command goes on there" in said
    assert {path.name for path in ended.iterdir()} == {"unfinished"}
    manifest = json.loads((ended / "unfinished" / "manifest.json").read_text())
    assert len(manifest["items"]) == 2 and manifest["settings"]
    # Temporary files of a process that was killed while it wrote.
    for left in (ended / ".poses.0123456789ab.npz", ended / "unfinished" / ".2.0123456789ab.npz"):
        left.write_bytes(b"half")
    assert command(ended) == (0, 1)
    assert "1 done before, kept in " in capsys.readouterr().err
    assert contents(ended) == contents(whole) and len(contents(whole)) > 3
    assert not (ended / "unfinished").exists()


@BOTH
def test_other_settings_inputs_and_damage(command, tmp_path, capsys):
    whole, out = tmp_path / "whole", tmp_path / "out"
    command(whole)
    assert command(out, end=1) == (130, 1)
    kept = contents(out)
    capsys.readouterr()
    assert command(out, "--fold-distance", "0.1") == (2, 0)
    said = capsys.readouterr().err
    assert "settings fold_distance is None and not 0.1; finish that run with its" in said
    assert said.startswith("spt-jax: out must not hold another run") and said.count("\n") == 1
    part = out / "unfinished" / "000000.npz"
    assert contents(out) == kept
    part.write_bytes(part.read_bytes()[:-200])
    assert command(out, end=1) == (130, 1)  # the first again
    assert f"{part} is damaged; what it held is made again" in capsys.readouterr().err
    assert command(out, "--anew", "--quiet") == (0, 2)
    assert contents(out) == contents(whole)
    assert command(out, "--quiet", end=0) == (130, 0)
    assert not (out / "unfinished").exists()  # nothing was done


def test_an_input_that_changed_is_named(tmp_path):
    body = embedded_body()
    made = [("a", [np.zeros(3), None, "x", (4, 5)]), ("b", [np.ones(3)])]
    manifest = manifest_of("fit", {"rays": None}, body, made)
    say = []
    with UnfinishedRun(tmp_path, manifest, say=say.append) as run:
        run.keep(0, {"x": np.arange(3)})
        assert len(run) == 1 and run.found(1) is None
        np.testing.assert_array_equal(run.found(0)["x"], np.arange(3))
    with UnfinishedRun(tmp_path, manifest, say=say.append) as run:
        assert len(run) == 1 and "1 done before" in say[-1]

    def refused(changed, message):
        with pytest.raises(ValueError, match=message):
            UnfinishedRun(tmp_path, changed, say=say.append)

    moved = [made[0], ("b", [np.nextafter(np.ones(3), 2)])]
    refused(manifest_of("fit", {"rays": None}, body, moved), "items 1 made from is '")
    refused(manifest_of("fit", {"rays": None}, body, made[:1]), "there are 2 items and not 1")
    refused(manifest_of("fit", {"rays": 64}, body, made), "settings rays is None and not 64")
    refused(manifest_of("fit", {}, body, made), "settings rays is None and not missing")
    refused(manifest_of("untangle", {"rays": None}, body, made), "command is 'fit' and not 'unt")
    refused(manifest | {"versions": {}}, "versions python is .* and not missing")
    other = jax.tree.map(lambda leaf: leaf + 1, body)
    refused(manifest_of("fit", {"rays": None}, other, made), "body is '.*' and not '")
    (tmp_path / "unfinished" / "manifest.json").write_text("{")
    refused(manifest, "manifest must be JSON: got .*manifest.json")
    (tmp_path / "unfinished" / "manifest.json").unlink()
    refused(manifest, "numbered files of another kind: got .* without manifest.json")


def test_two_runs_do_not_share_a_folder(tmp_path):
    pytest.importorskip("fcntl")
    refused = pytest.raises(ValueError, match="must not be worked on by another run: got ")
    with UnfinishedRun(tmp_path, {"a": 1}, say=print), refused:
        UnfinishedRun(tmp_path, {"a": 1}, say=print)
    assert not (tmp_path / "unfinished").exists()


def test_digests_tell_dtypes_shapes_and_values_apart():
    given = [
        np.zeros(4),
        np.zeros((2, 2)),
        np.zeros(4, np.float32),
        np.zeros(4, np.int64),
        "",
        None,
    ]
    given += [0, 0.0, (), np.array([0, 0, 0, -0.0])]
    assert len({digest([one]) for one in given}) == len(given)
    assert digest([np.zeros((2, 3)).T]) == digest([np.zeros((3, 2))])


def test_a_frame_comes_back_to_the_bit(rng):
    report = {"volume": np.float64(1 / 3), "total_volume": 0.1 + 0.2, "solid_volume": 1e-300}
    report |= {
        "directions": ((1.0, 0.0, 0.0),),
        "volumes": (1 / 7,),
        "intersecting_pairs": 1,
        "total_intersecting_pairs": 2,
    }
    report |= {"crossings": (), "exact": True, "holes": (Hole(9, 0.3, 0.1, 0),), "rays": (3, 4)}
    from spt_jax._report import IntersectionReport
    from spt_jax.cli.frames import Frame

    labels = np.array([0, 1, -1], np.int8)
    arrays = {"pose": rng.normal(size=(52, 3)).astype(np.float32)}
    arrays |= {name: rng.normal(size=(3, 3)) for name in ("vertices_before", "vertices_after")}
    facts = {
        "name": "ä/1",
        "steps": 3,
        "seconds": 1 / 3,
        "is_free": True,
        "reason": "collision-free",
    }
    told = IntersectionReport(labels=labels, **report)
    frame = Frame(before=told, after=told, **arrays, **facts)
    for vertices in (True, False):
        back = frame_of(frame_arrays(frame, vertices=vertices))
        for name, value in (arrays if vertices else {"pose": arrays["pose"]}).items():
            assert getattr(back, name).dtype == value.dtype
            np.testing.assert_array_equal(getattr(back, name), value)
        assert {name: getattr(back, name) for name in facts} == facts
        assert back.before.as_dict() == told.as_dict() and back.after.rays == (3, 4)
        np.testing.assert_array_equal(back.after.labels, labels)
    assert len(back.vertices_after) == 0


_KILLED = """
import os, signal
from spt_jax import RESULTS
from spt_jax.cli.main import main
from spt_jax.untangle import pose

class Result:
    calls, steps, is_free, reason = 0, 7, True, "collision-free"

    def __init__(self, body, given, **_):
        if Result.calls:
            os.kill(os.getpid(), signal.SIGKILL)
        Result.calls += 1
        self.pose, self.vertices = given, body(given).vertices

pose.untangle_pose = Result
main({words!r})
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="a process is killed")
def test_a_killed_process_leaves_what_was_done(tmp_path, monkeypatch):
    words = [*inputs(tmp_path)["untangle"], "--quiet", "--out"]
    out, whole = str(tmp_path / "out"), str(tmp_path / "whole")
    code = _KILLED.format(words=[*words, out])
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert os.listdir(out) == ["unfinished"]
    counted = Counted(lambda body, pose, **_: unbend(body, pose, share=1.0))
    monkeypatch.setattr("spt_jax.untangle.pose.untangle_pose", counted)
    for folder, calls in ((out, 1), (whole, 3)):
        assert main([*words, folder]) == 0
        assert counted.calls == calls
    assert contents(Path(out)) == contents(Path(whole))


def test_a_full_disk_is_named_and_leaves_nothing_half_written(tmp_path):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with UnfinishedRun(tmp_path, {}, say=print) as run:
        run.keep(0, {"x": np.zeros(3)})
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
        try:
            with pytest.raises(OSError, match=r"out must have room for '.*000001\.npz': got File"):
                run.keep(1, {"x": np.zeros(10_000)})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        names = {path.name for path in run.folder.iterdir()} - {"lock"}
        assert names == {"000000.npz", "manifest.json"}
