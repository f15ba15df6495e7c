"""Layouts, landmarks and regressors: where keypoints lie on a body, whatever their order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from helpers_body import PARENTS, smpl_pose, synthetic_smpl

from spt_jax.body import BodyModel, load_body
from spt_jax.body.model import PosedBody
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.keypoints import (
    LAYOUTS,
    KeypointRegressor,
    as_layout,
    edge_side,
    find_landmarks,
    keypoint_regressor,
)
from spt_jax.keypoints.landmarks import LANDMARKS
from spt_jax.keypoints.layout import side
from spt_jax.keypoints.points import COMBINATIONS

_REAL = [name for name in LAYOUTS if not name.startswith("smpl")]


@pytest.fixture(scope="module")
def body():
    return load_body()


def _smpl(rng, joints):
    """A body of the family without a recognisable shape."""
    smpl = synthetic_smpl(rng, joints)
    regressor = smpl["J_regressor"]
    single = {name: np.asarray(value, "float32") for name, value in smpl.items()}
    return BodyModel(
        template=jnp.asarray(single["v_template"]),
        shape_basis=jnp.asarray(single["shapedirs"]),
        joint_template=jnp.asarray((regressor @ smpl["v_template"]).astype("float32")),
        joint_shape_basis=jnp.asarray(
            np.einsum("jv,vcb->jcb", regressor, smpl["shapedirs"]).astype("float32")
        ),
        weights=jnp.asarray(single["weights"]),
        faces=jnp.asarray(smpl["f"].astype(np.int32)),
        parents=tuple(PARENTS[joints]),
        joint_names=SMPL_LAYOUTS[joints],
    )


def _at_rest(body, regressor):
    posed = PosedBody(body.template, body.joint_template)
    return dict(zip(regressor.names, np.asarray(regressor.of(posed)), strict=True))


def _mirrored(name):
    word = {"left": "right", "right": "left", "middle": "middle"}[side(name)]
    return name.replace(side(name), word, 1)


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_are_whole_and_symmetric(name):
    layout = LAYOUTS[name]
    count = len(layout.names)
    assert len(set(layout.names)) == len(layout.official) == len(layout.points) == count
    assert {end for edge in layout.edges for end in edge} == {
        k for k, point in enumerate(layout.points) if point
    }
    if name in ("left_hand21", "right_hand21"):
        mirrored = tuple(_mirrored(keypoint) for keypoint in LAYOUTS["left_hand21"].names)
        assert mirrored == LAYOUTS["right_hand21"].names
        return
    assert {_mirrored(keypoint) for keypoint in layout.names} == set(layout.names)
    pairs = {frozenset(layout.names[end] for end in edge) for edge in layout.edges}
    assert len(pairs) == len(layout.edges)
    assert {frozenset(map(_mirrored, pair)) for pair in pairs} == pairs
    sides = [edge_side(layout, edge) for edge in layout.edges]
    assert sides.count("left") == sides.count("right") > 3


def test_layouts_have_their_published_sizes_and_orders():
    sizes = {name: len(layout.names) for name, layout in LAYOUTS.items()}
    assert sizes == {
        **{"coco17": 17, "body25": 25, "openpose18": 18, "h36m17": 17},
        **{"mpii16": 16, "aic14": 14, "crowdpose14": 14, "posetrack17": 17, "jhmdb15": 15},
        **{"smpl22": 22, "smpl24": 24, "smpl52": 52, "smpl55": 55},
        **{"coco23": 23, "wholebody133": 133, "halpe26": 26, "halpe136": 136, "mediapipe33": 33},
        **{"humanart21": 21, "body25_hands": 67, "openpose18_hands": 60},
        **{"left_hand21": 21, "right_hand21": 21},
    }
    # Each list stands in the documentation of its data set, with numbers.
    for layout, numbered in {
        "wholebody133": {17: "left_big_toe", 22: "right_heel", 91: "left_hand_root"}
        | {95: "left_thumb_tip", 112: "right_hand_root", 132: "right_pinky_tip"},
        "halpe26": {17: "head_top", 18: "neck", 19: "pelvis", 21: "right_big_toe"},
        "halpe136": {25: "right_heel", 94: "left_hand_root", 135: "right_pinky_tip"},
        "mediapipe33": {2: "left_eye", 8: "right_ear", 16: "right_wrist", 19: "left_index1"}
        | {22: "right_thumb2", 24: "right_hip", 29: "left_heel", 32: "right_big_toe"},
        "body25_hands": {24: "right_heel", 25: "left_hand_root", 66: "right_pinky_tip"},
        "mpii16": {0: "right_ankle", 8: "upper_neck", 15: "left_wrist"},
        "aic14": {2: "right_wrist", 12: "head_top"},
        "crowdpose14": {4: "left_wrist", 12: "head_top"},
        "posetrack17": {1: "upper_neck", 4: "right_ear", 16: "right_ankle"},
    }.items():
        assert {k: as_layout(layout).names[k] for k in numbered} == numbered
    assert as_layout("coco17").names[9] == "left_wrist"
    assert as_layout("body25").names[4] == as_layout("openpose18").names[4] == "right_wrist"
    assert as_layout("body25").official[24] == "RHeel"
    assert as_layout("h36m17").names[16] == "right_wrist"
    assert as_layout("h36m17").names[1] == "right_hip"
    sigmas = as_layout("coco17").sigmas
    assert len(sigmas) == 17 and max(sigmas) == sigmas[11] == 0.107


def test_smpl_edges_are_the_bodies_own_tree():
    for joints in SMPL_LAYOUTS.keys() & PARENTS:
        parents = PARENTS[joints]
        edges = LAYOUTS[f"smpl{joints}"].edges
        assert [parent for parent, _ in edges] == parents[1:]


def test_landmarks_lie_where_their_names_say(body):
    vertices = np.asarray(body.template)
    at = {name: vertices[k] for name, k in find_landmarks(body).items()}
    assert tuple(at) == LANDMARKS
    neck = np.asarray(body.joint_template)[body.joint_names.index("neck")]
    height = np.ptp(vertices[:, 1])
    for name, point in at.items():  # the body is symmetric
        np.testing.assert_allclose(at[_mirrored(name)], point * [-1, 1, 1], atol=1e-4)
    assert at["head_top"][1] == vertices[:, 1].max()
    assert neck[1] < at["nose"][1] < at["left_ear"][1] < at["left_eye"][1] < at["head_top"][1]
    assert at["left_ear"][2] < at["left_eye"][2] < at["nose"][2]
    assert at["left_ear"][0] > 2 * at["left_eye"][0] > 0.03 * height
    # Eyes about 63 mm apart on a body of 1.69 m; the nose 2 to 4 cm before the eyes.
    assert 0.055 < at["left_eye"][0] - at["right_eye"][0] < 0.07
    assert 0.015 < at["nose"][2] - at["left_eye"][2] < 0.045
    foot = at["left_big_toe"][2] - at["left_heel"][2]
    assert 0.13 * height < foot < 0.17 * height
    assert at["left_small_toe"][0] - at["left_big_toe"][0] > 0.25 * foot
    assert 0.05 * foot < at["left_big_toe"][2] - at["left_small_toe"][2] < 0.3 * foot
    for name in ("left_big_toe", "left_small_toe", "left_heel"):
        assert at[name][1] < vertices[:, 1].min() + 0.03 * height


def test_landmarks_depend_little_on_order_and_resolution(body, rng):
    vertices, found = np.asarray(body.template), find_landmarks(body)
    order = rng.permutation(body.num_vertices)
    shuffled = find_landmarks(body.at_vertices(order))
    for name, vertex in found.items():
        np.testing.assert_allclose(vertices[order[shuffled[name]]], vertices[vertex], atol=2e-4)
    few = np.sort(rng.choice(body.num_vertices, 3000, replace=False))
    for name, vertex in find_landmarks(body.at_vertices(few)).items():
        distance = np.linalg.norm(vertices[few[vertex]] - vertices[found[name]])
        assert distance < 0.03, (name, distance)


def test_official_meshes_have_their_official_vertices(body, rng):
    few = body.at_vertices(rng.choice(body.num_vertices, 6890, replace=False))
    found = find_landmarks(few)
    assert (found["nose"], found["left_ear"], found["right_heel"]) == (332, 583, 6787)
    ten = body.at_vertices(rng.choice(body.num_vertices, 10475, replace=False))
    found = find_landmarks(ten)
    assert (found["nose"], found["right_ear"], found["left_small_toe"]) == (9120, 616, 5780)
    highest = np.asarray(ten.template)[:, 1].max()
    assert np.asarray(ten.template)[found["head_top"], 1] > highest - 0.01


@pytest.mark.parametrize("name", _REAL)
def test_layouts_lie_on_the_body_as_a_person_does(body, name):
    regressor = keypoint_regressor(body, name, count=len(LAYOUTS[name].names))
    assert regressor.names == LAYOUTS[name].names
    at = _at_rest(body, regressor)
    if regressor.placed is not None:
        lost = [name for name in at if not regressor.placed[regressor.names.index(name)]]
        assert all(LAYOUTS[name].points[regressor.names.index(one)] == "" for one in lost)
        at = {keypoint: point for keypoint, point in at.items() if keypoint not in lost}
    for side_of in ("left", "right"):
        if f"{side_of}_hand_root" in at:  # each finger goes on from knuckle to tip
            for finger in ("index", "middle", "ring", "pinky", "thumb"):
                ends = [f"{side_of}_{finger}{joint}" for joint in ("1", "2", "3", "_tip")]
                chain = np.array([at[end] for end in ends])
                bones = np.linalg.norm(np.diff(chain, axis=0), axis=1)
                assert (bones > 0.01).all() and (bones < 0.06).all()
                out = np.linalg.norm(chain - at[f"{side_of}_hand_root"], axis=1)
                assert (np.diff(out) > 0).all()
    if "hand21" in name:
        return
    for keypoint, point in at.items():
        np.testing.assert_allclose(at[_mirrored(keypoint)], point * [-1, 1, 1], atol=1e-3)
        if side(keypoint) == "left":
            assert point[0] > 0.02
    left = [f"left_{part}" for part in ("shoulder", "hip", "knee", "ankle")]
    heights = [at[keypoint][1] for keypoint in left]
    assert heights == sorted(heights, reverse=True)
    assert at["left_wrist"][0] > at["left_elbow"][0] > at["left_shoulder"][0]
    assert at["left_hip"][0] > np.asarray(body.joint_template)[1, 0]
    assert 0.55 < at["left_hip"][0] / at["left_shoulder"][0] < 0.8
    if {"nose", "left_ear"} <= set(at):
        assert at["nose"][2] > at["left_ear"][2] + 0.05
    shoulders = (at["left_shoulder"] + at["right_shoulder"]) / 2
    for middle in {"neck", "thorax"} & set(at):
        np.testing.assert_allclose(at[middle], shoulders, atol=1e-6)
    if "pelvis" in at:
        np.testing.assert_allclose(at["pelvis"], (at["left_hip"] + at["right_hip"]) / 2, atol=1e-6)


def test_the_spine_of_h36m_is_half_way_up_the_back(body):
    at = _at_rest(body, keypoint_regressor(body, "h36m17"))
    chain = [at[name][1] for name in ("pelvis", "spine", "thorax", "head", "head_top")]
    assert chain == sorted(chain)
    np.testing.assert_allclose(at["spine"][1], (chain[0] + chain[2]) / 2, atol=1e-5)


@pytest.mark.parametrize("joints", [24, 52, 55])
def test_smpl_layouts_are_the_joints_themselves(rng, joints):
    body = _smpl(rng, joints)
    regressor = keypoint_regressor(body, "smpl", count=joints)
    assert regressor.names == SMPL_LAYOUTS[joints] and regressor.vertices == ()
    np.testing.assert_array_equal(regressor.joint_weights, np.eye(joints))
    fewer = keypoint_regressor(body, "smpl22")
    np.testing.assert_array_equal(fewer.joint_weights, np.eye(joints)[:22])


def test_hands_that_a_body_lacks_lie_in_its_knuckles(body):
    at = _at_rest(body, keypoint_regressor(body, "smpl24"))
    joints = dict(zip(body.joint_names, np.asarray(body.joint_template), strict=True))
    assert np.linalg.norm(at["left_hand"] - joints["left_middle1"]) < 0.02
    assert at["right_hand"][0] < joints["right_wrist"][0]


def test_eyes_are_joints_in_smpl_x_and_surface_in_coco(body):
    """SMPL-X has joints of the landmarks' names."""
    names = (*body.joint_names, "left_eye", "right_eye", "jaw")
    more = jnp.zeros((3, 3))
    full = BodyModel(
        body.template,
        body.shape_basis,
        jnp.concatenate([body.joint_template, more]),
        jnp.concatenate([body.joint_shape_basis, jnp.zeros((3, 3, body.num_shape))]),
        jnp.concatenate([body.weights, jnp.zeros((body.num_vertices, 3))], axis=1),
        body.faces,
        (*body.parents, 15, 15, 15),
        names,
    )
    at = _at_rest(full, keypoint_regressor(full, "coco17"))
    assert at["left_eye"][2] > 0.1
    for request in ("smpl55", ["left_eye", "nose"]):
        np.testing.assert_array_equal(
            _at_rest(full, keypoint_regressor(full, request))["left_eye"], 0
        )


def test_names_indices_and_dense_arrays_say_the_same(body, rng):
    names = ["left_wrist", "pelvis", "neck"]
    by_name = keypoint_regressor(body, names, count=3)
    indices = [body.joint_names.index(name) for name in names]
    assert by_name.names == tuple(names)
    for request in (indices, tuple(indices), np.array(indices), jnp.array(indices)):
        by_index = keypoint_regressor(body, request)
        assert by_index.names == by_name.names
        np.testing.assert_array_equal(by_index.joint_weights, by_name.joint_weights)
    dense = keypoint_regressor(body, np.asarray(by_name.joint_weights), names=names)
    np.testing.assert_array_equal(dense.joint_weights, by_name.joint_weights)
    assert dense.names == by_name.names and dense.vertices == ()
    assert keypoint_regressor(body, dense, count=3) is dense
    assert keypoint_regressor(body, np.eye(52)).names[:2] == ("point0", "point1")


def test_dense_regressors_keep_the_vertices_that_they_use(dtype, rng):
    body = load_body(dtype=dtype)
    weights = np.zeros((17, body.num_vertices))
    for row in weights:
        row[rng.choice(2000, 5)] = rng.uniform(0.1, 1, 5)
    weights /= weights.sum(axis=1, keepdims=True)
    for given in (weights, jnp.asarray(weights, dtype), scipy.sparse.csc_matrix(weights)):
        regressor = keypoint_regressor(body, given, names="h36m17")
        assert regressor.find("left_hip", "right_hip") == (4, 1)
        used = np.flatnonzero(weights.any(axis=0))
        assert regressor.vertices == tuple(used.tolist())
        got = regressor.of(PosedBody(body.template, body.joint_template))
        assert got.dtype == dtype
        limit = 1e-6 if dtype == np.float32 else 1e-12
        want = weights @ np.asarray(body.template, np.float64)
        np.testing.assert_allclose(got, want, atol=limit)


def test_batches_jit_and_gradients(body, rng):
    regressor = keypoint_regressor(body, "body25")
    few = body.at_vertices(regressor.vertices)
    pose = jnp.asarray(smpl_pose(rng, 52, 2)[0] * 0.3, jnp.float32)

    @jax.jit
    def keypoints(regressor, pose):
        posed = few(pose)
        return regressor(posed.joints, posed.vertices)

    got = keypoints(regressor, pose)
    assert got.shape == (2, 25, 3)
    posed = few(pose)
    np.testing.assert_allclose(jax.vmap(regressor)(posed.joints, posed.vertices), got, atol=1e-6)
    joints, landmarks = posed.joints[0], posed.vertices[0]
    slopes = jax.grad(lambda j, p: jnp.sum(regressor(j, p)), argnums=(0, 1))(joints, landmarks)
    # Every keypoint's weights sum to 1: moving the body by 1 moves 25 keypoints by 1.
    total = sum(np.asarray(slope, np.float64).sum(axis=0) for slope in slopes)
    np.testing.assert_allclose(total, 25, rtol=1e-5)


def test_keypoints_turn_with_the_body(body, rng):
    regressor = keypoint_regressor(body, "h36m17")
    few = body.at_vertices(regressor.vertices)
    pose = jnp.zeros((52, 3)).at[0, 1].set(np.pi / 2)  # to its left: z becomes x
    rest, turned = few(jnp.zeros((52, 3))), few(pose)
    before, after = (np.asarray(regressor(p.joints, p.vertices)) for p in (rest, turned))
    root = np.asarray(rest.joints[0])
    want = (before - root) @ np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]) + root
    np.testing.assert_allclose(after, want, atol=1e-5)


def test_names_a_body_lacks_are_told(rng, untyped):
    body = load_body()
    cases = [
        ("smpl55", {}, ValueError, "smpl55 must be keypoints of the body: it lacks jaw;"),
        ("smpl", {}, ValueError, "22, 24, 52, 55 keypoints: got no count"),
        ("smpl", {"count": 25}, ValueError, "got 25"),
        ("coco17", {"count": 25}, ValueError, "coco17 has 17 keypoints: got 25"),
        ("coco", {}, ValueError, 'one of "coco17", "body25"'),
        (["left_wrist", "tail"], {}, ValueError, "it lacks tail; it has the joints pelvis"),
        ([3, 52], {}, ValueError, "from 0 to 51, the body's joints: got 52"),
        ([3, -1], {}, ValueError, "got -1"),
        ([3, 1], {"count": 3}, ValueError, "got 2 for 3 keypoints"),
        ([1, "pelvis"], {}, TypeError, "must be a layout's name, a list of names"),
        (None, {}, TypeError, "got NoneType"),
        ([[1.0], [1.0, 2.0]], {}, TypeError, "must be a layout's name"),
        (np.ones((3, 6890)), {}, ValueError, r"got shape \(3, 6890\); a regressor made for SMPL"),
        (np.ones((3, 52)), {}, ValueError, "sum to 1.* got 52 in row 0"),
        (np.full((3, 52), np.nan), {}, ValueError, "NaN or infinity in row 0"),
        (np.eye(52), {"names": ["a"]}, ValueError, "names must be a layout's name or 52 strings"),
        (np.eye(52), {"names": "coco17"}, ValueError, "coco17 has 17 keypoints: got 52"),
        ("coco17", {"names": "coco17"}, ValueError, "names must be left out"),
    ]
    for layout, options, error, message in cases:
        with pytest.raises(error, match=message):
            keypoint_regressor(body, layout, **options)
    small = _smpl(rng, 24)
    with pytest.raises(ValueError, match="must be a regressor for this body, 24 joints"):
        keypoint_regressor(small, keypoint_regressor(body, "coco17"))
    with pytest.raises(ValueError, match="move for more than a half: got none"):
        keypoint_regressor(small, "coco17")
    with pytest.raises(ValueError, match="it lacks left_index1, left_index2"):
        keypoint_regressor(small, "smpl52")
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda b: keypoint_regressor(b, "coco17").joint_weights)(body)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda b: keypoint_regressor(b, ["mid_spine"]).joint_weights)(body)


def test_regressors_that_contradict_themselves_are_refused(untyped):
    two, three = jnp.zeros((2, 4)), jnp.zeros((2, 3))
    with pytest.raises(ValueError, match=r"vertex_weights must have shape \(2, 1\)"):
        KeypointRegressor(("a", "b"), (7,), two, three)
    with pytest.raises(ValueError, match=r"joint_weights must have shape \(1, joints\)"):
        KeypointRegressor(("a",), (1, 2, 3), two, three)
    regressor = KeypointRegressor(("a", "b"), (7, 8, 9), two, three)
    with pytest.raises(ValueError, match=r"landmarks must be \(\.\.\., 3, 3\)"):
        regressor(jnp.zeros((4, 3)), jnp.zeros((4, 3)))
    with pytest.raises(TypeError, match="joints must be floating-point"):
        regressor(np.zeros((4, 3), int), jnp.zeros((3, 3)))


def test_every_combination_is_a_point_of_the_embedded_body(body):
    regressor = keypoint_regressor(body, list(COMBINATIONS))
    sums = np.asarray(regressor.joint_weights).sum(1) + np.asarray(regressor.vertex_weights).sum(1)
    np.testing.assert_allclose(sums, 1, rtol=1e-6)
