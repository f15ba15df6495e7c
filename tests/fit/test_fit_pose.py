"""`fit_pose` as a whole: what it recovers, and what changes of its input do to what it finds.

Each static configuration is compiled once, in a fixture, and many cases share one call.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import embedded_body
from helpers_fit import camera, frames, objective, seen
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from spt_jax import RESULTS, PinholeCamera, fit_pose, intersection_report, keypoint_regressor
from spt_jax._status import names_of
from spt_jax.fit import (
    Regularizer,
    Search,
    SelfIntersection,
    Stages,
    Start,
    Terms,
    Variables,
    as_regularizer,
)
from spt_jax.fit.contact import stages as contact_stages
from spt_jax.fit.setup import prepare_fit
from spt_jax.fit.stages import descend, total_cost
from spt_jax.keypoints import Person

NAMES = (
    "walk/0010",
    "run/0010",
    "dance_a/0040",
    "jump/0020",
    "punch/0017",
    "crawl/0092",
    "walk/0020",
    "spinkick/0030",
)
# As fitted without a regularizer these collide.
COLLIDING = ("punch/0017", "punch/0012")


@pytest.fixture(scope="module")
def people():
    """Eight poses, the bodies in them, and their keypoints."""
    pose = frames(*NAMES)
    return pose, embedded_body()(pose), np.asarray(seen(pose))


def fit(keypoints, by=None, **options):
    """People in one call, without a regularizer: one compilation for all tests that use it."""
    by = camera() if by is None else by
    return fit_pose(embedded_body(), keypoints, by, layout="smpl", regularizer="none", **options)


@pytest.fixture(scope="module")
def plain(people):
    return fit(people[2])


def errors(found, vertices, joints):
    """Mean distance of vertices when both pelvises lie in one place, in millimetres."""
    moved = vertices - joints[:, :1]
    off = np.asarray(found.vertices - found.joints[:, :1]) - np.asarray(moved)
    return 1e3 * np.linalg.norm(off, axis=-1).mean(axis=-1)


def agreeing(first, second, millimetres=5.0):
    """Which people of two results are the same body."""
    return errors(first, second.vertices, second.joints) < millimetres


def test_exact_keypoints_are_met_and_bodies_recovered(people, plain):
    _, posed, keypoints = people
    off = np.linalg.norm(plain.keypoints - keypoints, axis=-1)
    assert off.mean() < 2 and off.max() < 12  # pixels, of people some 400 high
    found = errors(plain, posed.vertices, posed.joints)
    # Depth is guessed from the prior: 54 mm in the median, 282 for one who leans the other way.
    assert np.median(found) < 70 and np.sort(found)[6] < 130
    # Keypoints and vertices of the result belong to its pose.
    again = embedded_body()(plain.pose, plain.shape, plain.translation)
    np.testing.assert_allclose(plain.vertices, again.vertices, atol=1e-5)
    np.testing.assert_allclose(plain.keypoints, camera().project(again.joints[:, :22]), atol=0.05)


def test_terms_sum_to_the_total_and_say_what_was_used(plain):
    terms = dict(plain.terms)
    total = terms.pop("total")
    assert set(terms) == {"reprojection", "prior", "limits", "upright"}
    np.testing.assert_allclose(total, sum(np.asarray(term) for term in terms.values()), rtol=1e-5)
    words = {True: "converged", False: "stopped at the largest number of steps"}
    for reason, ended in zip(plain.reason, plain.converged.tolist(), strict=True):
        assert reason.startswith(words[ended])
    np.testing.assert_array_equal(plain.converged, plain.status == RESULTS.successful)
    assert plain.as_dict()["terms"]["total"] == np.asarray(plain.terms["total"]).tolist()
    assert "successful" in str(plain)
    # Joints below which nothing was seen do not move, and shape that is not fitted stays.
    middle = objective(np.zeros((22, 2), np.float32)).start.pose
    np.testing.assert_array_equal(plain.pose[:, 22:], jnp.stack([middle[22:]] * 8))
    np.testing.assert_array_equal(plain.shape, np.zeros((8, 10)))


def test_bodies_move_with_the_camera_and_the_size_of_the_image(people, plain):
    _, _, keypoints = people
    eye = camera()
    turn = Rotation.from_euler("xyz", (15, 110, -25), degrees=True).as_matrix()
    shift = np.array([0.4, -0.7, 1.1])
    size, corner = 1.7, np.array([40.0, -25.0])
    rotation = np.asarray(eye.rotation) @ turn.T
    other = PinholeCamera(
        size * eye.focal,
        (size * np.asarray(eye.center) + corner).astype(np.float32),
        rotation.astype(np.float32),
        (np.asarray(eye.translation) - rotation @ shift).astype(np.float32),
    )
    found = fit((size * keypoints + corner).astype(np.float32), other)
    moved = np.asarray(plain.vertices) @ turn.T + shift
    off = np.linalg.norm(found.vertices - moved, axis=-1).mean(axis=-1)
    # Where two minima cost the same, rounding chooses; most people have one.
    assert (off < 0.01).sum() >= 6
    np.testing.assert_allclose(found.terms["total"], plain.terms["total"], rtol=0.1, atol=0.5)


def test_order_of_people_a_list_and_what_was_not_seen(people, plain):
    _, _, keypoints = people
    found = fit(list(keypoints[::-1]))
    assert found.pose.shape == (8, 52, 3)
    assert agreeing(jax.tree.map(lambda leaf: leaf[::-1], found), plain).sum() >= 7
    # A point without confidence may be anything.
    trust = np.ones((3, 22), np.float32)
    trust[:, [7, 20]] = 0
    one, two = keypoints[:3].copy(), keypoints[:3].copy()
    one[:, [7, 20]], two[:, [7, 20]] = np.nan, 1e6
    first, second = (fit(points, confidence=trust) for points in (one, two))
    np.testing.assert_array_equal(first.pose, second.pose)
    assert np.isfinite(first.vertices).all()


def test_other_values_do_not_compile_anew(people, plain, caplog):
    """Neither keypoints, confidence, weights nor the camera's numbers are static."""
    del plain  # compiled by now
    eye = PinholeCamera(
        np.float32(900), np.float32([510, 470]), camera().rotation, np.float32([0, 1, 5])
    )
    with jax.log_compiles():
        found = fit(
            people[2][0] + 1,
            eye,
            confidence=np.full(22, 0.5, np.float32),
            terms=Terms(prior_weight=0.5, upright_weight=0.1, expected_error=6.0),
        )
        jax.jit(lambda x: x + 1)(1.0)
    assert found.pose.shape == (52, 3)
    compiled = [record.getMessage() for record in caplog.records]
    assert any("jit(<lambda>)" in message for message in compiled)
    programs = ("_searched", "_regularize")
    assert not [line for line in compiled if any(f"jit({name})" in line for name in programs)]


@pytest.fixture(scope="module")
def traced(people):
    """One person at a time under vmap and jit, all arguments traced."""

    def one(points, trust, eye):
        return fit(points, eye, confidence=trust)

    call = jax.jit(jax.vmap(one, (0, 0, None)))
    trust = np.ones((5, 22), np.float32)
    trust[4] = 0
    return call(jnp.asarray(people[2][:5]), jnp.asarray(trust), camera())


@pytest.mark.long
def test_under_jit_and_vmap_as_outside(plain, traced):
    assert agreeing(traced, jax.tree.map(lambda leaf: leaf[:5], plain))[:4].all()


def test_who_was_not_seen_at_all_is_said_under_jit(traced):
    assert names_of(traced.status)[4] == "unseen"
    assert traced.reason[4].startswith("no keypoint was seen")
    assert not traced.converged[4]
    for leaf in jax.tree.leaves(traced):
        assert np.isfinite(leaf).all()


def overlap(found):
    body = embedded_body()
    return [
        1e6 * intersection_report(vertices, body.faces, rest_surface=body.rest_surface).volume
        for vertices in found.vertices
    ]


def test_the_penalty_frees_bodies_that_collide():
    """The default, as users call it."""
    keypoints = np.asarray(seen(frames(*COLLIDING)))
    people = [Person(points, np.ones(22, np.float32), "smpl22") for points in keypoints]
    found = fit_pose(embedded_body(), people, camera())
    before, after = overlap(fit(keypoints)), overlap(found)
    assert min(before) > 1  # cm^3
    assert max(after) == 0 and found.reason == ["converged"] * 2
    np.testing.assert_array_equal(found.terms["spt"], 0)
    np.testing.assert_allclose(
        found.terms["total"], sum(v for k, v in found.terms.items() if k != "total"), rtol=1e-5
    )
    # What it costs in the image is little.
    assert np.linalg.norm(found.keypoints - keypoints, axis=-1).mean() < 4


class Crouch(Regularizer):
    """A user's own: how high the head is above the pelvis, squared, in decimetres."""

    name: ClassVar[str] = "crouch"
    weights: Float[Array, "stages"]

    def energy(self, body, start, now):
        joints = body(now.pose, now.shape, now.translation).joints
        head = body.joint_names.index("head")
        return 100 * jnp.sum((joints[:, head, 1] - joints[:, 0, 1]) ** 2)


@pytest.mark.long
def test_ones_own_start_and_regularizer_in_double_precision(x64):
    """From a given pose, with shape, one keypoint wrong, the body's place known."""
    body = embedded_body()
    pose = frames("walk/0010")[0].astype(jnp.float64)
    shape = jnp.asarray([1.0, -1.0, 0.5, *[0.0] * 7])
    shift = jnp.asarray([0.1, 0.05, -0.2])
    keypoints = np.stack([np.asarray(seen(pose, shape=shape, translation=shift))] * 2)
    keypoints[1, 21] += 300.0  # a wrist somewhere else
    near = pose.at[:22].add(0.05)

    def at(weight, robust):
        return fit_pose(
            body,
            keypoints,
            camera(np.float64),
            layout="smpl",
            regularizer=Crouch(jnp.asarray([weight])),
            start=Start(near.at[30].set(0.3), None, shift, fit_shape=True, fit_translation=False),
            terms=Terms(shape_weight=0.01, robust=robust),
            stages=Stages(optx.BFGS(1e-4, 1e-4)),
        )

    loyal = at(0.0, 20.0)
    assert loyal.pose.dtype == loyal.vertices.dtype == jnp.float64
    off = np.linalg.norm(loyal.keypoints - keypoints[:1], axis=-1)
    assert off[0].max() < 3
    # The wrist that is wrong by 300 pixels hardly moves anything else.
    assert np.delete(off[1], 21).max() < 8
    np.testing.assert_array_equal(loyal.translation, jnp.stack([shift] * 2))
    np.testing.assert_array_equal(loyal.pose[:, 22:], jnp.stack([near.at[30].set(0.3)[22:]] * 2))
    np.testing.assert_allclose(loyal.shape[0, :2], shape[:2], atol=0.5)
    # A scale far beyond the mistake is none: the mistake pulls.
    misled = at(0.0, 1e5)
    pulled = np.linalg.norm(misled.keypoints - keypoints[:1], axis=-1)[1]
    assert pulled[21] > 10 * off[1, 21] and pulled[21] > 50
    # What the user's own term costs, it lowers.
    low = at(30.0, 20.0)
    heads = [
        f.joints[0, body.joint_names.index("head"), 1] - f.joints[0, 0, 1] for f in (low, loyal)
    ]
    assert heads[0] < heads[1] - 0.02
    np.testing.assert_allclose(low.terms["crouch"][0], 30 * 100 * heads[0] ** 2, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "solver"),
    [
        ("laplacian", optx.NonlinearCG(1e-3, 1e-3)),
        ("spheres", optx.LBFGS(1e-3, 1e-3)),
        ("paper", optx.GradientDescent(1e-3, 1e-3, 1e-3)),
    ],
)
def test_each_regularizer_descends_with_another_solver(name, solver):
    """The stages alone; "paper" has a gradient that is not its value's, so no line search."""
    body = embedded_body()
    pose = frames("punch/0007")[0]
    paper = SelfIntersection(1.0, folds="count", value="ratio", gradient="unit")
    term = (paper if name == "paper" else as_regularizer(name)).prepared(body, 1)
    start = Variables(pose, np.zeros(10), np.zeros(3))
    case = objective(seen(pose), start=start)
    case = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], case)
    here = jax.vmap(lambda one: one.pack(one.start))(case)
    moved = here if name != "laplacian" else here.at[:, 9:66].add(0.1)

    @jax.jit
    def go(vectors):
        return total_cost(case, vectors), descend(term, body, case, vectors, solver, 15)

    before, after = go(moved)
    assert np.isfinite(after.vectors).all() and after.steps > 0
    now = jax.vmap(lambda one, x: one.unpack(x))(case, moved)
    first = term.energy(body, now, now)
    if name == "laplacian":
        assert after.cost < before
    elif name == "spheres":
        assert first > 1 and after.energy < 0.5 * first
    else:
        assert first > 0.5 and after.energy < first


def test_what_still_intersects_is_said(plain, monkeypatch):
    del plain  # whose search is compiled by now
    body, points = embedded_body(), np.asarray(seen(frames(*COLLIDING)))

    def go(**options):
        found = fit_pose(body, points, camera(), layout="smpl", **options)
        reports = [
            intersection_report(one, body.faces, rest_surface=body.rest_surface)
            for one in np.asarray(found.vertices)
        ]
        return found, [int(report.intersecting_pairs) for report in reports]

    # Too weak a penalty, and no search after it: what intersects stays, and is said if asked for.
    weak = SelfIntersection((1e-4,))
    left, pairs = go(regularizer=weak, stages=Stages(free=False))
    assert all(pairs) and bool(left.converged.all())
    monkeypatch.setattr(contact_stages, "_freed", lambda stages, ends, others: ends[0])
    stuck, pairs = go(regularizer=weak)
    assert all(pairs) and names_of(stuck.status) == ["intersections_left"] * 2
    assert not stuck.converged.any() and "Intersections are left" in stuck.reason[0]


@pytest.mark.long
def test_limbs_are_swung_to_other_sides_where_nothing_else_helps(plain, monkeypatch):
    del plain
    body, point = embedded_body(), np.asarray(seen(frames(COLLIDING[0])))[0]
    begun = []

    def undescended(stages, places):
        begun.extend(stages.tried(place, converged=True) for place in places)
        return begun

    def from_other_sides(stages, ends, others):
        return stages.from_other_sides(ends[0])

    monkeypatch.setattr(contact_stages.Stages, "through", undescended)
    monkeypatch.setattr(contact_stages, "_freed", from_other_sides)
    found = fit_pose(body, point, camera(), layout="smpl")
    assert begun[0].pairs > 0 and names_of(found.status) == "successful"
    off = np.linalg.norm(np.asarray(found.keypoints) - point, axis=-1)
    assert off.mean() < 10


@pytest.mark.slow
def test_too_few_steps_are_said():
    found = fit_pose(
        embedded_body(),
        np.asarray(seen(frames("walk/0010", "run/0010")))[:, :9],
        camera(),
        layout=list(range(9)),
        regularizer="none",
        start=Start(np.zeros((52, 3))),
        terms=Terms(prior=None, limits=None),
        stages=Stages(max_steps=1),
    )
    assert names_of(found.status) == ["nonlinear_max_steps_reached"] * 2
    assert all("stopped at the largest number of steps" in one for one in found.reason)
    assert set(found.terms) == {"reprojection", "upright", "total"}


@pytest.mark.slow
def test_each_stage_is_told_and_the_result_is_the_same():
    body = embedded_body()
    points = np.asarray(seen(frames(COLLIDING[0])))[0]
    steps = []
    usual, told = (
        fit_pose(body, points, camera(), layout="smpl", on_step=on_step)
        for on_step in (None, steps.append)
    )
    # And once more where parts had to be freed after the last weight.
    assert [step.stage for step in steps] in ([0, 1, 2, 3], [0, 1, 2, 3, 4])
    taken = [step.steps for step in steps]
    assert taken == sorted(taken) and taken[-1] == int(told.steps)
    assert steps[0].volume > 1e-6 and steps[0].intersecting_pairs > 0
    assert steps[-1].volume < 0.1 * steps[0].volume
    np.testing.assert_allclose(steps[-1].vertices, told.vertices, atol=1e-6)
    np.testing.assert_array_equal(steps[-1].pose, told.pose)
    assert 1e3 * np.linalg.norm(told.vertices - usual.vertices, axis=-1).mean() < 1


def test_what_a_callback_raises_ends_the_fit(people, plain):
    del plain  # compiled by now

    def stop(step):
        raise KeyboardInterrupt(step.stage)

    with pytest.raises(KeyboardInterrupt, match="0"):
        fit(people[2][0], on_step=stop)


@pytest.mark.long
def test_hands_are_fitted_where_their_points_are_given():
    """A fist: without its points the fingers stay as they were."""
    body = embedded_body()
    pose = frames("walk/0010")[0]
    fist = [
        k for k, name in enumerate(body.joint_names) if name[-1] in "123" and "spine" not in name
    ]
    fist = [k for k in fist if "thumb" not in body.joint_names[k]]
    turn = jnp.array([0.0, 0.0, 1.0])[None]
    sides = jnp.array([-1.0 if "left" in body.joint_names[k] else 1.0 for k in fist])[:, None]
    pose = pose.at[np.array(fist)].set(sides * turn)
    points = np.asarray(seen(pose, layout="body25_hands"))
    trust = np.ones(67, np.float32)
    people = [
        Person(points, np.where(np.arange(67) < count, trust, 0), "body25_hands")
        for count in (67, 25)
    ]
    found = fit_pose(body, people, camera(), regularizer="none", terms=Terms(expected_error=2.0))
    off = np.linalg.norm(np.asarray(found.keypoints) - points, axis=-1)
    hands = np.median(off[:, 25:], axis=1)
    assert off[0].max() < 12 and hands[0] < 2 and hands[1] > 3 * hands[0]
    # Points that lie nowhere on the body are left out, whatever they are.
    whole = "wholebody133"
    face = np.full((133, 2), 7.0, np.float32)
    regressor = keypoint_regressor(body, whole)
    assert regressor.placed is not None and sum(regressor.placed) == 65
    setup = prepare_fit(
        body,
        face,
        camera(),
        layout=whole,
        confidence=None,
        start=Start(),
        terms=Terms(),
        regularizer="none",
        search=Search(),
        stages=Stages(),
    )
    np.testing.assert_array_equal(setup[1].confidence[0], regressor.placed)
    assert setup[0].search.figure.moving == tuple(range(52))
