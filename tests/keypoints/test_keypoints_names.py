"""Keypoints by their names, in the words of many data sets, and the files that name them."""

import csv
import io
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spt_jax.keypoints import LAYOUTS, as_layout, read_keypoints
from spt_jax.keypoints.vocabulary import known_name, layout_of, places_of

PLACED = {
    name: [k for k, point in enumerate(layout.points) if point] for name, layout in LAYOUTS.items()
}
# Lists in which a word means what it does not mean elsewhere: they are known as a whole.
OWN_WORDS = ("halpe26", "halpe136", "jhmdb15", "mediapipe33", "h36m17", "smpl24")


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_official_list_is_known_as_a_whole(name):
    layout = LAYOUTS[name]
    for names in (layout.names, layout.official):
        assert LAYOUTS[layout_of(names)].names == layout.names


@pytest.mark.parametrize("name", sorted(set(LAYOUTS) - set(OWN_WORDS)))
def test_every_official_word_is_known_alone(name):
    layout = LAYOUTS[name]
    for k in PLACED[name]:
        assert known_name(layout.official[k]) == layout.names[k]
        assert known_name(layout.names[k]) == layout.names[k]


@pytest.mark.parametrize(
    ("word", "name"),
    [
        *(("LShoulder", "left_shoulder"), ("lsho", "left_shoulder"), ("l_shldr", "left_shoulder")),
        *(("Right Elbow", "right_elbow"), ("elbow_r", "right_elbow"), ("relb", "right_elbow")),
        *(("rWrist", "right_wrist"), ("wrist-left", "left_wrist"), ("ankleR", "right_ankle")),
        *(("MidHip", "pelvis"), ("root", "pelvis"), ("head_bottom", "upper_neck")),
        *(("top_head", "head_top"), ("Head top", "head_top"), ("belly", "spine")),
        *(("INDEX_FINGER_MCP", None), ("left_index_finger_mcp", "left_index1")),
        *(("right_thumb_ip", "right_thumb3"), ("left_pinky_finger4", "left_pinky_tip")),
        *(("left_foot_index", "left_big_toe"), ("tail", None), ("", None), ("left", None)),
    ],
)
def test_words_of_data_sets(word, name):
    assert known_name(word) == name


def test_a_foot_is_an_ankle_where_no_ankle_is():
    assert places_of(["left_knee", "left_foot"]) == ("left_knee", "left_ankle")
    assert places_of(["left_ankle", "left_foot"]) == ("left_ankle", "left_foot")


def test_a_layout_is_a_list_of_names_too():
    layout = as_layout("LWri, Neck,left_knee,right_hip", 4)
    assert layout.names == ("left_wrist", "neck", "left_knee", "right_hip")
    assert layout.points == ("left_wrist", "between_shoulders", "left_knee", "right_wide_hip")
    for wrong, message in (
        ("left_wrist,tail", "that are known: got 'tail'"),
        ("lwri,left_wrist", "different names: got 'lwri' and 'left_wrist', both left_wrist"),
        ("tails", "or a list of keypoints with commas between them: got 'tails'"),
    ):
        with pytest.raises(ValueError, match=message):
            as_layout(wrong)


NAMES = ("tail_base", "lpaw", "Nose", "RKnee")
POINTS = np.random.default_rng(5).uniform(2, 500, (3, 4, 2)).round(2)
TRUST = np.random.default_rng(6).uniform(0.1, 1, (3, 4)).round(3)


def table(individuals=None, likelihood=True, index=1):
    """What DeepLabCut writes, for one or several animals."""
    coords = ("x", "y", "likelihood") if likelihood else ("x", "y")
    who = individuals or [None]
    rows = [["scorer"] + [""] * (index - 1) + ["DLC"] * len(coords) * len(NAMES) * len(who)]
    if individuals:
        rows.append(
            ["individuals"]
            + [""] * (index - 1)
            + [one for one in who for _ in NAMES for _ in coords]
        )
    rows.append(
        ["bodyparts"] + [""] * (index - 1) + [n for _ in who for n in NAMES for _ in coords]
    )
    rows.append(["coords"] + [""] * (index - 1) + list(coords) * len(NAMES) * len(who))
    for frame in range(3):
        cells = [str(frame)] if index == 1 else ["labeled-data", "walk", f"img{frame:03d}.png"]
        for _ in who:
            for point, trust in zip(POINTS[frame], TRUST[frame], strict=True):
                cells += [*map(str, point), str(trust)][: len(coords)]
        rows.append(cells)
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()


def read(folder, content, name="points.json", **options):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_keypoints(path, **options)


UNKNOWN = "keypoints of unknown names, which are not used (tail_base, lpaw): 2"


@pytest.mark.parametrize("individuals", [None, ["anna", "ben"]])
def test_a_table_of_deeplabcuts(individuals, tmp_path):
    file = read(tmp_path, table(individuals), "points.csv")
    assert file.notes == (UNKNOWN,)
    assert [one.image for one in file.people] == [k for k in range(3) for _ in individuals or [0]]
    assert [one.id for one in file.people] == (individuals or [None]) * 3
    for one in file.people:
        assert one.layout == "nose,right_knee"
        np.testing.assert_array_equal(one.points, POINTS[one.image][2:])
        np.testing.assert_array_equal(one.confidence, TRUST[one.image][2:])


def test_a_map_says_what_other_names_mean(tmp_path):
    said = {"left_wrist": "lpaw", "pelvis": "tail_base"}
    file = read(tmp_path, table(), "points.csv", map=said)
    assert file.notes == () and file.people[0].layout == "pelvis,left_wrist,nose,right_knee"
    np.testing.assert_array_equal(file.people[2].points, POINTS[2])
    for wrong, message in (
        ({"left_paw": "lpaw"}, "map must give names of keypoints .* got 'left_paw'"),
        ({"left_wrist": "rpaw"}, "map must name keypoints of the file: got 'rpaw'; it has tail"),
        ({"nose": "lpaw"}, "different names: got 'lpaw' and 'Nose', both nose"),
    ):
        with pytest.raises(ValueError, match=rf"points\.csv: .*{message}"):
            read(tmp_path, table(), "points.csv", map=wrong)
    with pytest.raises(ValueError, match="map must be left out where a layout is given"):
        read(tmp_path, table(), "points.csv", map=said, layout="coco17")


def test_labels_without_likelihood_and_with_gaps(tmp_path):
    text = table(likelihood=False, index=3).replace(str(POINTS[1, 2, 0]), "")
    file = read(tmp_path, text, "points.csv")
    assert file.people[0].image == "labeled-data/walk/img000.png"
    assert file.people[0].confidence.tolist() == [1, 1]
    assert file.people[1].confidence.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("bodyparts", "parts"), "rows that begin with scorer, bodyparts"),
        (lambda text: "a,b\n1,2\n", "must be a table of DeepLabCut's.*got"),
        (
            lambda text: text.replace(str(POINTS[1, 2, 0]), "left"),
            "row 1 of .* hold numbers: got 'left'",
        ),
        (lambda text: text[: text.rindex(",")] + "\n", "row 2 of .* must have 13 columns: got 12"),
        (lambda text: text[:-3], "must end with the end of a line: got .*; it is cut, or"),
        (lambda text: text.replace(",y,", ",v,"), "must have x and y of"),
        (lambda text: text.replace(str(TRUST[0, 3]), "95"), "at most 20 in size: got 95"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(change, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, change(table()), "points.csv")


def rows(count, seed=7):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(2, 500, (count, 2)), rng.uniform(0.1, 1, (count, 1))], 1)


def alphapose(form):
    """Two images and three people, in OpenPose's order as AlphaPose writes it."""
    listed, key = {"cmu": ("bodies", "joints"), "open": ("people", "pose_keypoints_2d")}[form]
    flat = [rows(18, seed).ravel().tolist() for seed in (1, 2, 3)]
    frames = {"a.jpg": flat[:2], "b.jpg": flat[2:]}
    return {
        image: {"version": "AlphaPose v0.3", listed: [{key: one} for one in people]}
        for image, people in frames.items()
    }


@pytest.mark.parametrize("form", ["cmu", "open"])
def test_the_forms_of_alphapose(form, tmp_path):
    file = read(tmp_path, alphapose(form))
    assert [one.image for one in file.people] == ["a.jpg", "a.jpg", "b.jpg"] and file.notes == ()
    for one, seed in zip(file.people, (1, 2, 3), strict=True):
        assert one.layout == "openpose18"
        np.testing.assert_array_equal(one.points, rows(18, seed)[:, :2])
        np.testing.assert_array_equal(one.confidence, rows(18, seed)[:, 2])
    (frame,) = [alphapose(form)["b.jpg"]]
    assert len(read(tmp_path, frame).people) == 1


def test_tracks_keep_their_ids(tmp_path):
    flat = rows(17).ravel().tolist()
    entry = {"image_id": "1.jpg", "keypoints": flat, "score": 2.0}
    content = [
        entry | more for more in ({"idx": [3.0]}, {"idx": 4.0}, {"track_id": 5}, {"id": "x"})
    ]
    assert [one.id for one in read(tmp_path, content).people] == [3, 4, 5, "x"]


def test_mmpose_names_of_any_data_set(tmp_path):
    layout = LAYOUTS["mpii16"]
    names = {str(k): name for k, name in enumerate(layout.official)}
    instances = [
        {"keypoints": rows(16)[:, :2].tolist(), "keypoint_scores": rows(16)[:, 2].tolist()}
    ]
    content = {"meta_info": {"keypoint_id2name": names}, "instance_info": instances}
    assert read(tmp_path, content).people[0].layout == "mpii16"
    video = content | {"instance_info": [{"frame_id": 9, "instances": instances}]}
    assert [(one.layout, one.image) for one in read(tmp_path, video).people] == [("mpii16", 9)]
    # One name that is not the data set's, and it is read name by name.
    names["6"] = "navel"
    file = read(tmp_path, content)
    assert file.notes == ("keypoints of unknown names, which are not used (navel): 1",)
    assert file.people[0].layout == ",".join(n for n in layout.names if n != "pelvis")
    np.testing.assert_array_equal(file.people[0].points, np.delete(rows(16)[:, :2], 6, axis=0))


def test_names_in_files_of_our_own(tmp_path):
    content = {"names": ["Nose", "LWri"], "people": [[[5, 6, 0.5], [7, 8, 1]]]}
    (one,) = read(tmp_path, content).people
    assert one.layout == "nose,left_wrist" and one.points.tolist() == [[5, 6], [7, 8]]
    np.savez(tmp_path / "a.npz", keypoints=np.full((1, 2, 3), 0.5) + 3, names=["Nose", "LWri"])
    assert read_keypoints(tmp_path / "a.npz", map={"left_ear": "LWri"}).people[0].layout == (
        "nose,left_ear"
    )
    with pytest.raises(ValueError, match=r"must name its keypoints by strings: got \[1, 2\]"):
        read(tmp_path, content | {"names": [1, 2]})
    with pytest.raises(ValueError, match=r"keypoints that are known: got .* with a map, such as"):
        read(tmp_path, content | {"names": ["tail", "fin"]})


GOOD = {
    "points.csv": table(["anna", "ben"]),
    "cmu.json": json.dumps(alphapose("cmu")),
    "named.json": json.dumps({"names": list(NAMES), "people": [rows(4).tolist()]}),
    "whole.json": json.dumps(
        {
            "people": [
                {
                    "pose_keypoints_2d": rows(25).ravel().tolist(),
                    "hand_left_keypoints_2d": rows(21).ravel().tolist(),
                }
            ]
        }
    ),
}
TRUE = {
    (round(float(x), 9), round(float(y), 9), round(float(c), 9))
    for x, y, c in np.concatenate(
        [
            *(np.concatenate([POINTS, TRUST[..., None]], axis=2)),
            *(rows(18, seed) for seed in (1, 2, 3)),
            *(rows(4), rows(25), rows(21)),
        ]
    )
}


@settings(deadline=None, max_examples=120)
@given(st.sampled_from(sorted(GOOD)), st.data())
def test_damaged_files_are_refused_by_name_or_read_as_they_are(tmp_path_factory, name, data):
    """No exception without a name; no point moved, no confidence ignored."""
    text = GOOD[name]
    start = data.draw(st.integers(0, len(text) - 1))
    length = data.draw(st.integers(0, 40))
    put = data.draw(
        st.sampled_from(["", "0", "-1", "1e9", "nan", '"a"', "[]", ",", "\n", "x", "{"])
    )
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_text(text[:start] + put + text[start + length :])
    try:
        people = read_keypoints(path).people
    except ValueError as error:
        assert str(path) in str(error)
        return
    # What was not touched is as it was: all but the numbers at the place of the damage.
    odd = 0
    for one in people:
        for (x, y), c in zip(one.points.tolist(), one.confidence.tolist(), strict=True):
            if c > 0:
                odd += (round(x, 9), round(y, 9), round(c, 9)) not in TRUE
    assert odd <= 3 + length // 3
