"""Keypoints as detectors write them: no confidence ignored, no point moved, nothing unsaid."""

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax.keypoints import LAYOUTS, read_keypoints

COCO = LAYOUTS["coco17"].names
_POINTS = np.random.default_rng(1).uniform(3, 900, (2, 17, 2)).round(2)
_TRUST = np.random.default_rng(2).uniform(0.01, 1, (2, 17)).round(3)
_ROWS = np.concatenate([_POINTS, _TRUST[..., None]], axis=2)
_PEOPLE = list(zip(_POINTS.tolist(), _TRUST.tolist(), strict=True))


# What each writes for the same two people; see the predictions of MMPose's inferencer and its
# topdown_demo_with_mmdet.py, rtmlib's README, Ultralytics' Results.summary, the COCO results of
# Detectron2 and AlphaPose, and pose-detection of TensorFlow.js.
def _mmpose():
    return [
        {"keypoints": p, "keypoint_scores": c, "bbox": [[0, 0, 640, 480]], "bbox_score": 0.98}
        for p, c in _PEOPLE
    ]


def _mmpose_video():
    return [{"frame_id": 4 + k, "instances": [one]} for k, one in enumerate(_mmpose())]


def _mmpose_demo():
    names = {str(k): name for k, name in enumerate(COCO)}
    meta = {"dataset_name": "coco", "num_keypoints": 17, "keypoint_id2name": names}
    return {"meta_info": meta, "instance_info": _mmpose()}


def _rtmlib():
    return {"keypoints": _POINTS.tolist(), "scores": _TRUST.tolist()}


def _one_person(name):
    return lambda: {"points": _POINTS[0].tolist(), name: _TRUST[0].tolist()}


def _own_people():
    return {"people": [{"points": p, "confidence": c} for p, c in _PEOPLE]}


def _own_rows():
    return {"people": _ROWS.tolist()}


def _own_beside():
    return {"people": _POINTS.tolist(), "confidences": _TRUST.tolist()}


def _results():
    return [
        {"image_id": 3, "category_id": 1, "score": 2.9, "box": [1, 2, 3, 4], "idx": [0.0]}
        | {"keypoints": rows.ravel().tolist()}
        for rows in _ROWS
    ]


def _pairs_and_scores():
    return [{"keypoints": p, "kp_score": [[x] for x in c]} for p, c in _PEOPLE]


def _flat_pairs():
    return [{"keypoints": np.ravel(p).tolist(), "keypoint_scores": c} for p, c in _PEOPLE]


def _ultralytics():
    return [
        {"name": "person", "class": 0, "confidence": 0.9, "box": {"x1": 1.0, "y1": 2.0}}
        | {"keypoints": {"x": [x for x, _ in p], "y": [y for _, y in p], "visible": c}}
        for p, c in _PEOPLE
    ]


def _tensorflow():
    return [
        {"keypoints": [{"x": x, "y": y, "score": c, "name": n} for (x, y), c, n in rows]}
        for rows in (zip(p, c, COCO, strict=True) for p, c in _PEOPLE)
    ]


_WRITERS = {
    "mmpose": _mmpose,
    "mmpose video": _mmpose_video,
    "mmpose demo": _mmpose_demo,
    "rtmlib": _rtmlib,
    "one person": _one_person("keypoint_scores"),
    "own people": _own_people,
    "own rows": _own_rows,
    "own, confidences beside": _own_beside,
    "COCO results": _results,
    "columns of scores": _pairs_and_scores,
    "flat pairs": _flat_pairs,
    "Ultralytics": _ultralytics,
    "TensorFlow.js": _tensorflow,
}


def _read(folder, content, name="points.json", layout="coco17"):
    path = folder / name
    if name.endswith(".npz"):
        np.savez(path, **content)
    else:
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return read_keypoints(path, layout=layout)


@pytest.mark.parametrize("writer", _WRITERS)
def test_the_same_people_are_read_whoever_wrote_them(writer, tmp_path):
    file = _read(tmp_path, _WRITERS[writer]())
    assert len(file.people) == (1 if writer == "one person" else 2) and file.notes == ()
    for person, points, trust in zip(file.people, _POINTS, _TRUST, strict=False):
        assert person.layout == "coco17"
        np.testing.assert_array_equal(person.points, points)
        np.testing.assert_array_equal(person.confidence, trust)


@pytest.mark.parametrize("name", ["confidence", "scores", "keypoint_scores", "visibility"])
@pytest.mark.parametrize("shape", [(2, 17), (2, 17, 1)])
def test_arrays_of_confidences_by_any_name(name, shape, tmp_path):
    arrays = {"keypoints": _POINTS.astype(np.float32), name: _TRUST.reshape(shape)}
    file = _read(tmp_path, arrays, "points.npz")
    np.testing.assert_array_equal([person.confidence for person in file.people], _TRUST)
    np.testing.assert_allclose([person.points for person in file.people], _POINTS, rtol=1e-6)


def test_frames_and_scores_of_people_are_kept(tmp_path):
    people = _read(tmp_path, _mmpose_video()).people
    assert [(one.image, one.score) for one in people] == [(4, 0.98), (5, 0.98)]
    assert [one.score for one in _read(tmp_path, _results()).people] == [2.9, 2.9]
    names = {str(k): name for k, name in enumerate(["root", "right_hip"])}
    demo = _mmpose_demo() | {"meta_info": {"keypoint_id2name": names}}
    assert len(_read(tmp_path, demo).people) == 2  # the caller says what they are
    with pytest.raises(ValueError, match=r"a point for each of the 2 names in the file: got 17"):
        _read(tmp_path, demo, layout=None)
    assert _read(tmp_path, _mmpose_demo(), layout=None).people[0].layout == "coco17"
    assert _read(tmp_path, _tensorflow(), layout=None).people[0].layout == "coco17"
    turned = [{"keypoints": person["keypoints"][::-1]} for person in _tensorflow()]
    again = _read(tmp_path, turned, layout=None).people
    assert again[0].layout == ",".join(COCO[::-1])
    np.testing.assert_array_equal(again[0].points, _POINTS[0][::-1])


def _renamed(node, new):
    """With every name of confidences replaced, and how many there were."""
    if isinstance(node, list):
        return [_renamed(child, new) for child in node]
    if not isinstance(node, dict):
        return node
    known = (
        "keypoint_scores",
        "scores",
        "confidence",
        "confidences",
        "kp_score",
        "visible",
        "score",
    )
    return {
        new if name in known and (isinstance(child, list) or "x" in node) else name: _renamed(
            child, new
        )
        for name, child in node.items()
    }


@pytest.mark.parametrize(
    "writer", sorted(set(_WRITERS) - {"flat pairs", "COCO results", "own rows"})
)
def test_confidences_under_an_unknown_name_are_refused(writer, tmp_path):
    content = _renamed(_WRITERS[writer](), "sureness")
    with pytest.raises(ValueError, match=r"points\.json must have .* in 'sureness'; call it conf"):
        _read(tmp_path, content)


def test_unknown_arrays_are_refused_where_they_may_be_confidences(tmp_path):
    arrays = {"keypoints": _POINTS, "boxes": np.ones((2, 4)), "note": np.array({"a": 1})}
    assert len(_read(tmp_path, arrays, "points.npz").people) == 2
    with pytest.raises(ValueError, match=r"points\.npz must have confidences .* in 'certainty'"):
        _read(tmp_path, arrays | {"certainty": _TRUST}, "points.npz")
    assert len(_read(tmp_path, arrays | {"keypoints": _ROWS, "ids": _TRUST}, "a.npz").people) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keypoint_scores": [0.5] * 16}, r"keypoint_scores of person 1 .* 17: got \(16,\)"),
        ({"keypoint_scores": ["a"] + [0.5] * 16}, "confidence of keypoint 0 .* got 'a'"),
        ({"keypoint_scores": [None] * 17}, "confidence of keypoint 0 .* got None"),
        ({"keypoint_scores": [95.0] * 17}, "at most 20 in size: got 95.0; divide percent"),
        ({"keypoints": [[1.0, 2.0, 3.0]] * 17}, "one confidence a keypoint: got 3.0 in the row"),
        ({"keypoints": {"x": [1.0], "y": 2}}, "must have lists x and y of one length"),
        ({"keypoints": [{"x": 1.0, "y": 2.0}, {"x": 1}]}, "must have x and y in each"),
        ({"keypoints": [10**400, 5] + [5.0] * 32}, "x of keypoint 0 .* must be finite"),
    ],
)
def test_what_is_wrong_with_confidences_is_said(change, message, tmp_path):
    content = _mmpose()
    content[1] |= change
    with pytest.raises(ValueError, match=message) as caught:
        _read(tmp_path, content)
    assert "person 1 in " in str(caught.value) and "points.json" in str(caught.value)


def test_confidences_of_a_file_must_fit_its_people(tmp_path):
    with pytest.raises(ValueError, match=r"scores in .*must have one list a person.* 1 for 2"):
        _read(tmp_path, _rtmlib() | {"scores": _TRUST[:1].tolist()})
    both = _own_people() | {"confidence": _TRUST.tolist()}
    with pytest.raises(ValueError, match="stand in one place"):
        _read(tmp_path, both)
    three = [[*row, 0.5] for row in _POINTS[0].tolist()]
    with pytest.raises(ValueError, match="COCO's v a keypoint"):
        _read(tmp_path, {"annotations": [{"keypoints": _POINTS[0].tolist()}]})
    with pytest.raises(ValueError, match="must be 0, 1 or 2"):
        _read(tmp_path, {"annotations": [{"keypoints": np.ravel(three).tolist()}]})


def test_what_becomes_of_odd_points_is_noted(tmp_path):
    content = copy.deepcopy(_mmpose()[:1])
    content[0]["keypoint_scores"] = [1.5, 3.0, -0.25, *[0.5] * 14]
    content[0]["keypoints"][2] = [-1.0, -1.0]
    content[0]["keypoints"][5] = [0.0, 0.0]
    content[0]["keypoints_visible"] = [0.7] * 17
    file = _read(tmp_path, content)
    assert file.people[0].confidence.tolist() == [1, 1, 0, 0.5, 0.5, 0, *[0.5] * 11]
    assert file.people[0].points[[2, 5]].tolist() == [[0, 0], [0, 0]]
    assert file.notes == (
        "numbers in keypoints_visible, which are not used beside keypoint_scores: 17",
        "points with a score below 0, taken as missing: 1",
        "points at (0, 0), taken as missing: 1",
        "confidences above 1, taken as 1: 2",
    )
    bare = [{"keypoints": _POINTS[0].tolist()}]
    assert _read(tmp_path, bare).notes == (
        "people without confidences, all of whose points count in full: 1",
    )


@pytest.mark.parametrize("count", [23, 26, 133, 136])
def test_whole_bodies_are_read_as_such_or_by_their_first_17_points(count, tmp_path, rng):
    points = rng.uniform(5, 500, (count, 2))
    content = [{"keypoints": points.tolist(), "keypoint_scores": [0.5] * count}]
    file = _read(tmp_path, content, layout="coco17")
    np.testing.assert_array_equal(file.people[0].points, points[:17])
    (note,) = file.notes
    assert note.startswith("points of feet, face, hands") and note.endswith(f"{count - 17}")
    file = _read(tmp_path, content, layout=None)
    face = np.array([point == "" for point in LAYOUTS[file.people[0].layout].points])
    assert face.sum() == (68 if count > 100 else 0)
    np.testing.assert_array_equal(file.people[0].confidence, np.where(face, 0, 0.5))
    np.testing.assert_array_equal(file.people[0].points[~face], points[~face])
    assert file.notes == (("points of the face, which are not used: 68",) if count > 100 else ())
    with pytest.raises(ValueError, match=f"body25 has 25 keypoints: got {count}"):
        _read(tmp_path, content, layout="body25")


def test_hands_and_feet_beside_a_body_are_read_and_faces_said_not_to_be_used(tmp_path):
    flat = [10.0, 20.0, 0.5] * 25
    person = {"pose_keypoints_2d": flat, "face_keypoints_2d": [3.0, 4.0, 0.5] * 70}
    person |= {"hand_left_keypoints_2d": [0] * 63, "hand_right_keypoints_2d": [1, 2, 0.5] * 21}
    bare = {"pose_keypoints_2d": flat}
    content = {"people": [person, {"hand_left_keypoints_2d": [1, 2, 3]}, bare]}
    file = _read(tmp_path, content, layout=None)
    assert file.notes == (
        "points in face_keypoints_2d, which are not used: 70",
        "points in hand_left_keypoints_2d, which are not used: 1",
    )
    # Everybody of a file has one layout.
    assert [one.layout for one in file.people] == ["body25_hands"] * 2
    np.testing.assert_array_equal(file.people[0].confidence, [0.5] * 25 + [0] * 21 + [0.5] * 21)
    assert file.people[0].points[46:].tolist() == [[1, 2]] * 21
    np.testing.assert_array_equal(file.people[1].confidence, [0.5] * 25 + [0] * 42)
    file = _read(tmp_path, content, layout="body25")
    assert file.notes[1] == "points in hand_right_keypoints_2d, which are not used: 21"
    with pytest.raises(
        ValueError, match=r"hand_right_keypoints_2d of person 0 .*21 points: got 20"
    ):
        _read(
            tmp_path,
            {"people": [person | {"hand_right_keypoints_2d": [1, 2, 0.5] * 20}]},
            layout=None,
        )
    wholebody = {"keypoints": [5, 6, 2] * 17, "foot_kpts": [5, 6, 2] * 6, "face_kpts": [0] * 204}
    file = _read(tmp_path, {"annotations": [wholebody]})
    assert file.notes == ("points in foot_kpts, which are not used: 6",)
    wholebody |= {"lefthand_kpts": [7, 8, 1.0] * 21, "face_kpts": [5, 6, 2] * 68}
    file = _read(tmp_path, {"annotations": [wholebody, {"keypoints": [5, 6, 2] * 17}]}, layout=None)
    assert file.notes == ("points of the face, which are not used: 68",)
    assert [one.layout for one in file.people] == ["wholebody133"] * 2
    trust = [1.0] * 23 + [0] * 68 + [0.5] * 21 + [0] * 21
    np.testing.assert_array_equal(file.people[0].confidence, trust)
    np.testing.assert_array_equal(file.people[1].confidence, [1.0] * 17 + [0] * 116)


def _shares(size, low=0.1, high=0.9, **more):
    points = np.random.default_rng(3).uniform(low, high, (18, 2))
    rows = np.concatenate([points, np.full((18, 1), 0.5)], axis=1)
    rows[4] = 0
    names = ("canvas_width", "canvas_height")
    content = {"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]} | more
    return points, content | (dict(zip(names, size, strict=True)) if size else {})


def test_shares_of_the_canvas_become_pixels(tmp_path):
    points, content = _shares((640, 480), high=1.2)
    for written in (content, [content]):
        file = _read(tmp_path, written, layout=None)
        seen = file.people[0].confidence > 0
        assert (file.width, file.height, seen.sum()) == (640, 480, 17)
        np.testing.assert_array_equal(file.people[0].points[seen], (points * (640, 480))[seen])
        assert file.notes == ("people in 0..1, scaled by the file's 640 by 480 pixels: 1",)
    in_pixels = {"people": [{"pose_keypoints_2d": [64, 48, 0.5] * 18}], "canvas_width": 640}
    file = _read(tmp_path, in_pixels | {"canvas_height": 480}, layout=None)
    assert file.people[0].points[0].tolist() == [64, 48] and file.notes == () and file.width == 640
    # Of an object in a list, width and height are its box's.
    boxed = [{"keypoints": [[0.5, 0.5, 1.0]] * 17, "width": 30, "height": 40}]
    with pytest.raises(ValueError, match="must hold keypoints in pixels"):
        _read(tmp_path, boxed)


@pytest.mark.parametrize(
    "change",
    [
        {"size": None},
        {"size": (640, 480), "low": -0.9},
        {"size": None, "canvas_width": 640},
        {"size": None, "low": 0.4, "high": 2.0},
    ],
)
def test_shares_without_a_canvas_are_refused(change, tmp_path):
    _, content = _shares(**change)
    with pytest.raises(ValueError, match=r"points\.json must hold keypoints in pixels: got all of"):
        _read(tmp_path, content, layout=None)


def _ways(node, way=()):
    """Every place in a tree."""
    if not isinstance(node, (dict, list)):
        return
    for key, child in node.items() if isinstance(node, dict) else enumerate(node):
        yield (*way, key)
        yield from _ways(child, (*way, key))


_GOOD = {name: (writer(), list(_ways(writer()))) for name, writer in _WRITERS.items()}
_TRIPLES = {tuple(row) for person in _ROWS.tolist() for row in person}
_VALUES = st.sampled_from(
    [None, True, "", "0.5", -1, 0, 1, 2, 7.25, 1e300, 10**400, float("nan"), [], {}, [[[[]]]]]
)


@settings(max_examples=250)
@given(st.data())
def test_a_changed_file_is_refused_by_name_or_read_but_for_the_change(tmp_path_factory, data):
    """One place of a good file is replaced, removed or doubled; nothing else may change."""
    content, ways = _GOOD[data.draw(st.sampled_from(sorted(_GOOD)))]
    content = node = copy.deepcopy(content)
    *before, last = data.draw(st.sampled_from(ways))
    for key in before:
        node = node[key]
    change = data.draw(st.sampled_from(["replace", "remove", "double"]))
    if change == "replace":
        node[last] = data.draw(_VALUES)
    elif change == "remove":
        del node[last]
    elif isinstance(node, list):
        node.insert(last, node[last])
    try:
        file = _read(tmp_path_factory.getbasetemp(), content)
    except ValueError as error:
        assert "points.json" in str(error)
        return
    other = 0
    for person in file.people:
        assert np.isfinite(person.points).all() and np.ptp(person.confidence) <= 1
        rows = np.column_stack([person.points, person.confidence])[person.confidence > 0]
        other += sum(tuple(row) not in _TRIPLES for row in rows.tolist())
    # Where a whole list of confidences is gone, that is said.
    assert other <= 1 or any(note.startswith("people without conf") for note in file.notes)


@settings(max_examples=150)
@given(st.sampled_from(sorted(_WRITERS)), st.floats(0, 1), st.integers(0, 255), st.booleans())
def test_damaged_bytes_are_refused_by_name_or_read(tmp_path_factory, writer, place, byte, cut):
    text = bytearray(json.dumps(_WRITERS[writer]()).encode())
    at = int(place * (len(text) - 1))
    text = text[:at] if cut else text[:at] + bytes([byte]) + text[at + 1 :]
    try:
        file = _read(tmp_path_factory.getbasetemp(), bytes(text))
    except ValueError as error:
        assert "points.json" in str(error)
        return
    for person in file.people:
        assert np.isfinite(person.points).all()
        assert ((person.confidence >= 0) & (person.confidence <= 1)).all()
