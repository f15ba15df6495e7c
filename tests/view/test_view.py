"""The live view without a browser: what it shows, the files it takes, the thread it works on."""

import os
import re
import tempfile
import threading
import time

import numpy as np
import pytest
import trimesh
from helpers_body import PARENTS, ball_arrays, slow_rotation

from spt_jax import intersection_report, load_body, untangle_mesh, untangle_pose
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.cli import main as cli
from spt_jax.io.mesh_files import PENETRATING_COLOR, read_mesh, write_mesh
from spt_jax.io.pose_files import MotionFile, Track, read_poses, write_poses
from spt_jax.view import files
from spt_jax.view.freeing import untangle_scene
from spt_jax.view.panel import figures
from spt_jax.view.scene import Scene, body_parts
from spt_jax.view.worker import Worker

_ELBOW = SMPL_LAYOUTS[24].index("left_elbow")


@pytest.fixture(scope="module")
def ball_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "balls.npz"
    np.savez(path, **ball_arrays())
    return path


def scene_of(path) -> Scene:
    scene = files.open_file(path)
    assert isinstance(scene, Scene)
    return scene


@pytest.fixture
def balls(ball_file):
    return scene_of(ball_file)


@pytest.fixture(scope="module")
def pair_file(tmp_path_factory):
    ball = trimesh.creation.icosphere(subdivisions=3)
    pair = trimesh.util.concatenate(ball, ball.copy().apply_translation([1.8, 0.0, 0.0]))
    path = tmp_path_factory.mktemp("mesh") / "pair.ply"
    pair.export(path)
    return path


def bend(scene):
    """Fold the left forearm back, so that the hand comes to lie in the collar's ball."""
    scene.turn(_ELBOW, 1, 178.0)


@pytest.mark.parametrize("joints", [22, 24, 52, 55])
def test_every_joint_is_in_one_part(joints):
    parts = body_parts(SMPL_LAYOUTS[joints])
    assert sorted(sum(parts.values(), ())) == list(range(joints))
    assert max(map(len, parts.values())) <= 16
    assert parts["left leg"] == (1, 4, 7, 10)


def test_handles_stand_as_the_joints_do(balls, rng):
    balls.set_pose(rng.normal(size=(24, 3)))
    world = []
    for row, parent in zip(balls.pose, PARENTS[24], strict=True):
        local = slow_rotation(row.astype(np.float64))
        world.append(local if parent < 0 else world[parent] @ local)
    w, x, y, z = balls.orientations().T
    first_column = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1
    )
    np.testing.assert_allclose(first_column, np.array(world)[:, :, 0], atol=1e-6)


def test_a_handle_turned_is_where_it_was_put(balls, rng):
    balls.set_pose(rng.normal(size=(24, 3)))
    before = balls.pose.copy()
    wanted = rng.normal(size=4)
    wanted /= np.linalg.norm(wanted)
    balls.turn_in_world(_ELBOW, tuple(wanted))
    found = balls.orientations()[_ELBOW]
    np.testing.assert_allclose(abs(found @ wanted), 1.0, atol=1e-6)
    others = np.arange(24) != _ELBOW
    np.testing.assert_array_equal(balls.pose[others], before[others])
    # A handle that is put where it stands turns nothing.
    balls.turn_in_world(_ELBOW, tuple(found))
    np.testing.assert_allclose(abs(balls.orientations()[_ELBOW] @ wanted), 1.0, atol=1e-6)


@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize("count_folds", [False, True])
def test_a_reading_is_the_report(paper, count_folds):
    scene = Scene.of_body(load_body(), "anny")
    motion = files.mocap_for(scene.body)["crawl"]
    motion.load_into(scene, motion.names.index("crawl/0160"))
    scene.paper, scene.count_folds = paper, count_folds
    options = dict(rays=512, directions=1, rule="triangle") if paper else {}
    report = intersection_report(
        scene.vertices,
        scene.faces,
        rest_surface=None if count_folds else scene.body.rest_surface,
        **options,
    )
    reading = scene.read()
    assert reading.volume == report.volume > 0
    assert reading.intersecting_pairs == report.intersecting_pairs
    assert (reading.counts.penetrating, reading.counts.inverted) == (
        report.num_penetrating,
        report.num_inverted,
    )
    np.testing.assert_allclose(reading.counts.ratio, report.ratio)
    np.testing.assert_array_equal(reading.labels, report.labels)


def test_reset_comes_back_to_what_was_loaded(balls):
    frames = files.Frames(["a"], np.full((1, 24, 3), 0.1, np.float32), np.ones((1, 2)))
    frames.load_into(balls, 0)
    loaded = balls.vertices.copy()
    bend(balls)
    balls.set_shape(0, -2.0)
    assert np.abs(balls.vertices - loaded).max() > 0.1
    balls.reset()
    np.testing.assert_array_equal(balls.vertices, loaded)


@pytest.mark.slow
def test_a_pose_comes_free_as_untangle_pose_says_and_every_step_is_shown(balls):
    bend(balls)
    start = balls.pose.copy()
    expected = untangle_pose(balls.body, start, shape=balls.shape, translation=balls.translation)
    shown = []
    untangle_scene(balls, lambda vertices, text: shown.append(vertices), lambda: False)
    assert balls.read().volume == 0 < float(expected.before.volume)
    # The same search in another compiled program: rounding may differ.
    np.testing.assert_allclose(balls.pose, expected.pose, atol=1e-3)
    volumes = [balls.read(vertices).volume for vertices in shown]
    assert len(shown) >= 3 and volumes[-1] < 0.1 * volumes[0]
    assert all(vertices.shape == balls.vertices.shape for vertices in shown)


def test_a_stopped_search_leaves_the_step_last_shown(balls):
    bend(balls)
    start, shown = balls.pose.copy(), []
    untangle_scene(balls, lambda vertices, text: shown.append(vertices), lambda: len(shown) > 2)
    assert np.isfinite(balls.pose).all()
    assert 0 < np.abs(balls.pose - start).max() < 1.0


def test_a_failing_look_is_reported_and_ends_nothing(balls):
    bend(balls)

    def show(vertices, text):
        raise ValueError("the browser is gone")

    with pytest.raises(ValueError, match="browser is gone"):
        untangle_scene(balls, show, lambda: False)
    assert balls.read().volume == 0  # the search itself went on


def test_a_mesh_comes_free_as_untangle_mesh_says(pair_file):
    scene = scene_of(pair_file)
    expected = untangle_mesh(scene.vertices, scene.faces)
    shown = []
    untangle_scene(scene, lambda vertices, text: shown.append(vertices), lambda: False)
    assert expected.is_free and expected.before.volume > 0 == scene.read().volume
    np.testing.assert_array_equal(scene.vertices, expected.vertices)
    assert len(shown) >= 2
    scene.reset()
    assert scene.read().volume > 0


def test_figures_say_what_was_measured(balls, pair_file):
    bend(balls)
    balls.name = "<b>"
    reading = balls.read()
    text = figures(reading, balls, "a & b")
    assert f"{1e6 * reading.volume:.2f} cm³" in text and f">{reading.counts.penetrating}<" in text
    assert "&lt;b&gt;" in text and "a &amp; b" in text and f"rgb{PENETRATING_COLOR}" in text
    mesh = scene_of(pair_file)
    assert "unit³" in figures(mesh.read(), mesh, "")


def test_what_cannot_be_measured_is_said_and_is_not_free(balls, pair_file):
    balls.set_pose(np.full((24, 3), np.nan))
    reading = balls.read()
    assert reading.error.startswith("vertices must be finite") and not reading.is_free
    assert np.isnan(reading.volume) and not reading.labels.any() and reading.intersecting_pairs == 0
    text = figures(reading, balls, reading.error)
    assert "not measured" in text and "vertices must be finite" in text and ">nan" not in text
    with pytest.raises(ValueError, match="pose must be finite"):
        untangle_scene(balls, lambda vertices, text: None, lambda: False)
    mesh = scene_of(pair_file)
    mesh.set_free_vertices(mesh.vertices * np.nan)
    with pytest.raises(ValueError, match="vertices must be finite"):
        untangle_scene(mesh, lambda vertices, text: None, lambda: False)


def test_a_mesh_far_from_the_origin_is_not_rounded(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.concatenate([ball.vertices, np.add(ball.vertices, [1.8, 0.0, 0.0])])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    offset = np.array([4e6, -3e5, 123.0])
    write_mesh(tmp_path / "far.ply", vertices + offset, faces)
    scene = scene_of(tmp_path / "far.ply")
    near = intersection_report(vertices, faces)
    assert scene.read().volume == pytest.approx(near.volume, rel=1e-6)
    untangle_scene(scene, lambda vertices, text: None, lambda: False)
    assert scene.read().is_free and scene.vertices.dtype == np.float64
    assert np.abs(scene.vertices - offset - vertices).max() < 0.2


def test_files_are_told_apart(balls, ball_file, pair_file, tmp_path):
    assert balls.body.num_joints == 24 and balls.name == "balls"
    assert scene_of(pair_file).body is None
    write_poses(tmp_path / "poses.npz", np.zeros((2, 22, 3)))
    assert isinstance(files.open_file(tmp_path / "poses.npz"), MotionFile)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-1],
        lambda content: content[: len(content) // 2],
        lambda content: b"PK\5\6" + b"\xff" * 18,
        lambda content: content.replace(b"PK\1\2", b"PK\1\3"),
        lambda content: content.replace(b"v_template.npy", b"v_templatE.npy"),
    ],
    ids=["last byte", "half", "end alone", "directory", "name"],
)
def test_a_damaged_archive_is_refused_by_name(ball_file, damage, tmp_path):
    (tmp_path / "damaged.npz").write_bytes(damage(ball_file.read_bytes()))
    with pytest.raises(ValueError, match=r"damaged\.npz"):
        files.open_file(tmp_path / "damaged.npz")


@pytest.mark.parametrize("name", ["pipe.npz", "pipe.ply", "pipe.pkl"])
def test_a_pipe_is_refused_and_not_waited_for(name, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises(
        ValueError, match=f"must be a regular file: got the device or pipe .*{name}"
    ):
        files.open_file(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("poses.npz", b"not an archive", "must be an .npz archive: got 'poses.npz'"),
        ("model.pkl", b"not a pickle", "model.pkl"),
        ("mesh.ply", b"ply\nnonsense", "must be a readable .ply file: got 'mesh.ply'"),
        ("notes.txt", b"hello", "got 'notes.txt', which begins like none of them"),
        ("notes.docx", b"hello", "one of the suffixes"),
        ("../../evil.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "must be closed"),
    ],
)
def test_a_bad_upload_is_refused_and_leaves_nothing(name, content, message, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        files.open_upload(name, content)
    assert str(tmp_path) not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_what_is_saved_reads_back(balls, tmp_path):
    bend(balls)
    balls.set_shape(1, 0.5)
    (tmp_path / "pose.npz").write_bytes(files.pose_bytes(balls))
    again = read_poses(tmp_path / "pose.npz")
    frames, notes = files.frames_for(again, balls.body, embedded=False)
    vertices = balls.vertices.copy()
    balls.turn(_ELBOW, 1, 0.0)
    frames.load_into(balls, 0)
    np.testing.assert_array_equal(balls.vertices, vertices)
    assert not notes
    (tmp_path / "mesh.glb").write_bytes(files.mesh_bytes(balls, balls.read()))
    points, faces = read_mesh(tmp_path / "mesh.glb")
    np.testing.assert_allclose(points[faces], vertices[balls.faces], atol=1e-6)


def test_what_a_body_cannot_take_is_said(balls):
    given = Track("a", np.full((1, 52, 3), 0.1), shape=np.ones(16), names=["a"])
    frames, notes = files.frames_for(given, balls.body, embedded=False)
    assert frames.shape.shape == (1, 2) and frames.pose.shape == (1, 24, 3)
    assert "after the body's 2" in notes[0] and "left_index1" in notes[1]


def test_a_mesh_has_no_pose(pair_file):
    with pytest.raises(ValueError, match=r"save it as \.glb"):
        files.pose_bytes(files.open_file(pair_file))


def test_the_newest_change_wins_and_one_runs_at_a_time():
    running, most, done, refreshed, gate = [], [0], [], [], threading.Event()

    def change(name):
        def run():
            running.append(name)
            most[0] = max(most[0], len(running))
            if name == "first":
                gate.wait(5)
            running.remove(name)
            done.append(name)

        return run

    worker = Worker(refreshed.append, lambda error: done.append(error))
    worker.start()
    worker.post("a", change("first"))
    while not running:
        time.sleep(0.001)
    for k in range(50):
        worker.post("drag", change(k))
        worker.post("other", change(f"other {k}"))
    gate.set()
    assert worker.wait_until_idle(5)
    assert done == ["first", 49, "other 49"] and most == [1]
    assert refreshed == [{"a", "drag", "other"}]  # and measured once, having caught up
    assert worker.stop(5)


def test_an_error_is_reported_and_the_next_change_is_done():
    errors, done = [], []

    def fail():
        raise RuntimeError("oh")

    worker = Worker(lambda keys: done.append(keys), errors.append)
    worker.start()
    worker.post("a", fail)
    worker.post("b", lambda: done.append("b"))
    assert worker.wait_until_idle(5) and worker.stop(5)
    assert [str(error) for error in errors] == ["oh"]
    assert "b" in done


def test_the_command_says_what_is_missing(monkeypatch, capsys, tmp_path):
    assert cli.main(["view", "--port", "70000"]) == 2
    assert "port must be from 1 to 65535" in capsys.readouterr().err
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert cli.main(["view"]) == 2
    assert 'pip install "spt_jax[view]"' in capsys.readouterr().err


def test_the_command_refuses_a_bad_file_before_it_serves(capsys, tmp_path):
    pytest.importorskip("viser", reason="the live view needs viser")
    assert cli.main(["view", str(tmp_path / "nothing.npz"), "--quiet"]) == 2
    seen = capsys.readouterr()
    assert "nothing.npz" in seen.err and not seen.out
    assert cli.main(["view", "--host", "no.such.host.invalid", "--quiet"]) == 2
    assert "host must be an address of this machine" in capsys.readouterr().err


def test_a_view_serves_on_this_machine_alone_and_a_bad_file_changes_nothing(
    ball_file, pair_file, tmp_path
):
    pytest.importorskip("viser", reason="the live view needs viser")
    from spt_jax.view.server import View

    view = View(ball_file, port=18_765)
    try:
        view.start()
        assert view.url.startswith("http://127.0.0.1:")
        scene = view.scene
        view._do("slider", "turn_axis", _ELBOW, 1, 178.0)
        assert view.worker.wait_until_idle(20)
        assert view.scene.read().volume > 0
        view._do("open", "open_upload", "broken.npz", b"nothing")
        assert view.worker.wait_until_idle(20)
        assert view.scene is scene and "broken.npz" in view._status
        for action, value in (("count_folds", True), ("measure_by", "paper's ratio")):
            view._do(action, action, value)
        view._do("part", "choose_part", "left leg")
        view._do("handle", "turn_in_world", 4, (1.0, 0.0, 0.0, 0.0))
        assert view.worker.wait_until_idle(20)
        assert scene.paper and scene.count_folds and view.panel.joint == 4
        view._do("open", "open_upload", "pair.ply", pair_file.read_bytes())
        view._do("untangle", "untangle")
        assert view.worker.wait_until_idle(30)
        assert view.scene.body is None and view._status == "intersection-free"
        kept = view.scene.vertices
        view.scene.set_free_vertices(np.full_like(kept, np.inf))
        view._do("through", "see_through", False)
        assert view.worker.wait_until_idle(30)
        assert "vertices must be finite" in view.panel._figures.content
        view._do("untangle", "untangle")
        assert view.worker.wait_until_idle(30)
        assert "vertices must be finite" in view._status
        view.scene.set_free_vertices(kept)
        write_poses(tmp_path / "two.npz", np.zeros((2, 22, 3)), names=["one", "two"])
        view._do("open", "open_upload", "two.npz", (tmp_path / "two.npz").read_bytes())
        view._do("frame", "choose_frame", 1)
        assert view.worker.wait_until_idle(30)
        body = view.scene.body
        assert body is not None and body.num_vertices == 12_272 and view._status == "two"
    finally:
        assert view.stop_serving()


def test_a_body_with_a_hole_is_shown_with_a_note_and_an_edit_ends_a_search(tmp_path):
    pytest.importorskip("viser", reason="the live view needs viser")
    from spt_jax.view.server import View

    arrays = ball_arrays()
    np.savez(tmp_path / "holed.npz", **arrays | {"f": arrays["f"][1:]})
    view = View(tmp_path / "holed.npz", port=18_775)
    try:
        assert len(view._notes) == 1 and "closed by fans" in view._notes[0]
        view._searches.under_way = True  # as while a search runs
        view._do("through", "see_through", False)
        assert not view._searches.stopped
        view._do("slider", "turn_axis", _ELBOW, 1, 10.0)
        assert view._searches.stopped
    finally:
        view.stop_serving()
