"""What is wrong with an argument of `fit_pose` is said: which, the rule, what was seen."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import embedded_body
from helpers_fit import camera, frames, seen

from spt_jax import PinholeCamera, fit_pose
from spt_jax.fit import Scene, Search, Stages, Start, Terms
from spt_jax.fit.problem.inputs import as_people, count_points
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.limits import joint_limits
from spt_jax.keypoints import Person

POINTS = np.asarray(seen(frames("walk/0010"))[0])
SPOILT = POINTS.copy()
SPOILT[3, 1] = np.nan
ONES = np.ones(22, np.float32)
PERSON = Person(POINTS, ONES, "smpl22")
OTHER = Person(POINTS[:17], ONES[:17], "coco17")
SPINE = ("pelvis", "spine1", "spine2", "spine3")
TWO_CAMERAS = jax.vmap(PinholeCamera, (0, None))(jnp.array([9e2, 1e3]), jnp.zeros(2))


class Unusable(RuntimeError):
    """The call went through to the fit."""


@pytest.fixture
def call(monkeypatch, untyped):
    """`fit_pose` up to where it would begin to fit."""

    def stop(*_):
        raise Unusable

    monkeypatch.setattr("spt_jax.fit.pose.fit_each", stop)

    def called(**changed):
        given = {"body": embedded_body(), "keypoints": POINTS, "camera": camera()}
        given |= {"layout": "smpl", "regularizer": "none"} | changed
        body, keypoints, eye = (given.pop(name) for name in ("body", "keypoints", "camera"))
        for kind, name in ((Start, "start"), (Terms, "terms"), (Search, "search")):
            own = {key: given.pop(key) for key in kind.__annotations__ if key in given}
            if own:
                given[name] = kind(**own)
        return fit_pose(body, keypoints, eye, **given)

    return called


@pytest.mark.parametrize(
    "good",
    [
        {},
        {"keypoints": POINTS.tolist()},
        {"keypoints": [POINTS, POINTS], "confidence": [ONES, ONES]},
        {"keypoints": [POINTS, POINTS], "confidence": ONES},
        {"keypoints": np.stack([[POINTS] * 3] * 2), "pose": np.zeros((52, 3))},
        {"keypoints": POINTS.round().astype(int)},
        {"keypoints": SPOILT, "confidence": (np.arange(22) != 3).astype(float)},
        {"confidence": np.full(22, 2)},
        {"shape": np.zeros(4), "translation": [0.0, 0.0, 1.0], "fit_shape": True},
        {"prior": None, "limits": None, "robust": 30, "expected_error": 4.0},
        {"prior_weight": 0, "starts": np.int64(3)},
        {"limits_weight": jnp.asarray(2.0), "robust": [20.0], "keypoints": [POINTS]},
        {"confidence": np.arange(22) > 3},
        {"keypoints": POINTS.astype(np.float16)},
        {"solver": optx.LBFGS(1e-3, 1e-3)},
        {"stages": Stages(optx.LBFGS(1e-3, 1e-3))},
        {"prior": lambda pose: pose},
        {"keypoints": PERSON, "layout": None},
        {"keypoints": [PERSON, PERSON], "layout": None},
    ],
)
def test_what_is_right_passes(good, call):
    with pytest.raises(Unusable):
        call(**good)


@pytest.mark.parametrize(
    ("wrong", "kind", "message"),
    [
        ({"body": "smpl.pkl"}, TypeError, "body must be a BodyModel: got str; see load_body"),
        ({"camera": np.eye(3, 4)}, TypeError, "camera must be .*got ndarray.*from_matrix"),
        ({"keypoints": np.zeros((22, 3))}, ValueError, r"keypoints .*\(22, 3\).*third column"),
        ({"keypoints": np.zeros(2)}, ValueError, r"keypoints must have shape .* got \(2,\)"),
        (
            {"keypoints": np.zeros((0, 22, 2))},
            ValueError,
            r"keypoints must hold a person .*\(0, 22",
        ),
        ({"keypoints": []}, ValueError, r"keypoints must have shape .* got \(0,\)"),
        ({"keypoints": POINTS * 1j}, TypeError, "keypoints must be .*complex"),
        (
            {"keypoints": [POINTS, POINTS[:5]]},
            ValueError,
            "keypoints must .*one shape.*confidence of 0",
        ),
        ({"keypoints": SPOILT}, ValueError, r"keypoints must be finite.*got 1 .*\[3\].*to 0"),
        ({"keypoints": [POINTS, SPOILT]}, ValueError, r"keypoints must be finite.*\[1, 3\]"),
        ({"keypoints": POINTS[:17]}, ValueError, "22.*17|17.*22|smpl"),
        ({"layout": "coco17"}, ValueError, "coco17 has 17 keypoints: got 22"),
        ({"layout": "mpii"}, ValueError, "mpii"),
        ({"layout": None}, ValueError, 'layout must say what the 22 .*got none; "smpl22" has so'),
        ({"layout": 3}, TypeError, "layout must be .*got int"),
        ({"keypoints": PERSON}, ValueError, "confidence and layout must be left out.*smpl22"),
        (
            {"keypoints": [PERSON, OTHER], "layout": None},
            ValueError,
            "people with one layout: got coco17, smpl22",
        ),
        ({"keypoints": [PERSON, POINTS], "layout": None}, TypeError, "all be of one kind"),
        ({"start": np.zeros((52, 3))}, TypeError, "start must be a spt_jax.fit.Start: got ndarray"),
        ({"confidence": np.ones(5)}, ValueError, r"confidence must have shape \(..., 22\).*\(5,\)"),
        ({"confidence": np.ones((3, 22))}, ValueError, r"confidence must fit .*\(3, 22\)"),
        ({"confidence": -ONES}, ValueError, "confidence .*not negative: got -1"),
        ({"confidence": ONES * np.nan}, ValueError, "confidence must be finite .*got nan"),
        ({"confidence": 0 * ONES}, ValueError, "confidence must be above 0.*leave out"),
        (
            {"keypoints": [POINTS, POINTS], "confidence": [ONES, 0 * ONES]},
            ValueError,
            r"confidence must be above 0.*person \[1\]",
        ),
        ({"regularizer": "capsules"}, ValueError, "regularizer must be one of .*'spt'.*'capsules'"),
        ({"regularizer": 3}, TypeError, "regularizer must be .*got 3"),
        ({"pose": np.zeros((24, 3))}, ValueError, r"pose must have shape .*52, 3.*\(24, 3\)"),
        ({"pose": np.zeros((2, 52, 3))}, ValueError, r"pose must fit .*\(2, 52, 3\)"),
        ({"pose": np.full((52, 3), np.nan)}, ValueError, "pose must be finite"),
        ({"shape": np.zeros(11)}, ValueError, r"shape must have shape .*10.*\(11,\)"),
        ({"translation": np.zeros(2)}, ValueError, r"translation must have shape .*\(2,\)"),
        ({"translation": [0, 0, np.inf]}, ValueError, "translation must be finite"),
        ({"pose": "run"}, TypeError, "pose must hold numbers: got str"),
        ({"prior": pose_prior(SPINE)}, ValueError, "prior must be of .* 52 joints: got one of 4"),
        ({"limits": joint_limits(SPINE)}, ValueError, "limits must be of .* 52 .* got one of 4"),
        ({"solver": "bfgs"}, TypeError, "solver of the search must be an .* minimiser.*got str"),
        ({"camera": TWO_CAMERAS}, ValueError, r"camera must be one: got a batch of \(2,\).*vmap"),
        ({"prior": "vposer"}, ValueError, 'prior must be "mocap".*vposer'),
        ({"prior": 3}, ValueError, 'prior must be "mocap".*got 3'),
        ({"limits": 2}, ValueError, 'limits must be "anatomical".*2'),
        ({"prior_weight": -1.0}, ValueError, "prior_weight .*not negative: got -1"),
        ({"limits_weight": np.nan}, ValueError, "limits_weight must be a finite .*nan"),
        ({"shape_weight": "1"}, ValueError, "shape_weight must be .*'1'"),
        ({"upright_weight": None}, ValueError, "upright_weight must be .*None"),
        ({"expected_error": 0}, ValueError, "expected_error must be positive"),
        ({"robust": -3.0}, ValueError, "robust must be positive .*-3"),
        ({"robust": "yes"}, TypeError, "robust must be a number, or one .*: got 'yes'"),
        ({"robust": [10.0, 0.0]}, ValueError, r"robust must be positive .*\[10.0, 0.0\]"),
        ({"robust": [1.0, 2.0, 3.0]}, ValueError, r"robust must fit the batch axes .*\(3,\)"),
        ({"fit_shape": "no"}, TypeError, "fit_shape must be True or False: got 'no'"),
        ({"starts": 0}, ValueError, "starts must be a whole number of at least 1: got 0"),
        ({"starts": 2.5}, ValueError, "starts .*2.5"),
        ({"starts": True}, ValueError, "starts .*True"),
        ({"max_steps": 0}, ValueError, "max_steps of the search must be .*got 0"),
    ],
)
def test_what_is_wrong_is_said(wrong, kind, message, call):
    with pytest.raises(kind, match=message):
        call(**wrong)


def test_a_half_of_two_people_needs_no_second_layout():
    assert count_points([POINTS, POINTS]) == count_points(POINTS) == 22
    assert count_points(POINTS.tolist()) == 22


def test_what_is_not_seen_is_forgotten(dtype):
    """NaN times zero is NaN: it must not reach a product."""
    body = embedded_body()
    points = np.stack([SPOILT, POINTS]).astype(dtype)
    trust = np.stack([(np.arange(22) != 3), np.arange(22) > 4]).astype(dtype)
    start = (np.zeros((52, 3)), None, None)
    people, batch = as_people(body, points, trust, start, None, 20.0)
    assert batch == (2,) and people.keypoints.dtype == dtype
    assert np.isfinite(people.keypoints).all()
    np.testing.assert_array_equal(people.keypoints[0][trust[0] > 0], POINTS[trust[0] > 0])
    # A hundredth of the larger side of the box around what is seen.
    for row, seen_there in enumerate(trust > 0):
        side = np.ptp(points[row][seen_there], axis=0).max()
        np.testing.assert_allclose(people.pixels[row], 0.01 * side, rtol=1e-5)
    np.testing.assert_allclose(people.robust, 20.0 / np.asarray(people.pixels), rtol=1e-6)
    assert all(leaf.dtype == dtype for leaf in people.start)


def test_one_point_has_an_expected_error_too():
    start = (np.zeros((52, 3)), None, None)
    one = np.zeros(22)
    one[7] = 1
    people, _ = as_people(embedded_body(), POINTS, one, start, None, None)
    assert people.pixels[0] == 0.5


def test_starts_of_ones_own_go_to_every_person():
    shape = np.array([1.0, -1.0])
    people, batch = as_people(
        embedded_body(),
        np.stack([[POINTS] * 3] * 2),
        None,
        (frames("run/0010")[0], shape, None),
        5.0,
        None,
    )
    assert batch == (2, 3)
    assert people.start.pose.shape == (6, 52, 3)
    np.testing.assert_array_equal(people.start.shape[4], [1, -1] + [0] * 8)
    np.testing.assert_array_equal(people.pixels, np.full(6, 5.0))


def test_traced_keypoints_pass_where_values_cannot_be_known():
    def pixels(points, trust):
        start = (jnp.zeros((52, 3)), None, None)
        return as_people(embedded_body(), points, trust, start, None, None)[0].keypoints

    found = jax.jit(pixels)(jnp.asarray(SPOILT), jnp.asarray(0 * ONES))
    np.testing.assert_array_equal(found, np.zeros((1, 22, 2)))


@pytest.mark.parametrize("kind", [Stages, Scene])
def test_what_is_wrong_with_a_solver_is_said(kind, untyped):
    name = f"of the {kind.__name__.lower()}"
    with pytest.raises(TypeError, match=f"solver {name} must be .*minimiser.*LevenbergMarquardt"):
        kind(solver=optx.LevenbergMarquardt(1e-3, 1e-3))
    with pytest.raises(ValueError, match=f"max_steps {name} must be .*got 0"):
        kind(max_steps=0)


def test_what_is_wrong_with_a_scene_is_said(untyped):
    with pytest.raises(ValueError, match="weights must be finite"):
        Scene(weights=[-1.0])
    with pytest.raises(ValueError, match="margin must be finite and not negative"):
        Scene(margin=-1.0)


def test_nothing_is_told_of_steps_where_values_are_traced():
    def traced(points):
        options = {"layout": "smpl", "regularizer": "none", "on_step": print}
        return fit_pose(embedded_body(), points, camera(), **options).pose

    with pytest.raises(TypeError, match="on_step must be left out where values are traced"):
        jax.eval_shape(traced, jnp.asarray(POINTS))
