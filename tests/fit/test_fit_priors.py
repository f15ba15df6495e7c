"""Priors: a mixture against SciPy's densities, parts of a pose, and functions of the user's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mocap
from helpers_fit import frames, objective, seen
from scipy.stats import multivariate_normal

from spt_jax.body.poses import SMPL_LAYOUTS
from spt_jax.fit import FunctionPosePrior, MixturePosePrior, PosePrior, mixture_prior, pose_prior
from spt_jax.fit.problem.priors import GaussianPosePrior

NAMES = SMPL_LAYOUTS[22]
ARMS = (0, 16, 17, 18, 19)


def poses(count=6):
    return jnp.asarray(mocap().pose[:: len(mocap().pose) // count][:count, :22])


# The mixture takes ten seconds to fit.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mixture():
    return mixture_prior(NAMES, 3)


def densities(prior, pose):
    """-2 log(weight * density) of each component."""
    found = []
    for weight, mean, whitening in zip(prior.weights, prior.means, prior.whitenings, strict=True):
        inverse = np.linalg.inv(np.asarray(whitening, np.float64))
        given = np.asarray(pose, np.float64)[1:].ravel(), np.asarray(mean, np.float64)[1:].ravel()
        log = multivariate_normal.logpdf(*given, inverse @ inverse.T)
        found.append(-2 * (np.log(float(weight)) + log))
    return np.array(found)


def test_a_mixture_costs_what_its_likeliest_component_does(mixture, dtype):
    floor = min(densities(mixture, mean).min() for mean in mixture.means)
    for pose in poses():
        cost = mixture(pose.astype(dtype))
        assert cost.dtype == dtype
        expected = densities(mixture, pose).min() - floor
        np.testing.assert_allclose(cost, expected, rtol=2e-3, atol=0.01)


def test_a_mixture_is_likelier_than_one_gaussian(mixture):
    """Of the poses that it was learned from, by the whole sum."""
    np.testing.assert_allclose(mixture.weights.sum(), 1, rtol=1e-5)
    one = pose_prior(NAMES)
    single = MixturePosePrior(jnp.ones(1), one.mean[None], one.whitening[None])
    some = poses(40)

    def mean_log(prior):
        rows = np.array([-densities(prior, pose) / 2 for pose in some])
        return np.logaddexp.reduce(rows, axis=1).mean()

    assert mean_log(mixture) > mean_log(single) + 1
    np.testing.assert_allclose(single(some[3]), one(some[3]), rtol=1e-5)
    np.testing.assert_allclose(single.middle(), one.middle())


def test_the_mixture_of_some_joints_is_the_marginal(mixture):
    part = mixture.of_joints(ARMS)
    rows = np.array([3 * (k - 1) + axis for k in ARMS[1:] for axis in range(3)])
    for whole, small in zip(mixture.whitenings, part.whitenings, strict=True):
        covariance, own = (np.linalg.inv(np.asarray(w.T @ w, np.float64)) for w in (whole, small))
        np.testing.assert_allclose(own, covariance[np.ix_(rows, rows)], rtol=1e-2, atol=1e-4)
    np.testing.assert_array_equal(part.means, mixture.means[:, np.array(ARMS)])


def test_derivatives_of_a_mixture_are_those_of_the_component(mixture):
    pose = poses()[2] + 0.1
    forward, reverse = jax.jacfwd(mixture)(pose), jax.grad(mixture)(pose)
    np.testing.assert_allclose(forward, reverse, rtol=1e-3, atol=1e-3)
    step = 1e-2 * reverse / jnp.linalg.norm(reverse)
    slope = (mixture(pose + step) - mixture(pose - step)) / 2
    np.testing.assert_allclose(slope, jnp.sum(reverse * step), rtol=1e-2)
    assert np.isfinite(jax.grad(mixture)(mixture.means[0])).all()


def test_a_function_of_ones_own_sees_the_whole_pose():
    """The joints that no keypoint moves are the start's."""
    pose = frames("walk/0010")[0]
    case = objective(seen(pose), start=(pose, jnp.zeros(10), jnp.zeros(3)))
    usual = pose_prior([f"joint{k}" for k in range(52)])  # standard deviations of 0.3 rad
    own = FunctionPosePrior(lambda full: (full - usual.mean)[1:] / 0.3, usual.mean)
    held = own.of_joints(case.figure.moving).around(pose)
    moved = case.moved(case.pack(case.start)).pose
    np.testing.assert_allclose(held(moved), usual(pose), rtol=1e-4)
    assert isinstance(held, PosePrior)
    np.testing.assert_array_equal(held.middle(), pose[np.array(case.figure.moving)])
    part = usual.of_joints(case.figure.moving)
    assert isinstance(part.around(pose), GaussianPosePrior)


@pytest.mark.parametrize("components", [0, 2.0, True, 10_000])
def test_what_is_no_number_of_components_is_said(components, untyped):
    with pytest.raises(ValueError, match=r"components must be .* from 1 to .*2172: got"):
        mixture_prior(NAMES, components)
