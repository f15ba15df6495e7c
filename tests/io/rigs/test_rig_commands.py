"""Rigs on the command line and in the live view."""

import json

import numpy as np
import pytest
from helpers_rigs import RigWriter, quaternion, tube

from spt_jax import untangle_motion
from spt_jax.cli import main as cli
from spt_jax.io import load_poses, load_rig
from spt_jax.io.poses.bvh_tree import parse_bvh
from spt_jax.view import files


@pytest.fixture(scope="module")
def snake(tmp_path_factory):
    """A tube of five links that an animation curls into itself, in centimetres of its own node."""
    w = RigWriter()
    points, faces = tube(41, 10, radius=6.0, height=200.0, seam=False)
    along = np.clip(points[:, 1] / 40 - 0.5, 0, 4)
    low = np.minimum(along.astype(int), 3)
    share = np.clip((along - low - 0.5) / 0.3 + 0.5, 0, 1)
    joints = np.stack([low, low + 1, 0 * low, 0 * low], axis=1)
    weights = np.stack([1 - share, share, 0 * share, 0 * share], axis=1)
    joints[weights == 0] = 0
    nodes = [
        {"name": f"link {k}", "translation": [0, 40, 0], "children": [k + 1]} for k in range(5)
    ]
    nodes[0]["translation"], nodes[4] = [0, 0, 0], {"name": "link 4", "translation": [0, 40, 0]}
    nodes += [{"name": "snake", "scale": [0.01] * 3, "children": [0, 6]}]
    nodes += [{"name": "skin", "mesh": 0, "skin": 0}]
    bind = np.tile(np.eye(4), (5, 1, 1))
    bind[:, :3, :3] *= 100
    bind[:, 1, 3] = -40 * np.arange(5)
    attributes = {
        "POSITION": w.accessor(points / 100, "VEC3"),
        "JOINTS_0": w.accessor(joints, "VEC4", 5121),
        "WEIGHTS_0": w.accessor(weights, "VEC4"),
    }
    indices = w.accessor(faces.ravel(), "SCALAR", 5123)
    skin = {"joints": list(range(5))}
    skin["inverseBindMatrices"] = w.accessor(bind.transpose(0, 2, 1), "MAT4")
    times = w.accessor([0, 1 / 24, 2 / 24], "SCALAR")
    turns = w.accessor([quaternion([0, 0, 1], a) for a in (0.0, 1.55, 1.75)], "VEC4")
    channel = {"input": times, "output": turns, "interpolation": "LINEAR"}
    w.tree |= {
        "scene": 0,
        "scenes": [{"nodes": [5]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices}]}],
        "skins": [skin],
        "animations": [
            {
                "name": "curl",
                "samplers": [channel],
                "channels": [
                    {"sampler": 0, "target": {"node": k, "path": "rotation"}} for k in range(1, 5)
                ],
            }
        ],
    }
    path = tmp_path_factory.mktemp("snake") / "snake.glb"
    path.write_bytes(w.content())
    return path


@pytest.mark.slow
def test_untangle_writes_the_animation_back(snake, tmp_path, capsys):
    assert cli.main(["untangle", str(snake), "--out", str(tmp_path), "--json", "--quiet"]) == 0
    report = json.loads(capsys.readouterr().out)
    names = [frame["name"] for frame in report["frames"]]
    assert names == ["curl/0000", "curl/0001", "curl/0002"]
    assert report["frames"][2]["before"]["intersecting_pairs"] > 0
    assert all(frame["is_free"] for frame in report["frames"])
    assert report["files"] == ["snake_untangled.glb", "poses.npz", "curl.bvh"]
    rig, freed = load_rig(snake), load_rig(tmp_path / "snake_untangled.glb")
    assert rig.notes == () and freed.animations == ("curl", "curl untangled")
    before, after = rig.clip("curl"), freed.clip("curl untangled")
    np.testing.assert_allclose(after.pose[0], before.pose[0], atol=1e-6)
    assert 0.01 < np.abs(after.pose - before.pose).max() < 2.0
    with np.load(tmp_path / "poses.npz") as arrays:
        np.testing.assert_allclose(arrays["poses"].reshape(3, 5, 3), after.pose, atol=1e-5)
        assert arrays["joint_names"].tolist() == [f"link {k}" for k in range(5)]
        assert arrays["mocap_framerate"] == 24
    # BVH, followed joint by joint, puts the last link where the rig has it.
    tree = parse_bvh((tmp_path / "curl.bvh").read_bytes(), tmp_path / "curl.bvh")
    want = np.asarray(freed.body(after.pose.astype(np.float32)).joints)
    for row, places in zip(tree["motion"], want, strict=True):
        np.testing.assert_allclose(_bvh_places(tree, row), places, atol=1e-5)


def _bvh_places(tree, row):
    def about(axis, degrees):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        a, b = [k for k in range(3) if k != axis]
        turn = np.eye(3)
        sign = -1 if axis == 1 else 1
        turn[a, a] = turn[b, b] = c
        turn[a, b], turn[b, a] = -sign * s, sign * s
        return turn

    turns, places, found = {}, {}, []
    for k, joint in enumerate(tree["joints"]):
        above = turns.get(joint.parent, np.eye(3))
        offset = np.array(joint.offset)
        if joint.parent < 0:
            offset = row[:3]
        places[k] = places.get(joint.parent, np.zeros(3)) + above @ offset
        values = row[joint.column + (3 if joint.parent < 0 else 0) :][:3]
        if joint.channels:
            z, x, y = values
            turns[k] = above @ about(2, z) @ about(0, x) @ about(1, y)
            found.append(places[k])
    return np.array(found)


def test_frames_and_characters_are_chosen(snake, tmp_path, capsys):
    asked = ["untangle", str(snake), "--out", str(tmp_path), "--quiet"]
    assert cli.main([*asked, "--people", "nobody"]) == 2
    assert "characters 'snake'" in capsys.readouterr().err
    assert cli.main([*asked, "--like-input"]) == 2
    assert "leave it out" in capsys.readouterr().err
    assert cli.main([*asked, "--people", "snake", "--frames", "curl/0000", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["frames"]) == 1
    # Nothing turned: the animation that is written is the one that was there.
    freed = load_rig(tmp_path / "snake_untangled.glb")
    np.testing.assert_allclose(freed.clip(1).pose, freed.clip(0).pose, atol=1e-6)


@pytest.mark.long
def test_a_motion_of_a_rig_is_freed_as_a_whole(snake):
    rig = load_rig(snake, dtype=np.float32)
    clip = rig.clip("curl")
    found = untangle_motion(
        rig.body,
        clip.pose.astype(np.float32),
        shape=clip.shape.astype(np.float32),
        frames_per_second=clip.frame_rate,
    )
    assert not found.before.is_free.all() and found.after.is_free.all()


def test_a_character_of_virtual_reality_is_one(snake, tmp_path):
    (tmp_path / "snake.vrm").write_bytes(snake.read_bytes())
    rig = load_rig(tmp_path / "snake.vrm")
    assert rig.name == "snake" and rig.write(tmp_path / "b.vrm", rig.clip()) == ("rest untangled",)
    assert load_rig(tmp_path / "b.vrm").animations == ("curl", "rest untangled")


def test_the_view_shows_a_rig_with_its_animations(snake):
    opened = files.open_upload("snake.glb", snake.read_bytes())
    assert isinstance(opened, files.Rigged) and list(opened.motions) == ["rest", "curl"]
    opened.motions["curl"].load_into(opened.scene, 2)
    assert opened.scene.read().intersecting_pairs > 0
    content = files.pose_bytes(opened.scene)
    assert content[:2] == b"PK"


def test_a_bodys_bvh_is_read_back(tmp_path):
    from spt_jax import load_body, load_mocap
    from spt_jax.io import write_bvh

    body = load_body(num_shape=0)
    pose = np.asarray(body.pose_from_smpl(load_mocap().pose[:3]))
    write_bvh(tmp_path / "a.bvh", body, pose, frames_per_second=120.0)
    (track,) = load_poses(tmp_path / "a.bvh")
    assert track.frame_rate == pytest.approx(120)
    np.testing.assert_allclose(track.pose, pose, atol=1e-4)
