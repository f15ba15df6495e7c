"""Folders of frames, and who is who in them."""

import json

import numpy as np
import pytest

from spt_jax.keypoints import Person, find_tracks, read_keypoints


def frame(*people):
    return {"version": 1.3, "people": [{"pose_keypoints_2d": one} for one in people]}


def rows(x, seed=0):
    points = np.random.default_rng(seed).uniform(0, 100, (25, 2)) + np.array([x, 50])
    return np.concatenate([points, np.full((25, 1), 0.8)], axis=1).ravel().tolist()


def written(folder, frames):
    for name, content in frames.items():
        (folder / name).write_text(json.dumps(content))
    return folder


def test_a_folder_is_read_in_the_order_of_its_numbers(tmp_path):
    names = {f"walk_{k}_keypoints.json": frame(rows(10.0 * k)) for k in (10, 2, 1)}
    (tmp_path / "notes.txt").write_text("no frame")
    file = read_keypoints(written(tmp_path, names))
    assert [one.image for one in file.people] == ["walk_1", "walk_2", "walk_10"]
    for one, k in zip(file.people, (1, 2, 10), strict=True):
        np.testing.assert_allclose(one.points.ravel(), np.delete(rows(10.0 * k), np.s_[2::3]))


def test_hands_in_one_frame_are_rows_of_all(tmp_path):
    one = frame(rows(0))
    one["people"][0]["hand_left_keypoints_2d"] = [5, 6, 0.5] * 21
    file = read_keypoints(written(tmp_path, {"0.json": frame(rows(0)), "1.json": one}))
    assert [person.layout for person in file.people] == ["body25_hands"] * 2


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ({}, r"must be a file or a folder of \.json files: got none in"),
        ({"0.json": [1]}, r"0\.json must be a frame of OpenPose's, .* got list"),
        ({"0.json": {"annotations": []}}, r"got \['annotations'\]; give files of other kinds"),
        ({"0.json": frame(), "0_keypoints.json": frame()}, "must have one file a frame"),
    ],
)
def test_what_is_no_sequence_is_said(frames, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_keypoints(written(tmp_path, frames))
    with pytest.raises(ValueError, match="the files of keypoint file"):
        read_keypoints(written(tmp_path, {"0.json": frame(rows(0))}), max_bytes=100)


def person(x, image, *, id=None, seen=25, size=100.0, layout="body25"):
    points = np.random.default_rng(1).uniform(0, size, (25, 2)) + np.array([x, 0])
    return Person(points, (np.arange(25) < seen).astype(float), layout, image, id=id)


def test_people_are_followed_by_ids_where_all_have_one():
    people = [person(0, 0, id=7), person(400, 0, id=8), person(0, 1, id=8), person(400, 1, id=7)]
    assert find_tracks(people) == [[0, 3], [1, 2]]
    with pytest.raises(ValueError, match="unique within a frame: got 7 twice in 0"):
        find_tracks([person(0, 0, id=7), person(400, 0, id=7)])


def test_people_are_followed_by_where_they_were(rng):
    """Three who pass each other at a distance, listed in another order in each frame."""
    where = np.array([0.0, 300.0, 650.0])[None] + np.arange(12)[:, None] * [20, 0, -15]
    people, truth = [], []
    for number, places in enumerate(where):
        for k in rng.permutation(3):
            people.append(person(places[k] + 400 * k, number, seen=25 - k))
            truth.append(k)
    tracks = find_tracks(people)
    assert sorted(map(sorted, tracks)) == sorted(
        [row for row, one in enumerate(truth) if one == k] for k in range(3)
    )
    assert all(track == sorted(track) for track in tracks)


def test_who_is_gone_for_long_or_jumps_is_somebody_else():
    near = [person(0, 0), person(5, 4)]
    assert find_tracks(near) == [[0, 1]]
    far = [person(0, 0), person(60, 1), person(0, 2)]
    assert find_tracks(far) == [[0, 2], [1]]
    others = [person(900, k) for k in range(12)]
    people = [person(0, 0), *others, person(0, 12)]
    assert find_tracks(people) == [[0], list(range(1, 13)), [13]]
    assert find_tracks([person(0, 0), person(0, 1, layout="coco17")]) == [[0], [1]]
    assert find_tracks([]) == []
