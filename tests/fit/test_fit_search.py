"""Where fits start, which depth flips they try, and the solver that knows when to stop."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import embedded_body
from helpers_fit import UPRIGHT, camera, figure, frames, objective, seen
from scipy.spatial.transform import Rotation

from spt_jax import PinholeCamera
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.search.candidates import find_candidates, refine_start
from spt_jax.fit.search.flips import combined_flips, limb_flips, limbs_of
from spt_jax.fit.search.starts import orientation_starts
from spt_jax.fit.solver import SettledBFGS, default_solver


def turned(pose, *turns):
    """The pose seen from other sides: its root turned about the world's axes."""
    root = Rotation.from_rotvec(np.asarray(pose[0], np.float64))
    rows = [pose.at[0].set(jnp.asarray((turn * root).as_rotvec(), pose.dtype)) for turn in turns]
    return jnp.stack(rows)


# Depth flips.


@pytest.fixture(scope="module")
def flipped():
    """A case, a place in it, and all flips from there, in float64."""
    with jax.enable_x64(True):
        pose = frames("dance_a/0040")[0].astype(jnp.float64)
        case = objective(np.asarray(seen(pose)))
        shift = jnp.array([0.2, -0.1, 0.3])
        vector = case.pack(Variables(pose, case.start.shape, shift))
        limbs = limbs_of(case.figure.body)
        flips = jax.jit(lambda x: limb_flips(case, x, limbs))
    return case, vector, limbs, flips


def joints_of(case, vectors):
    body = case.figure.body

    def joints(vector):
        return case.figure.posed(case.viewer.to_world(body, case.moved(vector))).joints

    return np.asarray(jax.jit(jax.vmap(joints))(vectors))


def pixels_of(case, vectors):
    return np.asarray(jax.jit(jax.vmap(case.project))(vectors))


def test_a_flip_looks_the_same_and_lies_on_the_other_side(flipped, x64):
    case, vector, limbs, flips = flipped
    found = flips(vector)
    assert found.shape == (12, len(vector))
    before, after = joints_of(case, vector[None])[0], joints_of(case, found)
    drawn, redrawn = pixels_of(case, vector[None])[0], pixels_of(case, found)
    eye = camera(np.float64)
    ways = [(True, False), (False, True), (True, True)]
    for row, (limb, way) in enumerate([(limb, way) for limb in limbs for way in ways]):
        first, middle, last = limb
        # All that was moved is this limb's; what hangs at its end comes along.
        below = {j for j in range(22) if limb[0] in ancestors(case.figure.body.parents, j)}
        others = [j for j in range(22) if j not in below]
        np.testing.assert_allclose(after[row, others], before[others], atol=1e-9)
        # A flipped bone's end stays on its line of sight, and its joint with it. What a flipped
        # upper bone carries is moved in depth, and looks a little larger or smaller.
        exact = [middle] if way[0] else [middle, last]
        np.testing.assert_allclose(redrawn[row, exact], drawn[exact], atol=1e-3)
        longest = np.linalg.norm(drawn[[first, middle]] - drawn[[middle, last]], axis=1).max()
        assert np.linalg.norm(redrawn[row, last] - drawn[last]) < 0.5 * longest
        # Bones keep their lengths.
        for a, b in ((first, middle), (middle, last)):
            np.testing.assert_allclose(
                np.linalg.norm(after[row, b] - after[row, a]),
                np.linalg.norm(before[b] - before[a]),
                atol=1e-9,
            )
        # Mirrored in the plane across the line of sight through the flipped bone's end.
        start, end = (first, middle) if way[0] else (middle, last)
        sight = before[end] - eye_of(eye)
        sight /= np.linalg.norm(sight)
        bone = before[end] - before[start]
        mirror = bone - 2 * (bone @ sight) * sight
        np.testing.assert_allclose(after[row, end] - after[row, start], mirror, atol=1e-9)


def ancestors(parents, joint):
    found = {joint}
    while joint >= 0:
        found.add(joint)
        joint = parents[joint]
    return found


def eye_of(eye):
    return -np.asarray(eye.rotation).T @ np.asarray(eye.translation)


def test_flipping_twice_comes_back(flipped, x64):
    case, vector, _, flips = flipped
    there = flips(vector)
    # Ways that flip one bone, to and fro.
    back = jnp.stack([flips(there[row])[row] for row in (0, 1, 4, 9)])
    before = joints_of(case, vector[None])
    np.testing.assert_allclose(joints_of(case, back), np.repeat(before, 4, axis=0), atol=1e-8)


def test_combined_flips_are_the_cheapest_sums(flipped, x64, rng):
    case, vector, limbs, flips = flipped
    found = flips(vector)
    cost, costs = 5.0, rng.uniform(3.0, 9.0, len(found))
    costs[7] = np.nan  # a fit that was lost is not taken
    mixed = combined_flips(case, limbs, vector, jnp.asarray(cost), found, jnp.asarray(costs), 40)
    sums = {}
    for ways in itertools.product(range(4), repeat=4):
        rows = [3 * limb + way - 1 for limb, way in enumerate(ways) if way]
        sums[ways] = sum(costs[row] - cost for row in rows)
    best = sorted((ways for ways in sums if np.isfinite(sums[ways])), key=sums.get)[:40]
    plain = case.moved(vector).pose
    singles = [case.moved(x).pose for x in found]
    for row, ways in zip(mixed, best, strict=True):
        expected = np.array(plain)
        for limb, way in enumerate(ways):
            if way:
                joints = np.array(limbs[limb])
                expected[joints] = singles[3 * limb + way - 1][joints]
        np.testing.assert_allclose(case.moved(row).pose, expected, atol=1e-12)
        np.testing.assert_array_equal(row[-3:], vector[-3:])


# Starts.


def degrees_apart(starts, root):
    found = Rotation.from_rotvec(np.asarray(starts.pose[:, 0], np.float64))
    return np.degrees((found * Rotation.from_rotvec(root).inv()).magnitude())


@pytest.fixture(scope="module")
def starting():
    """Six starts, in the world, for keypoints of the embedded body's SMPL joints, compiled once."""

    def starts(keypoints, confidence, eye):
        case = objective(keypoints, confidence=confidence, camera=eye)
        return jax.vmap(case.unpack)(orientation_starts(case, 6))

    return jax.jit(starts)


SIDES = Rotation.from_euler(
    "xyz",
    [[0, 0, 0], [0, 90, 0], [0, 180, 0], [0, -130, 10], [40, 20, 90], [0, 60, 180], [90, 0, 0]],
    degrees=True,
)


def test_one_of_the_starts_is_near_the_truth(starting):
    mean = objective(np.zeros((22, 2), np.float32)).start.pose
    eye = camera(distance=6.0)
    for pose in turned(mean, *SIDES):
        starts = starting(seen(pose, by=eye), jnp.ones(22), eye)
        apart = degrees_apart(starts, np.asarray(pose[0], np.float64))
        assert apart.min() < 25
        # Where the body stands follows from its size, to a fifth of the distance.
        np.testing.assert_allclose(starts.translation[apart.argmin()], 0, atol=1.2)


def test_the_mirror_image_under_a_distant_camera_is_among_the_starts(starting):
    """A flat trunk that leans towards the camera and its mirror image look alike."""
    mean = objective(np.zeros((22, 2), np.float32)).start.pose
    eye = camera(distance=40.0, focal=10_000.0)
    across = np.diag([1.0, 1.0, -1.0])  # the camera looks along the world's -z
    for angle in (-40, 50):
        pose = turned(mean, Rotation.from_euler("y", angle, degrees=True))[0]
        starts = starting(seen(pose, by=eye), jnp.ones(22), eye)
        root = Rotation.from_rotvec(np.asarray(pose[0], np.float64))
        mirror = Rotation.from_matrix(across @ root.as_matrix() @ across)
        assert (root.inv() * mirror).magnitude() > 1
        assert degrees_apart(starts, root.as_rotvec()).min() < 25
        assert degrees_apart(starts, mirror.as_rotvec()).min() < 25


@pytest.mark.parametrize("what", ["one point", "one place", "nothing", "on a line"])
def test_starts_are_finite_where_there_is_little_to_go_by(what, starting):
    keypoints, trust = np.full((22, 2), 700.0, np.float32), np.ones(22, np.float32)
    if what == "one point":
        trust[1:] = 0
    elif what == "nothing":
        trust[:] = 0
    elif what == "on a line":
        keypoints[:, 1] += np.arange(22)
    starts = starting(jnp.asarray(keypoints), jnp.asarray(trust), camera())
    assert all(np.isfinite(part).all() for part in starts)
    if what != "nothing":
        # The pelvis is in front of the camera.
        pelvis = starts.translation + embedded_body().joint_template[:1]
        assert (camera().to_camera(pelvis)[:, 2] > 0.2).all()


def test_starts_follow_the_camera(starting):
    """The same image from another camera: the same bodies in that camera's axes."""
    pose = turned(frames("walk/0010")[0], SIDES[3])[0]
    eye = camera()
    keypoints = seen(pose, by=eye)
    turn = Rotation.from_euler("xyz", (20, 200, -35), degrees=True).as_matrix()
    rotation = (UPRIGHT @ turn.T).astype(np.float32)
    other = PinholeCamera(eye.focal, eye.center, rotation, np.float32([0.3, -1.0, 2.0]))
    first, second = (starting(keypoints, jnp.ones(22), which) for which in (eye, other))
    for a, b in zip(first.pose[:, 0], second.pose[:, 0], strict=True):
        one, two = (
            np.asarray(which.rotation) @ Rotation.from_rotvec(np.asarray(x)).as_matrix()
            for which, x in ((eye, a), (other, b))
        )
        np.testing.assert_allclose(one, two, atol=2e-4)


# The search.


class Stays(optx.AbstractMinimiser):
    """Ends where it begins, after two steps."""

    rtol: float = 1e-3
    atol: float = 1e-3
    norm: Any = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return jnp.array(0)

    def step(self, fn, y, args, options, state, tags):
        return y, state + 1, fn(y, args)[1]

    def terminate(self, fn, y, args, options, state, tags):
        return state >= 2, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def test_candidates_are_the_best_different_ones():
    """With a solver that does nothing, what was tried is what was begun with."""
    starts = 60
    case = objective(seen(frames("run/0010")[0]))
    limbs = limbs_of(case.figure.body)
    found, first = jax.jit(
        lambda: (
            find_candidates(case, limbs, starts, Stays(), 4, 5),
            orientation_starts(case, starts),
        )
    )()
    costs, before = (np.asarray(jax.jit(jax.vmap(case.cost))(x)) for x in (found.vectors, first))
    np.testing.assert_allclose(found.costs, costs, rtol=1e-4)
    assert (np.diff(costs) > 0).all()
    assert costs[0] <= 1.0001 * before.min()
    rounds = 2 + -(-24 // starts)  # two fits have twelve flips each
    assert found.steps == 2 * rounds * starts
    apart = np.abs(found.vectors[:, None] - found.vectors[None]).max(axis=-1)
    assert (apart[~np.eye(5, dtype=bool)] > 0.1).all()


def test_from_a_start_of_ones_own_there_is_one_candidate():
    pose = frames("run/0010")[0]
    case = objective(seen(pose), start=Variables(0.9 * pose, np.zeros(10), np.zeros(3)))
    found, before = jax.jit(
        lambda: (refine_start(case, default_solver(), 60), case.cost(case.pack(case.start)))
    )()
    assert found.vectors.shape == (1, 69)
    assert found.costs[0] < 0.25 * before


def test_limbs_are_those_that_the_body_has():
    assert len(limbs_of(figure().body)) == 4
    part = figure(("pelvis", "neck", "left_wrist")).body
    names = [tuple(part.joint_names[joint] for joint in limb) for limb in limbs_of(part)]
    assert names == [("left_shoulder", "left_elbow", "left_wrist")]


# The solver.


def rosenbrock(x, _):
    return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)


def quadratic(x, _):
    scale = jnp.arange(1, x.size + 1, dtype=x.dtype)
    return jnp.sum(scale * (x - 3) ** 2) + 7


@pytest.mark.parametrize("function", [rosenbrock, quadratic])
def test_the_settled_solver_finds_the_minimum_that_bfgs_finds(function, dtype):
    start = jnp.asarray([0.8, 1.1, 1.2, 1.3], dtype)
    fine = dtype == np.float64
    tolerance = 1e-9 if fine else 1e-5
    found = {
        kind: optx.minimise(function, kind(tolerance, tolerance), start, max_steps=400, throw=False)
        for kind in (optx.BFGS, SettledBFGS)
    }
    exact = np.ones(4) if function is rosenbrock else np.full(4, 3.0)
    settled = found[SettledBFGS]
    np.testing.assert_allclose(settled.value, exact, atol=1e-6 if fine else 2e-2)
    assert settled.result == optx.RESULTS.successful
    assert settled.stats["num_steps"] <= found[optx.BFGS].stats["num_steps"]


def test_the_settled_solver_ends_at_a_floor_of_noise():
    """At a minimum that rounding has reached every further step is refused, and halved."""

    def noisy(x, _):
        return 1e4 + quadratic(x, _) + 2e-3 * jnp.sum(jnp.sin(1e5 * x))

    found = {
        kind: optx.minimise(noisy, kind(1e-3, 1e-3), jnp.full(6, 2.9), max_steps=60, throw=False)
        for kind in (optx.BFGS, SettledBFGS)
    }
    settled = found[SettledBFGS]
    assert settled.result == optx.RESULTS.successful
    assert settled.stats["num_steps"] < found[optx.BFGS].stats["num_steps"]
    np.testing.assert_allclose(settled.value, 3.0, atol=0.2)
