"""Damaged rig files: errors with file, field and remedy, before anything is allocated."""

import copy
import re
import tracemalloc

import numpy as np
import pytest
from helpers_rigs import RigWriter, glb, tube, unpacked

from spt_jax.io import load_rig, load_rigs


@pytest.fixture(scope="module")
def good():
    """A tube on two joints, with an animation and a morph target."""
    w = RigWriter()
    points, faces = tube(3, 4, radius=0.1, height=1.0, seam=False)
    weights = np.zeros((len(points), 4))
    weights[:, 0] = 1
    joints = np.zeros((len(points), 4))
    joints[:, 0] = points[:, 1] > 0.4
    attributes = {
        "POSITION": w.accessor(points, "VEC3"),
        "JOINTS_0": w.accessor(joints, "VEC4", 5121),
        "WEIGHTS_0": w.accessor(weights, "VEC4"),
    }
    primitive = {"attributes": attributes, "indices": w.accessor(faces.ravel(), "SCALAR", 5123)}
    primitive["targets"] = [{"POSITION": w.accessor(points, "VEC3")}]
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[1, 1, 3] = -0.4
    skin = {"joints": [0, 1], "inverseBindMatrices": w.accessor(bind.transpose(0, 2, 1), "MAT4")}
    turns = w.accessor([[0, 0, 0, 1], [0, 0, 0.6, 0.8]], "VEC4")
    sampler = {"input": w.accessor([0, 1], "SCALAR"), "output": turns}
    channel = {"sampler": 0, "target": {"node": 1, "path": "rotation"}}
    w.tree |= {
        "nodes": [
            {"name": "a", "children": [1]},
            {"name": "b", "translation": [0, 0.4, 0]},
            {"name": "skin", "mesh": 0, "skin": 0},
        ],
        "meshes": [{"name": "m", "primitives": [primitive]}],
        "skins": [skin],
        "animations": [{"name": "wave", "samplers": [sampler], "channels": [channel]}],
    }
    return w.content()


def accessor_of(tree, attribute):
    return tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][attribute]]


def cyclic(tree):
    tree["nodes"][1]["children"] = [0]


def own_child(tree):
    tree["nodes"][0]["children"] = [0]


def two_parents(tree):
    tree["nodes"][2]["children"] = [1]


def no_such_child(tree):
    tree["nodes"][0]["children"] = [7]


def no_such_joint(tree):
    tree["skins"][0]["joints"] = [0, 9]


def one_joint(tree):
    tree["skins"][0]["joints"] = [0]


def no_such_skin(tree):
    tree["nodes"][2]["skin"] = 4


def no_skin(tree):
    del tree["nodes"][2]["skin"]


def no_weights(tree):
    del tree["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"]


def short_weights(tree):
    accessor_of(tree, "WEIGHTS_0")["count"] -= 1


def points_that_are_no_points(tree):
    accessor_of(tree, "POSITION")["type"] = "VEC4"


def a_bomb(tree):
    accessor_of(tree, "POSITION").update(count=10**12)


def a_hidden_bomb(tree):
    tree["accessors"].append({"componentType": 5126, "type": "MAT4", "count": 2**40})


def beyond_the_view(tree):
    accessor_of(tree, "POSITION")["count"] = 1000


def beyond_the_buffer(tree):
    tree["bufferViews"][0]["byteLength"] = 10**7
    accessor_of(tree, "POSITION")["count"] = 10**4


def a_negative_offset(tree):
    tree["bufferViews"][0]["byteOffset"] = -8


def a_short_quaternion(tree):
    tree["nodes"][1]["rotation"] = [0, 0, 0, 0]


def a_translation_of_words(tree):
    tree["nodes"][1]["translation"] = ["a", 0, 0]


def an_infinite_scale(tree):
    tree["nodes"][1]["scale"] = [1e999, 1, 1]


def an_extension(tree):
    tree["extensionsRequired"] = ["EXT_meshopt_compression"]


def nodes_that_are_words(tree):
    tree["nodes"][0] = "a"


def a_path_of_a_channel(tree):
    tree["animations"][0]["channels"][0]["target"]["path"] = "color"


def times_that_stand_still(tree):
    sampler = tree["animations"][0]["samplers"][0]
    tree["accessors"][sampler["input"]].update(sparse=None)
    del (
        tree["accessors"][sampler["input"]]["sparse"],
        tree["accessors"][sampler["input"]]["bufferView"],
    )


def another_host(tree):
    tree["buffers"][0]["uri"] = "https://example.invalid/a.bin"


def another_folder(tree):
    tree["buffers"][0]["uri"] = "../../etc/passwd"


def an_absolute_path(tree):
    tree["buffers"][0]["uri"] = "/etc/passwd"


SEEN = {
    cyclic: "nodes must be a tree",
    own_child: "nodes must be a tree",
    two_parents: "nodes must be a tree: node 1 is a child of node 0 and of node 2",
    no_such_child: "children of node 0 must be nodes: got 7",
    no_such_joint: r"joints of skin 0 .* must be nodes: got 9",
    one_joint: r"JOINTS_0 of primitive 0 of mesh 0 .* must be from 0 to 0.*got 1 for vertex 4",
    no_such_skin: "the skin of node 2 must be a skin: got 4",
    no_skin: "must have a mesh with a skin: got none; export the armature",
    no_weights: "WEIGHTS_0 of primitive 0 .* is missing",
    short_weights: "WEIGHTS_0 .* must have one element for each of 14 vertices: got 13",
    points_that_are_no_points: "POSITION .* must be a VEC3: got 'VEC4'",
    a_bomb: "must not take more than",
    a_hidden_bomb: "must not take more than",
    beyond_the_view: r"POSITION .* announces 1,000 elements.*12,000 bytes of a view that has",
    beyond_the_buffer: "POSITION .* announces 10,000 elements",
    a_negative_offset: "byteOffset of .* must be a whole number, not negative: got -8",
    a_short_quaternion: r"rotation of node 1 \('b'\) must be a quaternion",
    a_translation_of_words: "translation of node 1 .* must be 3 finite numbers",
    an_infinite_scale: "scale of node 1 .* must be 3 finite numbers",
    an_extension: "needs EXT_meshopt_compression; export it without",
    nodes_that_are_words: "whose JSON is not as glTF",
    a_path_of_a_channel: "path of channel 0 of animation 0 .* must be one of translation",
    times_that_stand_still: "input of channel 0 .* must be times that rise",
    another_host: "buffer 0 must lie beside it: got 'https",
    another_folder: "buffer 0 must lie beside it",
    an_absolute_path: "buffer 0 must lie beside it",
}


@pytest.mark.parametrize("damage", SEEN, ids=lambda damage: damage.__name__)
def test_damage_is_named(good, damage, tmp_path):
    tree, (data,) = unpacked(good)
    damage(tree)
    text = glb(tree, data).replace(b"Infinity", b"1e999   ")
    (tmp_path / "bad.glb").write_bytes(text)
    tracemalloc.start()
    with pytest.raises(ValueError, match=SEEN[damage]) as error:
        load_rig(tmp_path / "bad.glb")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1e7
    assert "bad.glb" in str(error.value)


@pytest.mark.parametrize("where", ["NaN", "weights", "negative", "indices", "time"])
def test_numbers_that_cannot_be(good, where, tmp_path):
    tree, (data,) = unpacked(good)
    data = bytearray(data)
    primitive = tree["meshes"][0]["primitives"][0]
    sampler = tree["animations"][0]["samplers"][0]
    accessor, value, seen = {
        "NaN": (primitive["attributes"]["POSITION"], np.float32(np.nan), "POSITION .* finite"),
        "weights": (
            primitive["attributes"]["WEIGHTS_0"],
            np.float32(0.7),
            r"WEIGHTS .* sum to 1 for each vertex: got 0.7000 for vertex 0; normalize",
        ),
        "negative": (
            primitive["attributes"]["WEIGHTS_0"],
            np.float32(-0.5),
            "must not be negative: got -0.5 for vertex 0",
        ),
        "indices": (primitive["indices"], np.uint16(700), "from 0 to 13, its vertices: got 700"),
        "time": (sampler["input"], np.float32(5), "times that rise"),
    }[where]
    start = tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["byteOffset"]
    data[start : start + value.nbytes] = value.tobytes()
    (tmp_path / "bad.glb").write_bytes(glb(tree, bytes(data)))
    with pytest.raises(ValueError, match=seen):
        load_rig(tmp_path / "bad.glb")


def test_a_file_cut_anywhere_is_an_error_and_never_another_one(good, tmp_path):
    path = tmp_path / "cut.glb"
    for length in [*range(0, 60, 5), *range(60, len(good), 97)]:
        path.write_bytes(good[:length])
        with pytest.raises(ValueError, match=re.escape("cut.glb")):
            load_rig(path)


def test_flipped_bytes_are_read_or_refused(good, tmp_path, rng):
    path, read = tmp_path / "flipped.glb", 0
    for _ in range(150):
        content = bytearray(good)
        for place in rng.integers(12, len(content), 3):
            content[place] = rng.integers(256)
        path.write_bytes(content)
        try:
            read += bool(load_rigs(path))
        except ValueError as error:
            assert "flipped.glb" in str(error)
    assert read > 0


def test_buffers_beside_a_gltf_are_read_and_put_into_what_is_written(good, tmp_path):
    import json

    tree, (data,) = unpacked(good)
    tree = copy.deepcopy(tree)
    tree["buffers"][0]["uri"] = "with%20space.bin"
    tree["images"] = [{"uri": "skin.png"}, {"uri": "lost.png"}]
    (tmp_path / "with space.bin").write_bytes(data)
    (tmp_path / "skin.png").write_bytes(b"\x89PNG")
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    rig = load_rig(tmp_path / "a.gltf")
    (tmp_path / "b").mkdir()
    rig.write(tmp_path / "b" / "a.glb", rig.clip("wave"))
    after, (more,) = unpacked((tmp_path / "b" / "a.glb").read_bytes())
    assert after["buffers"] == [{"byteLength": len(more)}] and more.startswith(data)
    assert after["images"][0]["mimeType"] == "image/png" and after["images"][1] == {
        "uri": "lost.png"
    }
    again = load_rig(tmp_path / "b" / "a.glb")
    np.testing.assert_allclose(again.clip(1).pose, rig.clip(0).pose, atol=1e-6)


def test_what_is_asked_for_must_be_there(good, tmp_path):
    path = tmp_path / "good.glb"
    path.write_bytes(good)
    rig = load_rig(path)
    with pytest.raises(ValueError, match=r"'wave'.*got 'walk'"):
        rig.clip("walk")
    with pytest.raises(ValueError, match=r"must end in \.glb"):
        rig.write(tmp_path / "a.fbx", rig.clip())
    with pytest.raises(ValueError, match="must have shape"):
        rig.clip().with_pose(np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match="character must be one of 'skin'"):
        load_rig(path, "nobody")
    with pytest.raises(ValueError, match="suffixes"):
        load_rig(__file__)
    with pytest.raises(ValueError, match="must not take more"):
        load_rig(path, max_bytes=1000)
