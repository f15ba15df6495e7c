"""read_keypoints: each format as its makers write it, and what is wrong with a bad file."""

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax.keypoints import LAYOUTS, read_keypoints

_COCO_NAMES = list(LAYOUTS["coco17"].names)


def _written(folder, content, name="points.json"):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def _flat(rng, count, third):
    rows = np.concatenate([rng.uniform(1, 600, (count, 2)).round(1), third[:, None]], axis=1)
    return rows, rows.ravel().tolist()


def _coco(annotations, **changes):
    return {
        "images": [
            {"id": 7, "file_name": "street.jpg", "width": 640, "height": 480},
            {"id": 8, "file_name": "beach.jpg", "width": 500, "height": 375},
        ],
        "annotations": annotations,
        "categories": [{"id": 1, "name": "person", "keypoints": _COCO_NAMES, "skeleton": []}],
    } | changes


def _annotation(keypoints, image=7, **changes):
    return {
        "id": 11,
        "image_id": image,
        "category_id": 1,
        "iscrowd": 0,
        "num_keypoints": 9,
        "keypoints": keypoints,
    } | changes


def test_coco_annotations(tmp_path, rng):
    rows, flat = _flat(rng, 17, np.array([2, 1, 0] * 5 + [2, 2.0]))
    other, other_flat = _flat(rng, 17, np.full(17, 2))
    hidden = [0] * 51
    file = read_keypoints(
        _written(
            tmp_path,
            _coco(
                [
                    _annotation([int(x) if x == int(x) else x for x in flat]),
                    _annotation(hidden, num_keypoints=0, id=12),
                    _annotation({"counts": []}, iscrowd=1, id=13),
                    _annotation(other_flat, image=8, id=14),
                    _annotation(hidden, id=15),
                    {"id": 16, "image_id": 7, "category_id": 3, "bbox": [1, 2, 3, 4]},
                ]
            ),
        )
    )
    first, second = file.people
    assert file.skipped == {"no visible point": 2, "crowd": 1, "no keypoints": 1}
    assert first.layout == "coco17" and (first.image, first.id) == ("street.jpg", 11)
    assert (second.image, second.width, second.height, second.id) == ("beach.jpg", 500, 375, 14)
    assert file.width is None  # two images
    np.testing.assert_array_equal(first.confidence, [1, 0.5, 0] * 5 + [1, 1])
    seen = first.confidence > 0
    np.testing.assert_array_equal(first.points[seen], rows[seen, :2])
    np.testing.assert_array_equal(first.points[~seen], 0)
    np.testing.assert_array_equal(second.points, other[:, :2])
    assert first.points.dtype == first.confidence.dtype == np.float64


def test_coco_annotations_of_one_image_know_its_size(tmp_path, rng):
    _, flat = _flat(rng, 17, np.full(17, 2))
    file = read_keypoints(_written(tmp_path, _coco([_annotation(flat), _annotation(flat)])))
    assert (len(file.people), file.width, file.height) == (2, 640, 480)
    bare = {"annotations": [{"keypoints": flat, "image_id": 5}]}
    (person,) = read_keypoints(_written(tmp_path, bare)).people
    assert (person.layout, person.image, person.width) == ("coco17", 5, None)


def test_categories_may_list_another_known_order(tmp_path, rng):
    _, flat = _flat(rng, 17, np.full(17, 2))
    names = list(LAYOUTS["h36m17"].names)
    content = _coco([_annotation(flat)], categories=[{"id": 1, "keypoints": names}])
    assert read_keypoints(_written(tmp_path, content)).people[0].layout == "h36m17"
    content["categories"][0]["keypoints"] = names[::-1]
    assert read_keypoints(_written(tmp_path, content)).people[0].layout == ",".join(names[::-1])
    content["categories"][0]["keypoints"] = [f"point {k}" for k in range(17)]
    with pytest.raises(ValueError, match=r"must name keypoints that are known: got .*'point 0'"):
        read_keypoints(_written(tmp_path, content))
    person = read_keypoints(_written(tmp_path, content), layout="coco17").people[0]
    assert person.layout == "coco17"


def test_coco_results(tmp_path, rng):
    rows, flat = _flat(rng, 17, rng.uniform(0.1, 1.2, 17).round(3))
    content = [
        {"image_id": 42, "category_id": 1, "keypoints": flat, "score": 0.9},
        {"image_id": "a/b.jpg", "category_id": 1, "keypoints": flat, "score": 1},
        {"image_id": 43, "bbox": [0, 0, 1, 1], "score": 0.2},
    ]
    file = read_keypoints(_written(tmp_path, content))
    first, second = file.people
    assert (first.image, second.image, first.score) == (42, "a/b.jpg", 0.9)
    np.testing.assert_array_equal(first.points, rows[:, :2])
    np.testing.assert_array_equal(first.confidence, np.minimum(rows[:, 2], 1))
    assert file.skipped == {"no keypoints": 1}
    assert read_keypoints(_written(tmp_path, [])).people == []


@pytest.mark.parametrize(("count", "layout"), [(25, "body25"), (18, "openpose18")])
def test_openpose(tmp_path, rng, count, layout):
    third = rng.uniform(0.1, 1, count)
    third[3] = 0
    rows, flat = _flat(rng, count, third)
    flat[9:12] = [0, 0, 0]
    person = {"person_id": [-1], "pose_keypoints_2d": flat, "face_keypoints_2d": []}
    empty = {"person_id": [-1], "pose_keypoints_2d": [0] * (3 * count)}
    face = {"person_id": [-1], "pose_keypoints_2d": [], "face_keypoints_2d": [1, 2, 3]}
    content = {"version": 1.3, "people": [empty, person, face]}
    file = read_keypoints(_written(tmp_path, content))
    (got,) = file.people
    assert got.layout == layout and got.id is None
    assert file.skipped == {"no visible point": 1, "no keypoints": 1}
    np.testing.assert_array_equal(got.points[4:], rows[4:, :2])
    np.testing.assert_array_equal(got.confidence, third)
    assert read_keypoints(_written(tmp_path, {"version": 1.3, "people": []})).people == []


def test_own_layout_as_json(tmp_path, rng):
    rows, flat = _flat(rng, 24, rng.uniform(0.1, 1, 24))
    content = {"layout": "smpl", "width": 800, "height": 600, "image": "a.png"}
    same = [
        content | {"people": [rows.tolist()]},
        content | {"people": [flat]},
        content | {"people": [{"id": 3, "points": rows.tolist()}]},
        content | {"points": rows.tolist()},
    ]
    for variant in same:
        file = read_keypoints(_written(tmp_path, variant))
        (person,) = file.people
        assert (person.layout, person.image) == ("smpl24", "a.png")
        assert (file.width, file.height, person.height) == (800, 600, 600)
        np.testing.assert_array_equal(person.points, rows[:, :2])
        np.testing.assert_array_equal(person.confidence, rows[:, 2])
    (person,) = read_keypoints(
        _written(tmp_path, {"points": rows[:17, :2].tolist()}), layout="h36m17"
    ).people
    assert person.layout == "h36m17"
    np.testing.assert_array_equal(person.confidence, 1)


def test_own_layout_as_npz(tmp_path, rng):
    points, confidence = rng.uniform(0, 500, (2, 17, 2)), rng.uniform(0.1, 1, (2, 17))
    path = tmp_path / "points.npz"
    np.savez(path, keypoints=points, confidence=confidence, layout="coco17", width=640)
    file = read_keypoints(path)
    assert (len(file.people), file.width, file.height) == (2, 640, None)
    np.testing.assert_array_equal(file.people[1].points, points[1])
    np.testing.assert_array_equal(file.people[1].confidence, confidence[1])
    np.savez(path, keypoints=np.concatenate([points, confidence[..., None]], 2)[0].astype("f4"))
    (person,) = read_keypoints(path, layout="coco17").people
    np.testing.assert_allclose(person.confidence, confidence[0], rtol=1e-6)


def test_a_byte_order_mark_and_a_string_path_are_no_trouble(tmp_path):
    path = tmp_path / "points.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps({"people": []}).encode())
    assert read_keypoints(str(path)).people == []


_GOOD = [[10.0, 20.0, 0.5]] * 17


def _changed(keypoint, column, value):
    rows = [list(row) for row in _GOOD]
    rows[keypoint][column] = value
    return rows


def _own(*people, **more):
    return {"layout": "coco17", "people": list(people)} | more


def _body25(value, index=30):
    flat = [1.0] * 75
    flat[index] = value
    return {"people": [{"pose_keypoints_2d": [1.0] * 75}, {"pose_keypoints_2d": flat}]}


_V = [10, 20, 2] * 17
_BAD = [
    ("", "must be JSON: got .* with Expecting value at line 1, column 1; it is cut or damaged"),
    ('{"people": [{"pose_keypoints_2d": [1, 2', "must be JSON: got .* it is cut"),
    ("[" * 100_000, "must not be nested so deeply"),
    ("3", "must hold COCO annotations .* got int"),
    ('"people"', "got str"),
    ({"frames": []}, r"must hold COCO annotations .* got \['frames'\]"),
    ({"people": 3}, "people in .* must be a list: got int"),
    ({"people": [_GOOD]}, "person 0 in .* needs a layout, which the file lacks: got 17"),
    (_own(_GOOD, layout=3), "layout in .* must be a name: got 3"),
    (_own(_GOOD, layout="coco"), 'person 0 in .*: layout must be one of "coco17"'),
    (_own(_GOOD, _GOOD[:16]), "person 1 in .*: layout coco17 has 17 keypoints: got 16"),
    (_own(_GOOD, []), "person 1 in .* must be a list of x, y and confidence: got \\[\\]"),
    (_own(_GOOD, None), "person 1 in .* must be a list of x, y and confidence: got None"),
    (_own(_GOOD, {"name": "x"}), "person 1 in .* got None"),
    (_own([1.0, 2.0]), "person 0 in .* three numbers a keypoint.* got 2 numbers"),
    (_own([[1.0]] * 17), r"rows \[x, y, confidence\].* got \[1.0\] for keypoint 0"),
    (_own([[1.0, 2.0, 1.0], 3.0] * 8), "got 3.0 for keypoint 1"),
    (
        _own(_GOOD, _changed(5, 0, "a")),
        r"person 1 in .*: x of keypoint 5 \(left_shoulder\) mus",
    ),
    (_own(_changed(0, 1, None)), r"y of keypoint 0 \(nose\) must be a number: got None"),
    (_own(_changed(16, 2, True)), r"confidence of keypoint 16 \(right_ankle\) must be a number"),
    (_own(_changed(3, 0, float("nan"))), r"x of keypoint 3 \(left_ear\) must be finite: got nan"),
    (_own(_changed(3, 2, float("inf"))), "confidence of keypoint 3 .* must be finite: got inf"),
    (_own(_changed(3, 1, 10**400)), "y of keypoint 3 .* must be finite"),
    (_own(_changed(3, 1, -3e8)), "y of keypoint 3 .* at most 1e.06 in size: got -300000000.0"),
    (_own(_changed(3, 2, 400)), "confidence of keypoint 3 .* at most 20 .* divide percent"),
    (_own(_changed(3, 2, -0.1)), "confidence of keypoint 3 .* must not be negative: got -0.1"),
    (_own(_GOOD, width="wide"), "width in .* must be a number: got 'wide'"),
    (_own(_GOOD, height=0), "height in .* must be a number of pixels"),
    (_body25("x"), r"person 1 in .*: x of keypoint 10 \(right_knee\) must be a number: got 'x'"),
    (_body25(-1, 32), r"person 1 in .*: confidence of keypoint 10 \(right_knee\) must not be neg"),
    (
        {"people": [{"pose_keypoints_2d": [1.0] * 45}]},
        r"25 \(body25\) or 18 \(openpose18\).* 15",
    ),
    ({"people": [{"pose_keypoints_2d": [1.0] * 74}]}, "person 0 in .* got 74 numbers"),
    ({"people": [{"pose_keypoints_2d": [1.0] * 75}, 3]}, "got int at entry 1"),
    (_coco([_annotation(_V), _annotation(_V[:48])]), r"person 1 \(id 11\) in .* 17 .* got 16"),
    (_coco([_annotation([10, 20, 3] * 17)]), "confidence of keypoint 0 .* must be 0, 1 or 2"),
    (_coco([_annotation([10, 20, 0.7] * 17)]), "must be 0, 1 or 2, COCO's v: got 0.7"),
    (_coco([_annotation("many")]), r"person 0 \(id 11\) in .* got 'many'"),
    (_coco([3]), "annotations in .* must be a list of objects: got int at entry 0"),
    (_coco({}), "annotations in .* must be a list: got dict"),
    (_coco([], images=3), "images in .* must be a list: got int"),
    (
        _coco([], images=[{"id": 1, "width": -5}]),
        "width of image 0 in .* 1 or more: got -5",
    ),
    (_coco([], categories=[3]), "categories in .* got int at entry 0"),
    (_coco([{"id": 1, "bbox": [1, 2, 3, 4]}]), "got 1 annotations without any; COCO's are in"),
    ([{"bbox": [1, 2, 3, 4]}], "got a list of 1 objects without keypoints"),
    ([3], "got int at entry 0"),
    ([{"keypoints": [1.0] * 50}], "person 0 in .* got 50 numbers"),
    ([{"keypoints": [1.0] * 51, "score": "high"}], "score of person 0 in .* must be a number"),
]


@pytest.mark.parametrize(("content", "message"), _BAD, ids=range(len(_BAD)))
def test_a_bad_file_says_what_is_wrong_with_it(tmp_path, content, message):
    path = _written(tmp_path, content, "broken.json")
    with pytest.raises(ValueError, match=message) as caught:
        read_keypoints(path)
    assert "broken.json" in str(caught.value)


def test_bad_archives_and_paths_are_named(tmp_path):
    path = tmp_path / "broken.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match=r"must be an \.npz archive: got .*broken\.npz"):
        read_keypoints(path)
    points = np.zeros((17, 2))
    for arrays, message in [
        ({"joints": points}, "must hold keypoints, .* got joints"),
        ({"keypoints": np.zeros(17)}, r"must have shape .* got \(17,\)"),
        ({"keypoints": np.array([["a", "b"]])}, "must be real numbers: got dtype <U1"),
        ({"keypoints": np.array([[None, 1]])}, "is an object array"),
        ({"keypoints": points, "confidence": np.ones(16)}, "one number a keypoint"),
        ({"keypoints": points, "layout": 3}, "layout in .* must be a name: got 3"),
        ({"keypoints": points}, "needs a layout"),
        ({"keypoints": points + np.nan, "layout": "coco17"}, "x of keypoint 0 .* finite: got nan"),
    ]:
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=message) as caught:
            read_keypoints(path)
        assert "broken.npz" in str(caught.value)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"must be an \.npz archive: got .*broken\.npz"):
        read_keypoints(path)
    with pytest.raises(FileNotFoundError, match="check the spelling"):
        read_keypoints(tmp_path / "none.json")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"a folder of \.json files: got none"):
        read_keypoints(tmp_path / "empty")
    (tmp_path / "binary.json").write_bytes(b"\x80\x04\x95\xff")
    with pytest.raises(ValueError, match="bytes that are no text at position 0"):
        read_keypoints(tmp_path / "binary.json")
    good = _written(tmp_path, _own(_GOOD))
    with pytest.raises(ValueError, match="layout body25 has 25 keypoints: got 17"):
        read_keypoints(good, layout="body25")


_leaves = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
_trees = st.recursive(
    _leaves,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                [
                    *("people", "points", "annotations", "images", "categories", "keypoints"),
                    *("pose_keypoints_2d", "layout", "width", "id", "image_id", "person_id"),
                ]
            ),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


def _read_or_refused(folder, content):
    path = _written(folder, content, "any.json")
    try:
        file = read_keypoints(path)
    except ValueError as error:
        assert "any.json" in str(error)
    else:
        assert all(person.confidence.any() for person in file.people)
        assert all(np.isfinite(person.points).all() for person in file.people)


@settings(max_examples=60)
@given(_trees)
def test_any_json_is_read_or_refused_by_name(tmp_path_factory, content):
    _read_or_refused(tmp_path_factory.getbasetemp(), content)


@settings(max_examples=150)
@given(st.integers(0, 3), st.lists(st.integers(0, 5), max_size=5), _trees)
def test_a_good_file_with_one_part_replaced_is_read_or_refused(tmp_path_factory, kind, way, part):
    good = [_own(_GOOD, _GOOD), _body25(0.5), _coco([_annotation(_V)] * 2), [_annotation(_V)] * 2]
    content = node = copy.deepcopy(good[kind])
    for step in way:
        key = sorted(node)[step % len(node)] if isinstance(node, dict) else step % len(node)
        if not isinstance(node[key], (dict, list)) or not node[key]:
            break
        node = node[key]
    if node:
        key = sorted(node)[0] if isinstance(node, dict) else 0
        node[key] = part
    _read_or_refused(tmp_path_factory.getbasetemp(), content)
