"""What a fit minimises, term by term, against formulas written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.distance
from helpers import embedded_body, mocap
from helpers_body import slow_body, slow_rotation, synthetic_smpl, with_parents
from helpers_fit import UPRIGHT, body_of, camera, figure, frames, objective, seen
from scipy.spatial.transform import Rotation

from spt_jax import keypoint_regressor, self_intersection_penalty
from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.fit import (
    Laplacian,
    Nothing,
    Regularizer,
    SelfIntersection,
    Spheres,
    as_regularizer,
    as_weights,
)
from spt_jax.fit.problem.figure import make_figure
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.limits import joint_limits
from spt_jax.fit.problem.priors import GaussianPosePrior
from spt_jax.fit.problem.variables import Variables

NAMES = SMPL_LAYOUTS[22]


def mirrored(poses):
    """Poses in a mirror that swaps left and right, by conjugating the rotations."""
    swap = [
        NAMES.index(name.replace("left", "?").replace("right", "left").replace("?", "right"))
        for name in NAMES
    ]
    across = np.diag([-1.0, 1.0, 1.0])
    turns = Rotation.from_rotvec(np.reshape(poses, (-1, 3))).as_matrix()
    turned = Rotation.from_matrix(across @ turns @ across).as_rotvec()
    return turned.reshape(np.shape(poses))[:, swap]


# The figure.


@pytest.mark.parametrize("layout", ["smpl22", "coco17", "body25", "h36m17"])
def test_a_figure_has_the_keypoints_of_the_whole_body(layout, x64, rng):
    body, part = embedded_body(), figure(layout)
    pose = jnp.asarray(mocap().pose[::300], jnp.float64)
    pose = body.pose_from_smpl(pose).at[:, 22:].set(0.0)
    shape, shift = rng.normal(size=(len(pose), body.num_shape)), rng.normal(size=(len(pose), 3))
    of = Variables(pose[:, part.rows], jnp.asarray(shape), jnp.asarray(shift))
    points, joints, rotations = jax.jit(jax.vmap(part.posed))(of)
    posed = body(pose, shape, shift)
    np.testing.assert_allclose(joints, posed.joints[:, part.rows], atol=1e-6)
    root = matrix_from_axis_angle(pose[:, 0])
    np.testing.assert_allclose(rotations[:, 0], root, atol=1e-12)
    expected = keypoint_regressor(body, layout).of(posed)
    # Joints that move a landmark with less than a hundredth of its weight are left out.
    np.testing.assert_allclose(points, expected, atol=1e-6 if layout == "smpl22" else 2e-3)


def test_fingers_move_where_they_are_seen():
    body = embedded_body()
    assert figure("smpl22").moving == tuple(range(22))
    finger = next(name for name in body.joint_names if "index3" in name and "left" in name)
    with_finger = make_figure(body, keypoint_regressor(body, ["pelvis", "left_knee", finger]))
    moving = {body.joint_names[joint] for joint in with_finger.moving}
    assert {finger, "left_wrist", "left_knee", "pelvis"} <= moving
    assert not moving & {"right_wrist", "right_knee", "left_ankle", "head"}


def test_pose_blend_shapes_follow_the_joints_that_move(x64, rng):
    smpl = synthetic_smpl(rng, 24, vertices=30)
    unseen = (10, 11, 22, 23)  # leaves: feet and hands
    smpl["weights"][:, unseen] = 0
    smpl["weights"] /= smpl["weights"].sum(axis=1, keepdims=True)
    body = body_of(smpl, SMPL_LAYOUTS[24])
    dense = np.zeros((3, 30))
    dense[[0, 1, 1, 2], [4, 7, 9, 21]] = [1, 0.25, 0.75, 1]
    part = make_figure(body, keypoint_regressor(body, dense))
    assert not set(part.moving) & set(unseen)
    pose = rng.normal(scale=0.7, size=(24, 3))
    pose[list(unseen)] = 0
    shape = rng.normal(size=10)
    points, *_ = part.posed(
        Variables(jnp.asarray(pose[part.rows]), jnp.asarray(shape), jnp.zeros(3))
    )
    vertices, _ = slow_body(with_parents(smpl), pose, shape, np.zeros(3))
    np.testing.assert_allclose(points, dense @ vertices, atol=1e-12)


# The objective.


def a_case(robust=None, **options):
    """An objective at some place, and the place."""
    rng = np.random.default_rng(1)
    true = frames("run/0010")[0].astype(jnp.float64)
    keypoints = np.asarray(seen(true)) + rng.normal(scale=6.0, size=(22, 2))
    confidence = rng.uniform(0.2, 1.0, 22)
    confidence[5] = 0.0
    case = objective(
        keypoints,
        confidence=confidence,
        robust=robust,
        weights=(0.7, 1.3, 0.4, 0.25),
        fit_shape=True,
        **options,
    )
    pose = np.asarray(frames("spinkick/0010")[0])
    here = Variables(
        jnp.asarray(pose + 0.2 * rng.normal(size=pose.shape)),
        jnp.asarray(rng.normal(size=embedded_body().num_shape)),
        jnp.asarray(0.2 * rng.normal(size=3)),
    )
    return case, case.pack(here)


@pytest.mark.parametrize("robust", [None, 2.5])
def test_terms_are_their_formulas(robust, x64):
    case, vector = a_case(robust)
    now = jax.tree.map(np.asarray, case.unpack(vector))
    body = embedded_body()
    smpl = {
        "v_template": np.asarray(body.template, np.float64),
        "shapedirs": np.asarray(body.shape_basis),
        "J": np.asarray(body.joint_template, np.float64),
        "J_shapedirs": np.asarray(body.joint_shape_basis),
        "weights": np.asarray(body.weights, np.float64),
        "parents": body.parents,
    }
    _, joints = slow_body(smpl, now.pose, now.shape, now.translation, keep=[0])
    seen_from = joints[:22] @ UPRIGHT.T + np.array([0.1, 0.9, 4.0])
    pixels = 1000.0 * seen_from[:, :2] / seen_from[:, 2:] + np.array([500.0, 480.0])
    np.testing.assert_allclose(case.project(vector), pixels, atol=1e-3)
    off = np.linalg.norm(pixels - np.asarray(case.keypoints), axis=1) / 5.0
    rho = off**2 if robust is None else off**2 / (1 + (off / robust) ** 2)

    rows = mocap().pose.astype(np.float64)
    poses = np.concatenate([rows, mirrored(rows)])[:, 1:].reshape(2 * len(rows), -1)
    spread = np.cov(poses.T) + 0.15**2 * np.eye(63)
    away = scipy.spatial.distance.mahalanobis(
        now.pose[1:22].ravel(), poses.mean(axis=0), np.linalg.inv(spread)
    )
    ranges = joint_limits(body.joint_names)
    rows = [np.asarray(x, np.float64)[1:22].ravel() for x in (now.pose, ranges.low, ranges.high)]
    beyond = 0.0
    for angle, low, high in zip(*rows, strict=True):
        beyond += (max(low - angle, 0, angle - high) / 0.1) ** 2
    up = slow_rotation(now.pose[0])[:, 1]
    expected = {
        "reprojection": np.sum(np.asarray(case.confidence) * rho),
        "prior": 0.7 * away**2,
        "limits": 1.3 * beyond,
        "shape": 0.4 * np.sum(now.shape**2),
        "upright": 0.25 * np.sum((up - [0, 1, 0]) ** 2),
    }
    found = case.costs(vector)
    ridge = found.pop("ridge")
    assert set(found) == set(expected)
    for name, cost in expected.items():
        assert cost > 0
        np.testing.assert_allclose(found[name], cost, rtol=1e-4, err_msg=name)
    # The ridge decides only what nothing else does.
    assert ridge < 1e-3 * sum(expected.values())
    np.testing.assert_allclose(case.cost(vector), sum(expected.values()) + ridge, rtol=1e-4)


@pytest.mark.parametrize("robust", [None, 2.5])
def test_gradient_against_finite_differences(robust, x64, rng):
    case, vector = a_case(robust)
    cost = jax.jit(lambda x: case.cost(x))
    gradient = jax.jit(jax.grad(lambda x: case.cost(x)))(vector)
    for _ in range(6):
        way = jnp.asarray(rng.normal(size=vector.shape))
        step = 1e-6
        slope = (cost(vector + step * way) - cost(vector - step * way)) / (2 * step)
        np.testing.assert_allclose(gradient @ way, slope, rtol=1e-5)


def test_unwhitening_makes_the_cost_round(x64):
    case, vector = a_case()
    back = np.asarray(jax.jit(lambda x: case.unwhitening(x))(vector))

    def flat(x):
        return jnp.concatenate([r.ravel() for r in case.residuals(x).values()])

    ways = jnp.asarray(1e-6 * np.eye(len(vector)))
    both = jax.jit(jax.vmap(lambda way: flat(vector + way) - flat(vector - way)))(ways)
    jacobian = np.asarray(both).T / 2e-6
    form = jacobian.T @ jacobian + np.eye(len(vector))
    np.testing.assert_allclose(back.T @ form @ back, np.eye(len(vector)), atol=1e-5)


def test_order_of_keypoints_and_those_not_seen_do_not_matter(x64, rng):
    pose = frames("dance_a/0010")[0].astype(jnp.float64)
    keypoints = np.asarray(seen(pose)) + rng.normal(scale=5.0, size=(22, 2))
    confidence = rng.uniform(0.5, 1.0, 22)
    order = rng.permutation(22)
    plain = objective(keypoints, confidence=confidence)
    swapped = objective(
        keypoints[order], confidence=confidence[order], layout=tuple(NAMES[k] for k in order)
    )
    at = plain.pack(Variables(pose * 0.9, plain.start.shape, jnp.zeros(3)))

    def both(case):
        return jax.jit(jax.value_and_grad(lambda x: case.cost(x)))(at)

    expected = both(plain)
    found = both(swapped)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, expected)

    keep = np.arange(22) != 8
    fewer = tuple(name for name, kept in zip(NAMES, keep, strict=True) if kept)
    without = objective(keypoints[keep], confidence=confidence[keep], layout=fewer)
    keypoints[8] = 1e5
    unseen = objective(keypoints, confidence=np.where(keep, confidence, 0.0))
    assert without.figure.moving == unseen.figure.moving
    found, expected = both(unseen), both(without)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), found, expected)


@pytest.mark.parametrize("fit_shape", [False, True])
@pytest.mark.parametrize("fit_translation", [False, True])
def test_what_is_not_fitted_stays(fit_shape, fit_translation, rng):
    start = Variables(*(rng.normal(size=s).astype(np.float32) for s in ((52, 3), 10, 3)))
    case = objective(
        np.zeros((22, 2), np.float32),
        start=start,
        fit_shape=fit_shape,
        fit_translation=fit_translation,
    )
    given = Variables(*(jnp.asarray(rng.normal(size=s.shape).astype(np.float32)) for s in start))
    vector = case.pack(given)
    assert vector.shape == (66 + 3 * fit_translation + 10 * fit_shape,)
    back = case.unpack(vector)
    np.testing.assert_array_equal(back.pose[1:22], given.pose[1:22])
    # The root and the translation went into the viewer's axes and came back.
    roots = Rotation.from_rotvec([np.float64(one.pose[0]) for one in (back, given)])
    assert (roots[0].inv() * roots[1]).magnitude() < 1e-6
    np.testing.assert_array_equal(back.pose[22:], start.pose[22:])
    np.testing.assert_array_equal(back.shape, (given if fit_shape else start).shape)
    moved = given if fit_translation else start
    np.testing.assert_allclose(
        back.translation, moved.translation, atol=0 if not fit_translation else 1e-6
    )
    np.testing.assert_allclose(case.pack(back), vector, atol=2e-6)


# Prior and limits.


def test_the_prior_of_some_joints_is_the_marginal(rng):
    names = ("pelvis", "spine1", "left_hip", "left_knee", "jaw")
    poses = rng.normal(scale=0.4, size=(40, 4, 3))
    prior = pose_prior(names, poses, names[:4])
    # Without a right side the mirror image swaps no joints.
    both = np.concatenate([poses, poses * [1, -1, -1]])
    chosen = [0, 3, 1]
    small = prior.of_joints(chosen)
    rows = both[:, [3, 1]].reshape(80, -1)
    spread = np.cov(rows.T) + 0.15**2 * np.eye(6)
    pose = rng.normal(size=(3, 3)).astype(np.float32)
    away = pose[1:].ravel() - rows.mean(axis=0)
    np.testing.assert_allclose(
        small(jnp.asarray(pose)), away @ np.linalg.solve(spread, away), rtol=1e-4
    )
    # A joint that the poses lack: 0.3 rad about rest, and nothing to do with the others.
    bent = np.asarray(prior.mean).copy()
    bent[4] += [0.3, 0.0, 0.6]
    np.testing.assert_allclose(prior(jnp.asarray(bent)), 1 + 4, rtol=1e-5)
    # The root is free.
    np.testing.assert_allclose(prior(prior.mean.at[0].set(9.0)), 0, atol=1e-6)


def test_left_and_right_are_alike(rng):
    """A prior and limits that told left from right would be wrong for half of all people."""
    prior, limits = pose_prior(NAMES), joint_limits(NAMES)
    poses = mocap().pose[rng.integers(0, len(mocap().pose), 20)]
    poses = np.concatenate([poses, rng.normal(scale=0.6, size=(5, 22, 3))]).astype(np.float32)
    other = jnp.asarray(mirrored(poses), jnp.float32)
    for term in (prior, limits):
        np.testing.assert_allclose(
            jax.vmap(term)(other), jax.vmap(term)(jnp.asarray(poses)), rtol=2e-3, atol=1e-3
        )


def test_knees_and_elbows_bend_one_way_only():
    limits = joint_limits(NAMES)
    body, rest = embedded_body(), jnp.zeros((22, 3))
    for joint, axis, sign in (
        ("left_knee", 0, 1),
        ("right_knee", 0, 1),
        ("left_elbow", 1, -1),
        ("right_elbow", 1, 1),
    ):
        row = NAMES.index(joint)
        right = rest.at[row, axis].set(1.0 * sign)
        wrong = rest.at[row, axis].set(-1.0 * sign)
        assert limits(right) == 0
        np.testing.assert_allclose(limits(wrong), 9.5**2, rtol=1e-5)  # all but 0.05 rad of it
        # The right way takes the heel back, and the hand forward.
        end = NAMES.index(joint.replace("knee", "ankle").replace("elbow", "wrist"))
        moved = body(body.pose_from_smpl(right)).joints - body(body.pose_from_smpl(rest)).joints
        forward = float(moved[end, 2])
        assert forward < -0.2 if "knee" in joint else forward > 0.1


def test_people_stay_within_the_limits():
    """Measured: 92 % of the frames cost nothing, 97 % less than 1, the worst 23 (0.36 rad)."""
    costs = np.asarray(jax.vmap(joint_limits(NAMES))(jnp.asarray(mocap().pose)))
    assert np.mean(costs == 0) > 0.9
    assert np.mean(costs < 1) > 0.95
    assert costs.max() < 30


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pose_prior(NAMES, np.zeros((1, 22, 3))), r"poses .* N of at least 2: got \(1, 22"),
        (lambda: pose_prior(NAMES, np.full((3, 22, 3), np.nan)), "poses must be finite"),
        (lambda: pose_prior(NAMES, np.zeros((3, 21, 3))), "pose_joints must name .* 21 joints"),
        (lambda: pose_prior(NAMES, np.zeros((3, 22, 3)), NAMES[:5]), "got 5 names for 22 joints"),
        (lambda: joint_limits(NAMES, {"tail": [(0, 1)] * 3}), "joints of the body: got 'tail'"),
        (lambda: joint_limits(NAMES, {"head": [(1, 0)] * 3}), r"\(low, high\) pairs .*'head'"),
        (lambda: joint_limits(NAMES, {"head": [(0, np.nan)] * 3}), r"\(low, high\) pairs"),
        (lambda: as_weights([]), r"weights must be .* one for each stage: got \[\]"),
        (lambda: as_weights([1.0, -1.0]), "not negative"),
        (lambda: as_weights([np.inf]), "finite"),
        (lambda: SelfIntersection(folds="maybe"), "folds"),
        (lambda: SelfIntersection(value="area"), "value"),
        (lambda: SelfIntersection(margin=-1.0), "margin"),
        (lambda: as_regularizer("capsules"), "'laplacian', 'none', 'spheres', 'spt'"),
        (lambda: Spheres().prepared(embedded_body(), 2), "one body's own parts"),
    ],
)
def test_what_is_wrong_is_said(make, message, untyped):
    with pytest.raises(ValueError, match=message):
        make()


# Regularizers.


def people(*names):
    pose = frames(*names)
    count = len(pose)
    shift = 0.3 * jnp.arange(count, dtype=pose.dtype)[:, None] * jnp.ones((1, 3), pose.dtype)
    return Variables(pose, 0.5 * jnp.ones((count, embedded_body().num_shape)), shift)


def test_the_penalty_is_the_overlap_in_cubic_centimetres():
    body = embedded_body()
    now = people("crawl/0092")
    term = SelfIntersection(folds="count").prepared(body, 1)
    vertices = body(now.pose, now.shape).vertices[0]
    volume = 1e6 * self_intersection_penalty(vertices, body.faces)
    assert volume > 10
    np.testing.assert_allclose(term.energy(body, now, now), volume, rtol=1e-3)
    apart = SelfIntersection().prepared(body, 1)
    ignoring = 1e6 * self_intersection_penalty(vertices, body.faces, rest_surface=body.rest_surface)
    np.testing.assert_allclose(apart.energy(body, now, now), ignoring, rtol=1e-3)
    ratio = SelfIntersection(folds="count", value="ratio", gradient="unit").prepared(body, 1)
    part = self_intersection_penalty(vertices, body.faces, value="ratio", gradient="unit")
    np.testing.assert_allclose(ratio.energy(body, now, now), 100 * part, rtol=1e-3)


def test_the_penalty_sees_people_in_each_other():
    body = embedded_body()
    one = people("walk/0010")
    two = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), one)
    two = two._replace(translation=jnp.array([[0.0, 0, 0], [0.1, 0, 0]]))
    far = two._replace(translation=jnp.array([[0.0, 0, 0], [9.0, 0, 0]]))
    term = SelfIntersection().prepared(body, 2)
    alone = SelfIntersection().prepared(body, 1).energy(body, one, one)
    assert term.energy(body, two, two) > 2e4  # most of a body's 60 litres
    np.testing.assert_allclose(term.energy(body, far, far), 2 * alone, atol=0.01)


def test_the_laplacian_term_is_mean_squared_change_in_square_millimetres():
    body = embedded_body()
    start, now = people("walk/0010"), people("run/0010")
    term = Laplacian().prepared(body, 1)
    neighbors = [set() for _ in range(body.num_vertices)]
    for a, b, c in np.asarray(body.faces).tolist():
        neighbors[a] |= {b, c}
        neighbors[b] |= {a, c}
        neighbors[c] |= {a, b}
    coordinates = []
    for which in (start, now):
        vertices = body(which.pose.at[:, 0].set(0.0), which.shape).vertices[0]
        vertices = np.asarray(vertices, np.float64)
        means = np.array([vertices[list(row)].mean(axis=0) for row in neighbors])
        coordinates.append(vertices - means)
    change = 1e6 * np.mean(np.sum((coordinates[1] - coordinates[0]) ** 2, axis=1))
    assert change > 0.01
    np.testing.assert_allclose(term.energy(body, start, now), change, rtol=1e-2)
    moved = start._replace(pose=start.pose.at[:, 0].set(1.0), translation=start.translation + 1.0)
    np.testing.assert_allclose(term.energy(body, start, moved), 0, atol=1e-9)


def test_named_regularizers_and_their_own_weights():
    for name, kind in (
        ("none", Nothing),
        ("spt", SelfIntersection),
        ("spheres", Spheres),
        ("laplacian", Laplacian),
    ):
        made = as_regularizer(name)
        assert type(made) is kind and made.name == name
    own = SelfIntersection(0.5)
    assert as_regularizer(own) is own
    np.testing.assert_array_equal(own.weights, [0.5])
    assert isinstance(own, Regularizer)
    with pytest.raises(TypeError, match="Regularizer: got 3"):
        as_regularizer(3)


def test_regularizers_are_prepared_inside_jit():
    """Their weights are tracers there."""
    body = embedded_body()
    now = people("punch/0007")
    for kind in (SelfIntersection, Spheres, Laplacian):
        energy = jax.jit(lambda x, kind=kind: kind().prepared(body, 1).energy(body, now, x))
        np.testing.assert_allclose(
            energy(now), kind().prepared(body, 1).energy(body, now, now), rtol=1e-3, atol=1e-6
        )


def test_a_prior_made_by_hand():
    prior = GaussianPosePrior(jnp.ones((3, 3)), 2 * jnp.eye(6))
    np.testing.assert_allclose(prior(jnp.zeros((3, 3))), 6 * 4)
    assert camera().near == 0.1
