"""Animated .glb files: what a player makes of them is the body in each frame."""

import json
import struct

import numpy as np
import pytest
from helpers_motion import snap, tongs
from scipy.spatial.transform import Rotation

from spt_jax.show.animation import Figure, before_and_after, write_animation

_TYPES = {5126: ("<f4", 4), 5123: ("<u2", 2), 5125: ("<u4", 4)}
_WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read(path):
    content = path.read_bytes()
    size = struct.unpack("<I", content[12:16])[0]
    assert struct.unpack("<I", content[8:12])[0] == len(content)
    text, binary = json.loads(content[20 : 20 + size]), content[28 + size :]

    def array(k):
        one = text["accessors"][k]
        view = text["bufferViews"][one["bufferView"]]
        dtype, width = _TYPES[one["componentType"]][0], _WIDTH[one["type"]]
        data = np.frombuffer(binary, dtype, one["count"] * width, view["byteOffset"])
        return data.reshape(one["count"], width)

    return text, array


def played(text, array, mesh_node, frame):
    """The vertices that a player shows, by the specification's own formulas."""
    nodes, local = text["nodes"], {}
    for k, node in enumerate(nodes):
        local[k] = [np.array(node.get("translation", [0, 0, 0]), float), Rotation.identity()]
    animation = text["animations"][0]
    for channel in animation["channels"]:
        values = array(animation["samplers"][channel["sampler"]]["output"])[frame]
        at = channel["target"]["node"]
        if channel["target"]["path"] == "rotation":
            local[at][1] = Rotation.from_quat(values)
        else:
            local[at][0] = values.astype(float)
    world = {}

    def walk(k, above):
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = local[k][1].as_matrix(), local[k][0]
        world[k] = above @ own
        for child in nodes[k].get("children", []):
            walk(child, world[k])

    for k in text["scenes"][0]["nodes"]:
        walk(k, np.eye(4))
    skin = text["skins"][nodes[mesh_node]["skin"]]
    bind = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    matrices = np.stack([world[j] @ b for j, b in zip(skin["joints"], bind, strict=True)])
    attributes = text["meshes"][nodes[mesh_node]["mesh"]]["primitives"][0]["attributes"]
    rest = np.c_[array(attributes["POSITION"]), np.ones(len(array(attributes["POSITION"])))]
    found = np.zeros((len(rest), 3))
    for k in range(2):
        joints, weights = array(attributes[f"JOINTS_{k}"]), array(attributes[f"WEIGHTS_{k}"])
        for j in range(4):
            moved = np.einsum("vab,vb->va", matrices[joints[:, j]], rest)[:, :3]
            found += weights[:, j : j + 1] * moved
    return found


def test_a_player_shows_the_body_in_each_frame(tmp_path):
    body, pose = tongs(), snap()[15:25]
    places = np.linspace(0, 1, 30, dtype=np.float32).reshape(10, 3)
    figures = before_and_after(pose, 0.5 * pose, translation=places, aside=(1.5, 0, 0))
    write_animation(tmp_path / "a.glb", body, figures, 60.0)
    text, array = read(tmp_path / "a.glb")
    meshes = [k for k, node in enumerate(text["nodes"]) if "mesh" in node]
    assert [text["meshes"][text["nodes"][k]["mesh"]]["name"] for k in meshes] == ["before", "after"]
    for node, poses, aside in zip(meshes, (pose, 0.5 * pose), (0.0, 1.5), strict=True):
        for frame in (0, 6, 9):
            known = np.asarray(body(poses[frame], translation=places[frame]).vertices)
            shown = played(text, array, node, frame)
            np.testing.assert_allclose(shown, known + np.array([aside, 0, 0]), atol=1e-5)
    clock = array(text["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(np.diff(clock), 1 / 60, rtol=1e-4)


def test_quaternions_do_not_jump(tmp_path):
    pose = np.zeros((40, 3, 3))
    pose[:, 1, 2] = np.linspace(0, 7, 40)  # more than once around
    write_animation(tmp_path / "turn.glb", tongs(), [Figure("turn", pose)])
    text, array = read(tmp_path / "turn.glb")
    animation = text["animations"][0]
    for channel in animation["channels"]:
        turns = array(animation["samplers"][channel["sampler"]]["output"])
        assert (np.sum(turns[1:] * turns[:-1], axis=1) > 0.9).all()


def test_people_get_figures_of_their_own():
    pose, places = np.zeros((5, 2, 3, 3)), np.ones((5, 2, 3))
    shape = np.arange(10.0).reshape(5, 2, 1)
    found = before_and_after(pose, pose, shape=shape, translation=places)
    assert [figure.name for figure in found] == ["before 0", "before 1", "after 0", "after 1"]
    assert [float(figure.shape[0]) for figure in found] == [0, 1, 0, 1]


def test_what_cannot_be_played_is_refused(tmp_path):
    body, pose = tongs(), snap()
    for figures in ([], [Figure("a", pose), Figure("b", pose[:3])], [Figure("a", pose[:0])]):
        with pytest.raises(ValueError, match="same number of frames"):
            write_animation(tmp_path / "no.glb", body, figures)
    with pytest.raises(ValueError, match="positive"):
        write_animation(tmp_path / "no.glb", body, [Figure("a", pose)], 0.0)
    assert not list(tmp_path.iterdir())
