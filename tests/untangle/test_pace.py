"""How long a correction takes follows from how fast the motion is, whatever its frame rate."""

import numpy as np
from helpers_motion import snap, tongs

from spt_jax.untangle.corrections import Frames
from spt_jax.untangle.frame_cuts import prior
from spt_jax.untangle.pace import paces


def frames_of(pose):
    count = len(pose)
    return Frames(
        pose[:, None], np.zeros((count, 1, 1), np.float32), np.zeros((count, 1, 3), np.float32)
    )


def test_slow_motions_take_longer_and_faster_ones_less():
    body, pose = tongs(), frames_of(snap())
    slow, plain, fast = (paces(body, pose, rate, 0.02) for rate in (10.0, 120.0, 480.0))
    assert (slow == 0.05).all()  # as much as there is
    at = len(plain) // 2
    assert fast[at] < plain[at] < slow[at]
    assert fast.min() >= 0.005 and plain.shape == (41,)


def test_a_finer_frame_rate_changes_nothing():
    body = tongs()
    finer = snap(frames=161, width=16.0)
    fine = paces(body, frames_of(finer), 240.0, 0.02)[::4]
    coarse = paces(body, frames_of(finer[::4]), 60.0, 0.02)
    np.testing.assert_allclose(coarse[4:-4], fine[4:-4], rtol=0.25)


def test_what_stands_still_and_what_is_too_short_have_a_time():
    body = tongs()
    assert (paces(body, frames_of(snap()[:2]), 30.0, 0.02) == 0.02).all()
    assert (paces(body, frames_of(np.repeat(snap()[:1], 12, 0)), 30.0, 0.02) == 0.05).all()


def test_frames_differ_in_how_far_a_push_goes():
    smoothness = np.where(np.arange(80) < 40, 4.0, 1.0)
    kernel = prior(np.zeros((0, 1)), 80, 0, smoothness).kernel
    reach = [np.count_nonzero(kernel[:, k] > 0.25 * kernel[k, k]) for k in (15, 65)]
    assert reach[0] >= 3 * reach[1]
    even = prior(np.zeros((0, 1)), 80, 0, 4.0).kernel
    np.testing.assert_allclose(kernel[5:20, 12], even[5:20, 12], rtol=1e-3)
