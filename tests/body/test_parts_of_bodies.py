"""Hands and heads as MANO and FLAME have them: open, read from files, measured and freed."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import cut_out, smplx_like, synthetic_hand, write_official_pkl

from spt_jax import intersection_report, load_body, untangle_pose
from spt_jax.body import BodyGroup
from spt_jax.body.poses import FINGERS, SMPL_LAYOUTS


def found_in(body, vertices):
    return intersection_report(vertices, body.faces, rest_surface=body.rest_surface)


def written(path, smpl):
    with pytest.MonkeyPatch.context() as patch:
        write_official_pkl(path, smpl, patch)
    return path


@pytest.fixture(scope="module")
def whole():
    return smplx_like()


@pytest.fixture(scope="module")
def hand(whole, tmp_path_factory):
    names = ("left_wrist", *(name for name in FINGERS if name.startswith("left")))
    smpl = cut_out(whole, SMPL_LAYOUTS[55], names) | synthetic_hand(np.random.default_rng(0))
    # The first component bends all fingers, the second one the thumb towards the palm.
    smpl["hands_components"][:2] = 0.0
    smpl["hands_components"][0, 2:36:3] = -1.4
    smpl["hands_mean"][:] = 0.0
    path = written(tmp_path_factory.mktemp("mano") / "MANO_LEFT.pkl", smpl)
    with pytest.warns(UserWarning, match=r"MANO_LEFT\.pkl has 1 hole of \d\d edges"):
        return load_body(path, dtype="float32")


def test_a_hand_of_mano_is_a_body(hand):
    assert hand.joint_names[0] == "left_wrist" and hand.num_joints == 16
    report = found_in(hand, hand.template)
    assert report.is_free and report.solid_volume > 2e-4 and len(report.holes) == 1
    fist = hand.with_hands(jnp.zeros((16, 3), jnp.float32), left=jnp.ones(1, jnp.float32))
    assert found_in(hand, hand(fist).vertices).intersecting_pairs > 100


@pytest.mark.long
def test_a_fist_through_the_palm_is_freed(hand):
    fist = hand.with_hands(jnp.zeros((16, 3), jnp.float32), left=jnp.ones(1, jnp.float32))
    result = untangle_pose(hand, fist)
    assert bool(result.is_free) and found_in(hand, result.vertices).is_free
    moved = np.linalg.norm(np.asarray(result.vertices - hand(fist).vertices), axis=1)
    assert moved.max() < 0.04


@pytest.mark.long
def test_two_hands_in_a_scene_are_freed_of_each_other(hand):
    pair, poses = BodyGroup(hand, 2), np.zeros((2, 16, 3), np.float32)
    poses[1, 0] = 0.0, np.pi, 0.0  # fingers towards fingers
    wrist, tip = hand.joint_template[0], np.asarray(hand.template)[:, 0].max()
    away = np.array([2 * (tip - float(wrist[0])) - 0.06, 0.0, 0.0])
    pose = pair.pose_of(poses, np.stack([np.zeros(3), away]).astype(np.float32))
    before = found_in(pair, pair(pose).vertices)
    result = untangle_pose(pair, pose)
    assert before.intersecting_pairs > 20 and bool(result.is_free)


def test_a_head_of_flame_is_a_body(whole, tmp_path):
    joints = ("head", "jaw", "left_eye", "right_eye")
    smpl = cut_out(whole, SMPL_LAYOUTS[55], joints)
    # FLAME's neck stands between the head's root and the others.
    smpl["weights"] = np.insert(smpl["weights"], 1, 0.0, axis=1)
    smpl["J_regressor"] = np.insert(smpl["J_regressor"], 1, smpl["J_regressor"][0], axis=0)
    smpl["kintree_table"] = np.array([[2**32 - 1, 0, 1, 1, 1], range(5)], np.int64).astype(
        np.uint32
    )
    np.savez(tmp_path / "FLAME.npz", **smpl)
    with pytest.warns(UserWarning, match=r"FLAME\.npz has 2 holes"):
        head = load_body(tmp_path / "FLAME.npz", dtype="float32")
    assert head.joint_names == ("head", "neck", "jaw", "left_eye", "right_eye")
    report = found_in(head, head.template)
    assert report.is_free and len(report.holes) == 2 and max(h.size for h in report.holes) < 0.3
    pose = np.zeros((5, 3), np.float32)
    pose[3:] = 0.3, -0.4, 0.0
    assert found_in(head, head(pose).vertices).is_free


def test_a_left_and_a_right_hand_are_a_group(hand):
    mirror = np.array([-1.0, 1.0, 1.0], np.float32)
    right = hand.replaced(
        {
            "template": jnp.asarray(np.asarray(hand.template) * mirror),
            "joint_template": jnp.asarray(np.asarray(hand.joint_template) * mirror),
            "faces": hand.faces[:, ::-1],
            "joint_names": tuple(name.replace("left", "right") for name in hand.joint_names),
            "hands": (),
            "pose_basis": None,
        }
    )
    left = hand.replaced({"hands": (), "pose_basis": None})
    pair = BodyGroup([left, right])
    rng = np.random.default_rng(5)
    poses = rng.normal(scale=0.2, size=(3, 2, 16, 3)).astype(np.float32)
    places = rng.normal(size=(3, 2, 3)).astype(np.float32)
    posed = pair(pair.pose_of(poses, places))
    own = [one(poses[:, k], None, places[:, k]) for k, one in enumerate((left, right))]
    np.testing.assert_allclose(
        posed.vertices, np.concatenate([one.vertices for one in own], axis=1), atol=1e-6
    )
    # A mirrored pose is that of the mirrored hand.
    other = right(poses[:, 0] * np.array([1, -1, -1], np.float32)).vertices
    np.testing.assert_allclose(other, np.asarray(left(poses[:, 0]).vertices) * mirror, atol=1e-5)
    assert pair.joint_names[0] != pair.joint_names[16] and pair.joint_names[16][0] == "1"
    assert pair.parents[16] == -1 and pair.weights.shape == (pair.num_vertices, 32)
    apart = pair(
        pair.pose_of(np.zeros((2, 16, 3), np.float32), np.float32([[0, 0, 0], [1, 0, 0]]))
    ).vertices
    report = found_in(pair, apart)
    assert report.is_free and report.solid_volume > 0 and len(report.holes) == 2
    some = pair.at_vertices([3, 5])
    np.testing.assert_allclose(
        some(pair.pose_of(poses, places)).vertices[:, 2], own[1].vertices[:, 3], atol=1e-6
    )
    assert [one.bodies for one, _, _ in pair.alone(np.zeros((34, 3)), None)] == [(left,), (right,)]
    with pytest.raises(ValueError, match="same numbers of joints"):
        BodyGroup([left, left.at_vertices([1])])
    with pytest.raises(TypeError, match="a list of bodies without: got one body"):
        BodyGroup(left)
