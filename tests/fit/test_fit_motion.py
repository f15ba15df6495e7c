"""Motions: each frame near the one before, one shape, one program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body, mocap
from helpers_fit import camera, seen

from spt_jax.fit import Start, Terms, fit_motion, fit_pose, pose_prior
from spt_jax.fit.motion import near_pose
from spt_jax.keypoints import Person


def test_the_product_of_two_gaussians_is_one():
    """Costs differ by a constant: -2 log of a product is a sum."""
    prior = pose_prior(("pelvis", "spine1", "left_knee"))
    rng = np.random.default_rng(0)
    last, *poses = jnp.asarray(rng.normal(scale=0.4, size=(9, 3, 3)), jnp.float32)
    both = near_pose(prior, last, 0.2)

    def total(pose):
        return prior(pose) + jnp.sum(((pose - last)[1:] / 0.2) ** 2)

    apart = np.array([float(total(pose) - both(pose)) for pose in poses])
    np.testing.assert_allclose(apart, apart[0], rtol=1e-3)
    assert both.mean.dtype == prior.mean.dtype
    np.testing.assert_allclose(near_pose(prior, last, 1e-4).mean[1:], last[1:], atol=1e-4)
    np.testing.assert_allclose(near_pose(prior, last, 1e4).mean, prior.mean, atol=1e-4)
    # A frame that was lost says nothing of the next.
    assert near_pose(prior, last * jnp.nan, 0.2) is prior


def person(points, layout="smpl22"):
    return Person(np.asarray(points), np.ones(len(points)), layout)


def test_what_is_no_motion_is_said(untyped):
    body, points = embedded_body(), np.zeros((22, 2))
    one = person(points)
    for frames, options, message in (
        ([None, None], {}, "must show the person at least once"),
        ([one, person(points[:17], "coco17")], {}, "must have one layout: got coco17, smpl22"),
        ([one], {"terms": Terms(prior=None)}, 'must be "mocap" or a Gaussian.*got None'),
    ):
        with pytest.raises(ValueError, match=message):
            fit_motion(body, frames, camera(), regularizer="none", **options)
    prior = pose_prior(body.joint_names)
    with pytest.raises(ValueError, match="speed must be positive and finite, in radians: got 0"):
        near_pose(prior, prior.mean, 0.0)


@pytest.mark.long
def test_a_run_is_smoother_as_a_motion_than_frame_by_frame():
    body = embedded_body()
    first = mocap().names.index("run/0010")
    pose = body.pose_from_smpl(jnp.asarray(mocap().pose[first : first + 5]))
    shape = jnp.asarray([1.0, -0.5, *[0.0] * 8])
    noise = np.random.default_rng(0).normal(scale=3.0, size=(5, 22, 2))
    points = np.asarray(seen(pose, shape=jnp.stack([shape] * 5))) + noise
    frames = [person(one) for one in points]
    told = []
    options = {"regularizer": "none", "start": Start(shape=shape)}
    with jax.log_compiles(False):
        found = fit_motion(
            body,
            [frames[0], None, *frames[1:]],
            camera(),
            on_frame=lambda number, fit: told.append(number),
            **options,
        )
    assert told == found.frames.tolist() == [0, 2, 3, 4, 5]
    np.testing.assert_array_equal(found.shape, shape)
    alone = fit_pose(body, frames, camera(), **options)

    def jerk(fits):
        joints = np.asarray(fits.joints)
        about = joints[:, 1:22] - joints[:, :1]  # depth is no better known than in a single image
        return np.linalg.norm(np.diff(about, 2, axis=0), axis=-1).mean()

    assert jerk(found.fits) < 0.7 * jerk(alone)
    off = np.linalg.norm(np.asarray(found.fits.keypoints) - points, axis=-1)
    assert off.mean() < 6  # pixels, of noise of 3 along each axis
    truth = body(pose, jnp.stack([shape] * 5))
    error = np.asarray(found.fits.vertices - found.fits.joints[:, :1] - truth.vertices)
    error = np.linalg.norm(error + np.asarray(truth.joints[:, :1]), axis=-1).mean()
    assert error < 0.15  # metres; depth is guessed from the prior
    assert found.as_dict()["frames"] == [0, 2, 3, 4, 5]
