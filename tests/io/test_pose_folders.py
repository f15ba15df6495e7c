"""Motions whose frames are files of their own."""

import json

import numpy as np
import pytest

from spt_jax.datasets.items.inventory import take_inventory
from spt_jax.datasets.motion_tasks import MeasureMotions
from spt_jax.io import load_poses, open_poses


@pytest.fixture
def frames(tmp_path, rng):
    """EasyMocap's: people by number in a file a frame; the second one comes later."""
    folder = tmp_path / "smpl"
    folder.mkdir()
    poses = rng.normal(scale=0.3, size=(12, 2, 72))
    poses[:, :, :3] = 0
    for k in range(12):
        people = [
            {
                "id": person,
                "Rh": [[0.1, 0.2, 0.3]],
                "Th": [[float(k), 0.0, float(person)]],
                "poses": [poses[k, person].tolist()],
                "shapes": [[0.5] * 10],
            }
            for person in range(1 if k < 4 else 2)
        ]
        (folder / f"{k}.json").write_text(json.dumps(people))
    return folder, poses


def test_frames_come_in_the_order_of_their_numbers(frames):
    folder, poses = frames
    one, two = load_poses(folder)
    assert (one.name, two.name) == ("0", "1") and len(one.pose) == 12 and len(two.pose) == 8
    np.testing.assert_allclose(one.pose[:, 1:].reshape(12, -1), poses[:, 0, 3:], atol=1e-12)
    np.testing.assert_allclose(one.translation[:, 0], np.arange(12))
    assert one.frames.tolist() == list(range(12)) and two.frames.tolist() == list(range(4, 12))
    assert one.shape.shape == (12, 10) and two.names[0] == "1/0004"


def test_a_folder_is_written_again_as_it_was(frames, tmp_path):
    folder, _ = frames
    file = open_poses(folder)
    assert file.structure == "EasyMocap, a file a frame"
    other = file.tracks[1].pose.copy()
    other[2] += 0.1  # of frame 6
    for _ in range(2):  # the second time in the place of the first
        file.write(tmp_path / "out", {"1": other})
        written = {path.name for path in (tmp_path / "out").iterdir()}
        assert written == {path.name for path in folder.iterdir()}
        np.testing.assert_allclose(load_poses(tmp_path / "out")[1].pose, other, atol=1e-12)
        for path in folder.iterdir():
            same = json.loads(path.read_text()) == json.loads(
                (tmp_path / "out" / path.name).read_text()
            )
            assert same == (path.name != "6.json")
    assert {path.name for path in tmp_path.iterdir()} == {"smpl", "out"}


def test_people_of_folders_in_the_folder_are_called_as_their_files(tmp_path, rng):
    """SMPLify-X: results/IMAGE/PERSON.pkl, here as .npz."""
    pose = rng.normal(scale=0.3, size=(3, 66))
    for k in range(3):
        (tmp_path / f"image_{k}").mkdir()
        parts = {"global_orient": pose[k, :3], "body_pose": pose[k, 3:]}
        np.savez(tmp_path / f"image_{k}" / "000.npz", **parts)
    (track,) = load_poses(tmp_path)
    assert track.name == "000"
    np.testing.assert_allclose(track.pose.reshape(3, -1), pose)


def test_what_is_no_sequence(tmp_path):
    with pytest.raises(ValueError, match="must hold pose files: got none"):
        load_poses(tmp_path)
    np.save(tmp_path / "take1.npy", np.zeros((2, 22, 3)))
    np.save(tmp_path / "take2.npy", np.zeros((2, 22, 3)))
    with pytest.raises(ValueError, match=r"one frame each: got 2 in .*take1\.npy"):
        load_poses(tmp_path)
    for name, joints in (("take1", 22), ("take2", 24)):
        np.save(tmp_path / f"{name}.npy", np.zeros((1, joints, 3)))
    with pytest.raises(ValueError, match="must have one layout"):
        load_poses(tmp_path)


def test_a_data_set_takes_such_a_folder_for_one_motion(frames, tmp_path):
    np.save(tmp_path / "take1.npy", np.zeros((2, 22, 3)))
    np.save(tmp_path / "take2.npy", np.zeros((2, 22, 3)))
    (tmp_path / "takes").mkdir()
    for k in range(2):
        np.save(tmp_path / "takes" / f"take{k}.npy", np.zeros((2, 22, 3)))
    task = MeasureMotions()
    found = take_inventory(tmp_path, tmp_path / "out", task.wants, task.are_one)
    names = [item.name for item in found.items]
    assert names == ["smpl", "take1.npy", "take2.npy", "takes/take0.npy", "takes/take1.npy"]
    assert found.items[0].size == sum(path.stat().st_size for path in frames[0].iterdir())
