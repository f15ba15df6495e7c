"""What no photograph shows: bodies too near, too far, too small or too large, or wider angles."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax._status import RESULTS
from spt_jax.fit.problem.objective import Objective

# In metres, of what was seen of a person: from a hand before the lens to a figure at which COCO's
# annotators stop marking keypoints, about 30 pixels tall, under the longest of lenses.
NEAREST, FARTHEST = 0.1, 200.0
# In metres, of a posed body's longest side along an axis: a newborn curled up, a tall man stretched
# out and some room for what a shape fit may do.
SMALLEST, LARGEST = 0.2, 4.0
# In pixels: no detector resolves the keypoints of a smaller person.
LEAST_PIXELS = 8.0
# In degrees: the corners of the widest lenses that keep lines straight are 67 degrees off the axis.
WIDEST = 70.0

# What `outside_photographs` finds, and the status of a fit that says so, limits and all.
DISTANCE, SIZE, FOCAL = 1, 2, 3
STATUSES = {
    DISTANCE: RESULTS.outside_distance,
    SIZE: RESULTS.outside_size,
    FOCAL: RESULTS.outside_focal_length,
}

_SLOPE = float(np.tan(np.radians(WIDEST)))


def outside_photographs(
    objective: Objective, vector: Float[Array, "D"], vertices: Float[Array, "V 3"]
) -> Int[Array, ""]:
    """Why no photograph could show a fit: DISTANCE, SIZE or FOCAL; 0 if one could.

    Args:
        objective: of the person; its seen keypoints determine the distance.
        vector: where the fit ended.
        vertices: of the body, in metres.

    Differentiation: none is meant; it runs under jit and vmap.
    """
    camera, seen, dtype = objective.viewer.camera, objective.confidence > 0, vector.dtype
    points = objective.figure.posed(objective.moved(vector)).points
    depths = camera.to_camera(points)[:, 2]
    count = jnp.maximum(jnp.sum(seen), 1).astype(dtype)
    distance = jnp.sum(jnp.where(seen, depths, 0).astype(dtype)) / count
    focal, center = camera.focal.astype(dtype), camera.center.astype(dtype)
    slopes = jnp.linalg.norm((objective.keypoints - center[None]) / focal[None], axis=-1)
    side = jnp.max(jnp.max(vertices, axis=0) - jnp.min(vertices, axis=0)).astype(dtype)
    pixels = jnp.mean(focal) * side / distance
    size = (side < SMALLEST) | (side > LARGEST) | (pixels < LEAST_PIXELS)
    status = jnp.where(size, SIZE, 0)
    status = jnp.where((distance < NEAREST) | (distance > FARTHEST), DISTANCE, status)
    # The median: one point far outside the image is a mistake of the detector's.
    wide = jnp.nanmedian(jnp.where(seen, slopes, jnp.nan)) > _SLOPE
    return jnp.where(wide, FOCAL, status)


def is_too_wide(camera: PinholeCamera, size: tuple[int, int]) -> bool:
    """Whether an image of that width and height has a corner that no lens would show.

    Example:
        >>> from spt_jax._camera import PinholeCamera
        >>> is_too_wide(PinholeCamera(35.0, (320.0, 240.0)), (640, 480))  # millimetres
        True
    """
    corners = np.array([(x, y) for x in (0, size[0]) for y in (0, size[1])], np.float64)
    slopes = (corners - np.asarray(camera.center)) / np.asarray(camera.focal)
    return bool(np.linalg.norm(slopes, axis=-1).max() > _SLOPE)
