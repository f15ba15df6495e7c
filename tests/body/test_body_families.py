"""MANO, FLAME, SMAL, STAR and SUPR on synthetic files, against slow references of the formulas."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from helpers_body import (
    slow_body,
    synthetic_hand,
    synthetic_smpl,
    with_parents,
    write_official_pkl,
)

from spt_jax.body import load_body

# By the model: joints, shape components in the file, pose features, and what names it must have.
MODELS = {
    "MANO": (16, 10, 135, {"right_wrist", "right_thumb3"}),
    "FLAME": (5, 400, 36, {"neck", "jaw", "left_eye"}),
    "SMAL": (33, 41, 288, {"left_front_foot", "tail7", "mouth"}),
    "SMAL with ears": (35, 20, 306, {"left_ear", "right_ear"}),
    "STAR": (24, 300, 93, {"left_hip", "right_hand"}),
    "SUPR": (75, 12, 300, {"joint0", "joint74"}),
}


def model_file(folder, rng, name):
    """A synthetic file as the model's authors give it out, its arrays, and its path."""
    joints, components, features, _ = MODELS[name]
    smpl = synthetic_smpl(rng, joints, 20, components, features)
    if name == "MANO":
        smpl |= synthetic_hand(rng)
    if name == "SUPR":
        regressor = rng.normal(size=(225, 61)) / 60
        smpl |= {"J_regressor": regressor}
        np.save(folder / "supr.npy", np.array(smpl, object))
        return (folder / "supr.npy").rename(folder / "SUPR.NPY"), smpl
    if name == "STAR":
        np.savez(folder / "star.npz", **smpl)
        return (folder / "star.npz").rename(folder / "STAR.NPZ"), smpl
    path = folder / {"MANO": "MANO_RIGHT.pkl"}.get(name, "MODEL.PKL")
    with pytest.MonkeyPatch.context() as patch:
        write_official_pkl(path, smpl, patch)
    return path, smpl


@pytest.mark.parametrize("name", list(MODELS))
def test_models_move_as_the_slow_references(tmp_path, rng, x64, name):
    path, smpl = model_file(tmp_path, rng, name)
    body = load_body(path, num_shape=3, num_expression=4)
    assert MODELS[name][3] <= set(body.joint_names)
    pose = rng.normal(scale=0.7, size=(body.num_joints, 3))
    shape, expression = rng.normal(size=3), rng.normal(size=body.num_expression)
    full = shape
    if name == "FLAME":
        assert body.num_expression == 4
        full = np.zeros(400)
        full[:3], full[300:304] = shape, expression
    posed = body(pose, shape, expression=jnp.asarray(expression) if name == "FLAME" else None)
    vertices, joints = slow_body(with_parents(smpl), pose, full, np.zeros(3))
    np.testing.assert_allclose(posed.vertices, vertices, atol=1e-10)
    np.testing.assert_allclose(posed.joints, joints, atol=1e-10)


def test_star_follows_its_second_shape_coefficient(tmp_path, rng, x64):
    path, smpl = model_file(tmp_path, rng, "STAR")
    body = load_body(path)
    rest = np.zeros((24, 3))
    moved = body(rest, np.array([0.0, 1.0])).vertices - body(rest).vertices
    np.testing.assert_allclose(
        moved, smpl["shapedirs"][..., 1] + smpl["posedirs"][..., -1], atol=1e-12
    )


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_hand_without_a_side_in_its_name_points_along_x(tmp_path, rng, side):
    smpl = synthetic_smpl(rng, 16, 16) | synthetic_hand(rng)
    smpl["v_template"][1:, 0] = smpl["v_template"][0, 0] + (1.0 if side == "left" else -1.0)
    smpl["J_regressor"] = np.eye(16)
    np.savez(tmp_path / "hand.npz", **smpl)
    body = load_body(tmp_path / "hand.npz")
    assert body.joint_names[0] == f"{side}_wrist" and body.hands[0].side == side


def test_hand_components_are_those_of_smplx(tmp_path, rng, x64):
    """Romero et al. 2017: the mean and coefficients times components, or those alone."""
    smpl = synthetic_smpl(rng, 55, 9, 20) | synthetic_hand(rng, ("l", "r"))
    np.savez(tmp_path / "model.npz", **smpl)
    body = load_body(tmp_path / "model.npz")
    left, right = rng.normal(size=(7, 6)), rng.normal(size=45)
    pose = rng.normal(size=(55, 3))
    posed = np.asarray(body.with_hands(pose, left, right))
    np.testing.assert_array_equal(posed[:, :25], np.tile(pose[:25], (7, 1, 1)))
    want = smpl["hands_meanl"] + left @ smpl["hands_componentsl"][:6]
    np.testing.assert_allclose(posed[:, 25:40].reshape(7, 45), want, atol=1e-12)
    flat = np.asarray(body.with_hands(pose, right=right, flat=True))
    np.testing.assert_allclose(flat[40:].ravel(), right @ smpl["hands_componentsr"], atol=1e-12)
    np.testing.assert_array_equal(flat[:40], pose[:40])
    with pytest.raises(ValueError, match=r"left must hold 1 to 45 coefficients.*\(7, 46\)"):
        body.with_hands(pose, np.zeros((7, 46)))
    with pytest.raises(ValueError, match=r"right must be None for a body without.*has none"):
        body.replaced({"hands": ()}).with_hands(pose, right=right)


def test_what_a_file_is_stands_in_its_refusal(tmp_path, rng):
    def refused(message, **arrays):
        np.savez(tmp_path / "file.npz", **arrays)
        with pytest.raises(ValueError, match=message):
            load_body(tmp_path / "file.npz")

    refused("a file of poses: load_poses reads it", poses=np.zeros((2, 156)), betas=np.zeros(16))
    refused("a file of shapes", betas=np.zeros(16))
    refused("seems to be a mesh", vertices=np.zeros((3, 3)), faces=np.zeros((1, 3)))
    refused("landmarks, which belong to a model", lmk_faces_idx=np.zeros(51))
    refused("hand components without a body", **synthetic_hand(rng, ("l", "r")))
    refused("This one has apple, pear", pear=np.zeros(1), apple=np.zeros(1))
    refused("got 24 joints and 90 components in posedirs", **synthetic_smpl(rng, features=90))
    smpl = synthetic_smpl(rng, 5, 9)
    refused("with 0 of them", **smpl, **synthetic_hand(rng))
    refused(r"hands_components in .*any, 45.*\(45, 9\)", **smpl, hands_components=np.zeros((45, 9)))
    tree = smpl["kintree_table"].copy()
    tree[0, 2] = 3
    refused("left_eye as the parent of jaw", **(smpl | {"kintree_table": tree}))


def test_dictionaries_in_npy_files_are_read_within_limits(tmp_path, rng):
    path = tmp_path / "supr.npy"
    np.save(path, np.zeros(3))
    with pytest.raises(ValueError, match="got an array of float64"):
        load_body(path)
    path.write_bytes(b"\x93NUMPY\x01\x00\xff\xff")
    with pytest.raises(ValueError, match=r"supr\.npy cannot be read as \.npy"):
        load_body(path)
    lying = scipy.sparse.csc_matrix((2, 2))
    lying._shape = (24, 10**13)
    np.save(path, np.array(synthetic_smpl(rng) | {"J_regressor": lying}, object))
    with pytest.raises(ValueError, match=r"J_regressor .*a sparse matrix of shape"):
        load_body(path)
