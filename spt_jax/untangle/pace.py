"""How fast a motion changes from frame to frame, which decides how smooth a correction must be.

A correction that comes and goes within a few hundredths of a second shakes a body that gets up
slowly, and is not seen on one that turns over in the air, whose limbs pass each other in less:
there it would push limbs apart long before they meet. With one time for all motions, the 95 %
quantile of the second differences rose to 1.9 times that of the motion given in somebody who gets
up, while a backflip at 120 frames a second was moved by 25 mm where frame by frame it is moved by
15.

The accelerations of a correction of Y metres that takes s seconds are about Y / s^2. To be no more
than the motion's own A, it wants sqrt(Y / A) seconds; a little more than the root is better,
because what is slow collides deeper and for longer.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from spt_jax.body import AbstractBody
from spt_jax.untangle.corrections import Frames, posed

# The skin's largest acceleration, in m/s^2, at which a correction comes and goes in the time asked
# for: that of somebody who runs or kicks. By what power of it the time changes, and within what.
_KICKING = 45.0
_POWER, _FASTEST, _SLOWEST = 0.6, 0.25, 2.5


def paces(
    body: AbstractBody, frames: Frames, frames_per_second: float, fade: float
) -> Float[np.ndarray, "T"]:
    """The time in which a correction comes and goes, in seconds, frame by frame.

    Args:
        body, frames: the motion.
        frames_per_second: its rate.
        fade: the time where the motion is as fast as a kick.
    """
    count = len(frames.pose)
    if count < 3:
        return np.full(count, fade)
    fastest = _second_differences(body, frames) * frames_per_second**2
    fastest = np.concatenate([fastest[:1], fastest, fastest[-1:]])
    around = 2 * int(np.ceil(fade * frames_per_second)) + 1
    fastest = np.maximum(uniform_filter1d(fastest, around, mode="nearest"), 1e-9)
    return fade * np.clip((_KICKING / fastest) ** _POWER, _FASTEST, _SLOWEST)


def _second_differences(body, frames: Frames) -> Float[np.ndarray, "N"]:
    """Of each frame but the first and the last, that of the vertex which has the largest."""
    found, last = [], np.zeros((0, 0, 3))
    for count, batch in frames.batches():
        vertices = np.asarray(posed(body, batch), np.float64)[:count]
        known = np.concatenate([last, vertices]) if len(last) else vertices
        if len(known) > 2:
            found.append(np.linalg.norm(np.diff(known, n=2, axis=0), axis=-1).max(axis=1))
        last = known[-2:]
    return np.concatenate(found)
