"""A limb that has passed through another part: the sides on which it could be, by a search.

The descent follows the overlap's gradient, which leads out on the side where the overlap is less
now, be it the longer way. Which side is clear is found by trying: the limb is swung about its
root, around twelve axes and farther and farther, until nothing collides, and back as far as nothing
does. From the nearest of these places the descent starts again, with weights that are too strong to
let it pass through once more.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from spt_jax.body.base import AbstractBody
from spt_jax.body.swings import free_starts, limbs_in_collision, rms
from spt_jax.overlap.measure import Measurement, Unmeasurable
from spt_jax.untangle.descent import CENTIMETRE, Search, descend, is_near, turned, vertices_of

# A descent that moves the vertices farther than this, in metres and root mean square, may have gone
# out on the wrong side: of 1,086 frames of motion capture one in a hundred does. And from how many
# other sides it is tried again.
_FAR = 0.06
_MOST_STARTS = 3
_WEIGHTS = (3.0, 30.0, 100.0)


class Side(NamedTuple):
    """A pose without collisions that the descent found from another side.

    Attributes:
        pose, vertices: the pose, and the body in it.
        found: what was measured of it.
        steps: of the solver, over all sides.
        moved: the root mean square of how far the vertices have moved.
    """

    pose: Array
    vertices: Array
    found: Measurement
    steps: int
    moved: float


def other_side(
    search: Search, body: AbstractBody, fixed: Any, before: Measurement, after: Measurement
) -> Side | None:
    """The nearest pose without collisions on another side, where it is nearer than what was found.

    Args:
        search: what stays the same.
        body: a body whose pose is one rotation vector for each joint; others have no sides here.
        fixed: pose, shape and translation given, and the factor of the displacement.
        before: what was measured of the pose given.
        after: and of the best one that the descent found from there.
    """
    pose, shape, translation, factor = fixed
    best, steps = None, 0
    least = rms(before.vertices, after.vertices) if search.is_free(after) else np.inf
    single = pose.shape == (len(body.parents), 3) and len(body.faces) == len(before.faces)
    if search.folds == "count" or not single or least <= _FAR:
        return None

    def look(at):
        vertices = vertices_of(body, jnp.asarray(at, pose.dtype), shape, translation)
        found = search.measure(vertices, before.faces)
        return search.is_free(found), found.vertices

    given = np.array(pose, np.float64)  # SciPy wants arrays that may be written to
    limbs = limbs_in_collision(before, body.part_groups, body.parents)
    for start in free_starts(given, limbs, look, _MOST_STARTS):
        turn = (start.pose - given)[np.asarray(body.free_rows)].ravel() / CENTIMETRE
        moved = jnp.asarray(np.asarray(factor, np.float64).T @ turn, pose.dtype)
        for weight in _WEIGHTS:
            weight = jnp.asarray(weight, pose.dtype)
            moved, taken, _ = descend(search, body, fixed, moved, search.margin, weight)
            steps += int(taken)
            at = turned(body, pose, factor, moved)
            if not is_near(at, pose):
                break
            vertices = vertices_of(body, at, shape, translation)
            try:
                found = search.measure(vertices, before.faces)
            except Unmeasurable:
                break
            if search.is_free(found):
                far = rms(before.vertices, found.vertices)
                if far < least:
                    best, least = Side(at, vertices, found, steps, far), far
                break
    return best if best is None else best._replace(steps=steps)
