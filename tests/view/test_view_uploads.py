"""Files that a browser sends: their size, their parts, and their names."""

import json
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("viser", reason="the live view needs viser")

from helpers_view import PART, SECONDS, Browser, served, wait_until

from spt_jax.io.pose_files import MotionFile, write_poses
from spt_jax.view import files
from spt_jax.view.scene import Scene


@pytest.fixture(scope="module")
def view(tmp_path_factory):
    path = tmp_path_factory.mktemp("uploads") / "first.ply"
    trimesh.creation.icosphere(subdivisions=1).export(path)
    with served(path, upload_limit=1) as running:
        yield running


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=2).export(file_type="ply")


def test_a_file_of_several_parts_is_shown(view):
    big = trimesh.creation.icosphere(subdivisions=5).export(file_type="ply", encoding="ascii")
    assert PART < len(big) < 1_000_000
    with Browser(view) as browser, Browser(view) as other:
        before = len(view.server._websock_server._broadcast_buffer.message_from_id)
        browser.send_file("big.ply", big)
        wait_until(lambda: view.scene.name == "big")
        other.wait_for(lambda message: message["type"] == "GuiRemoveMessage")
        acknowledged = [m["type"] == "FileTransferPartAck" for m in other.messages]
        assert not any(acknowledged)  # that is between the view and who sent it
        browser.wait_for(
            lambda m: m["type"] == "FileTransferPartAck" and m["transferred_bytes"] == len(big)
        )
        kept = view.server._websock_server._broadcast_buffer.message_from_id.values()
        assert "FileTransferPartAck" not in {type(message).__name__ for message in kept}
        assert len(kept) < 3 * before


def test_a_file_over_the_limit_is_refused_before_it_is_taken(view):
    scene = view.scene
    with Browser(view) as browser:
        browser.send_file("huge.ply", b"x" * 10, size=5_400_001)
        said = browser.wait_for_notification()
        assert said == (
            "file must have at most 1 MB: got 'huge.ply' with 6 MB; start the view with "
            "--upload-limit 6, or with the file: spt-jax view FILE"
        )
        done = browser.wait_for(lambda m: m["type"] == "FileTransferPartAck")
        assert (done["transferred_bytes"], done["total_bytes"]) == (0, 0)
        browser.send_file("negative.ply", b"x", size=-1)
        assert "'negative.ply'" in browser.wait_for_notification()
    assert view.scene is scene


@pytest.mark.parametrize(
    ("size", "parts"),
    [
        (20, [(0, b"x" * 10), (0, b"x" * 10)]),
        (20, [(1, b"x" * 10)]),
        (20, [(-1, b"x" * 10)]),
        (20, [(0, b"x" * 21)]),
        (20, [(0, b"")]),
        (20, [(0, "text")]),
        (0, [(0, b"x")]),
    ],
    ids=["twice", "late", "negative", "more than announced", "nothing", "text", "of an empty file"],
)
def test_parts_that_were_not_announced_end_the_upload(view, size, parts):
    scene = view.scene
    with Browser(view) as browser:
        browser.send_file("odd.ply", b"", size=size, parts=parts)
        said = browser.wait_for_notification()
        assert "file must arrive in order" in said or "'odd.ply'" in said
        browser.send_file("odd.ply", b"never")
        assert "odd.ply" in browser.wait_for_notification()  # and the next is taken
    assert view.scene is scene


def test_uploads_keep_to_the_limit_together_and_one_that_leaves_gives_its_room_back(view, ball):
    with Browser(view) as second:
        with Browser(view) as first:
            first.send_file("half.ply", b"", size=999_999, parts=[(0, b"x" * 1000)])
            first.wait_for(lambda m: m["type"] == "FileTransferPartAck" and m["transferred_bytes"])
            second.send_file("other.ply", ball)
            said = second.wait_for_notification()
            assert "files must have at most 1 MB in all at a time: got 'other.ply'" in said
        wait_until(lambda: len(view.server.get_clients()) == 1)
        second.send_file("other.ply", ball)
        wait_until(lambda: view.scene.name == "other")


def test_a_second_file_from_the_same_browser_takes_the_place_of_the_first(view, ball):
    with Browser(view) as browser:
        browser.send_file("half.ply", b"", size=999_999, parts=[(0, b"x" * 1000)])
        browser.send_file("second.ply", ball)
        wait_until(lambda: view.scene.name == "second")


def test_files_that_were_shown_leave_nothing_behind(view, ball):
    buffer = view.server._websock_server._broadcast_buffer
    with Browser(view) as browser:
        kept = []
        for k in range(12):
            browser.send_file(f"ball{k}.ply", ball)
            wait_until(lambda k=k: view.scene.name == f"ball{k}")
            assert view.worker.wait_until_idle(SECONDS)
            last = buffer.message_counter - 1  # that all of it was sent
            wait_until(lambda last=last: min(buffer.generator_cursors.values()) >= last)
            kept.append(len(buffer.message_from_id))
    assert max(kept[2:]) <= max(kept[:2])


@pytest.mark.parametrize(
    "name",
    [
        *("/etc/evil.ply", "../../evil.ply", "C:\\Windows\\evil.ply", "..\\evil.ply", "evil.ply"),
        *("~/evil.ply", "evil.ply/", "//host/share/evil.ply", "a\x00/evil.ply", "file:///evil.ply"),
    ],
)
def test_no_name_becomes_a_path(name, ball, tmp_path, monkeypatch):
    written = []
    write = Path.write_bytes

    def spy(path, content):
        written.append(path)
        return write(path, content)

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(Path, "write_bytes", spy)
    opened = files.open_upload(name, ball)
    assert isinstance(opened, Scene) and opened.name == "evil"
    (path,) = written
    assert path.parent.parent == tmp_path and path.suffix == ".ply" and "evil" not in str(path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("", "file"),
        ("/", "file"),
        ("..", "file"),
        ("\x00\n", "file"),
        ("two\nlines\x1b[31m.ply", "two lines [31m.ply"),
        ("\u202eylp.exe", "ylp.exe"),
        ("a" * 300 + ".ply", "a" * 76 + ".ply"),
    ],
)
def test_a_name_is_shown_in_one_printable_line(name, label):
    assert files.label_of(name) == label


@pytest.mark.parametrize(
    ("name", "suffix"),
    [("a.ply ", ".ply"), ("a.p/../ly", ""), ("a.a b", ""), ("a.\u0440ly", ""), ("a.PLY", ".ply")],
)
def test_only_a_plain_suffix_reaches_the_disk(name, suffix, monkeypatch):
    seen = []

    def refuse(path, name, **_):
        seen.append(path)
        raise ValueError(f"file must be read: got {str(path)!r}, {path.name!r}, {path.stem!r}")

    monkeypatch.setattr(files, "open_file", refuse)
    with pytest.raises(ValueError, match="must be read") as caught:
        files.open_upload(name, b"x")
    assert seen[0].suffix == suffix and seen[0].stem not in str(caught.value)


def test_frames_are_called_after_the_file_that_was_sent(tmp_path):
    np.savez(tmp_path / "walk.npz", poses=np.zeros((2, 66)))
    opened = files.open_upload("walk.npz", (tmp_path / "walk.npz").read_bytes())
    assert isinstance(opened, MotionFile)
    assert opened.tracks[0].names == ["walk/0000", "walk/0001"]
    write_poses(tmp_path / "named.npz", np.zeros((1, 22, 3)), names=["mine"])
    named = files.open_upload("x.npz", (tmp_path / "named.npz").read_bytes())
    assert isinstance(named, MotionFile) and named.tracks[0].names == ["mine"]


def test_a_file_that_names_another_file_does_not_get_it(tmp_path):
    # The vertices of a .gltf may lie in a file of their own; a whole ball, here outside the upload.
    exported = trimesh.creation.icosphere(subdivisions=1).export(file_type="gltf")
    tree = json.loads(exported["model.gltf"])
    for k, buffer in enumerate(tree["buffers"]):
        (tmp_path / f"secret{k}.bin").write_bytes(exported[buffer["uri"]])
    for up in ("", "../" * 12):
        for k, buffer in enumerate(tree["buffers"]):
            buffer["uri"] = up + str(tmp_path / f"secret{k}.bin").lstrip("/" if up else "")
        with pytest.raises(ValueError, match=r"must be a readable \.gltf file: got 'a\.gltf'"):
            files.open_upload("a.gltf", json.dumps(tree).encode())
    (tmp_path / "a.gltf").write_text(
        json.dumps(
            tree
            | {"buffers": [b | {"uri": f"secret{k}.bin"} for k, b in enumerate(tree["buffers"])]}
        )
    )
    scene = files.open_file(tmp_path / "a.gltf")  # in its own folder it does
    assert isinstance(scene, Scene) and len(scene.faces) == 80
