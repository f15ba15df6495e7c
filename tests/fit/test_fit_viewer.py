"""The viewer's axes: a body carried into them looks the same, and comes back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from helpers_fit import frames
from scipy.spatial.transform import Rotation

from spt_jax import PinholeCamera
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.problem.viewer import Viewer, composed

ROTATION = Rotation.from_euler("xyz", (160, 35, -20), degrees=True).as_matrix()


def tilted(dtype):
    focal, center = np.array([900.0, 950.0], dtype), np.array([300.0, 200.0], dtype)
    place = np.array([0.4, -0.3, 5.0], dtype)
    return PinholeCamera(focal, center, ROTATION.astype(dtype), place, near=0.2)


def somebody(dtype, rng):
    pose = frames("dance_a/0040")[0].astype(dtype)
    shape = jnp.asarray(rng.normal(size=10), dtype)
    return Variables(pose, shape, jnp.asarray(rng.normal(size=3), dtype))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_body_appears_in_the_same_pixels_and_comes_back(dtype, rng):
    with jax.enable_x64(dtype is np.float64):
        body, eye, given = embedded_body(), tilted(dtype), somebody(dtype, rng)
        viewer = Viewer.of(eye)
        inside = viewer.from_world(body, given)
        tight = 1e-9 if dtype is np.float64 else 2e-3
        there, here = (body(*one).vertices for one in (given, inside))
        np.testing.assert_allclose(viewer.camera.project(here), eye.project(there), atol=tight)
        assert inside.pose.dtype == inside.translation.dtype == dtype
        np.testing.assert_array_equal(inside.pose[1:], given.pose[1:])
        # y up and z towards the camera, which is where the viewer is.
        np.testing.assert_allclose(
            here * np.array([[1.0, -1.0, -1.0]], dtype), eye.to_camera(there), atol=tight
        )
        back = body(*viewer.to_world(body, inside)).vertices
        np.testing.assert_allclose(back, there, atol=tight)


def test_an_upright_body_stands_in_the_image_and_faces_it(rng):
    body, eye = embedded_body(), tilted(np.float32)
    pose = jnp.zeros((52, 3)).at[0].set(Viewer.of(eye).upright)
    joints = np.asarray(eye.to_camera(body(pose).joints))
    head, left, right = (body.joint_names.index(f) for f in ("head", "left_hip", "right_hip"))
    assert joints[head, 1] < joints[0, 1] - 0.3  # the image's y points down
    assert joints[left, 0] > joints[right, 0]  # who faces us has the left on our right


def test_to_world_differentiates_as_differences_say(x64, rng):
    body, viewer = embedded_body(), Viewer.of(tilted(np.float64))
    given, way = somebody(np.float64, rng), somebody(np.float64, rng)

    def place(step):
        moved = jax.tree.map(lambda a, b: a + step * b, given, way)
        return jnp.concatenate([part.reshape(-1) for part in viewer.to_world(body, moved)])

    slope = jax.jvp(place, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, (place(1e-6) - place(-1e-6)) / 2e-6, atol=1e-7)


def pairs_of_rotations(rng):
    """Any two, and where the composed angle is nothing, tiny, pi, or one of the two is nothing."""
    first, second = rng.normal(size=(2, 60, 3))
    unit = first[:4] / np.linalg.norm(first[:4], axis=1, keepdims=True)
    second[0], first[1], first[2], second[2] = -first[0], 0.0, 0.0, 0.0
    second[3:20] = -first[3:20] + rng.normal(size=(17, 3)) * 10.0 ** -np.arange(17)[:, None]
    first[20:24], second[20:24] = 1.25 * unit, (np.pi - 1.25) * unit
    return second, first


def test_composed_is_one_rotation_after_the_other(dtype, rng):
    second, first = pairs_of_rotations(rng)
    found = jax.vmap(composed)(second.astype(dtype), first.astype(dtype))
    expected = Rotation.from_rotvec(second) * Rotation.from_rotvec(first)
    apart = Rotation.from_rotvec(np.array(found, np.float64)) * expected.inv()
    assert found.dtype == dtype
    assert apart.magnitude().max() < 8 * np.finfo(dtype).eps
    assert np.linalg.norm(found, axis=1).max() < np.pi + 1e-6


def test_composed_differentiates_as_differences_say(x64, rng):
    second, first = pairs_of_rotations(rng)
    second, first = second[:20], first[:20]  # at pi the axis jumps
    slopes = jax.vmap(jax.jacrev(composed, argnums=1))(second, first)
    steps = 1e-6 * np.eye(3)
    up, down = (
        np.stack([jax.vmap(composed)(second, first + sign * step) for step in steps], axis=-1)
        for sign in (1, -1)
    )
    np.testing.assert_allclose(slopes, (up - down) / 2e-6, atol=1e-8)
