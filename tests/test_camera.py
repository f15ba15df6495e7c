"""PinholeCamera against the formula written out, its decomposition, and the plane of the camera."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import slow_rotation
from hypothesis import given
from hypothesis import strategies as st

from spt_jax._camera import PinholeCamera

_TURN = slow_rotation(np.array([0.4, -1.1, 2.0]))


_FOCAL, _CENTER, _SHIFT = [900.0, 1100.0], [310.0, 255.0], [0.2, -0.4, 3.0]


def _camera(dtype="float32"):
    return PinholeCamera(*(jnp.asarray(part, dtype) for part in (_FOCAL, _CENTER, _TURN, _SHIFT)))


def _by_hand(points):
    pixels = []
    for point in points:
        x, y, z = _TURN @ point + _SHIFT
        assert z > 0.1
        pixels.append(
            [_FOCAL[0] * x / z + _CENTER[0], _FOCAL[1] * y / z + _CENTER[1]],
        )
    return np.array(pixels)


def test_equals_the_formula(dtype, rng):
    points = rng.uniform(-1, 1, (7, 3))
    got = _camera(dtype).project(jnp.asarray(points, dtype))
    assert got.dtype == dtype
    limit = 1e-10 if dtype == np.float64 else 3e-3
    np.testing.assert_allclose(got, _by_hand(points), atol=limit)


def test_axes_are_right_down_and_forward():
    camera = PinholeCamera(500, (100, 100))
    right, down, farther = camera.project(jnp.array([[1.0, 0, 4], [0.0, 1, 4], [1.0, 0, 8]]))
    np.testing.assert_allclose(right, [225, 100])
    np.testing.assert_allclose(down, [100, 225])
    np.testing.assert_allclose(farther, [162.5, 100])


def test_batches_of_points_and_of_cameras(rng, x64):
    camera, points = _camera("float64"), jnp.asarray(rng.uniform(-1, 1, (2, 5, 7, 3)))
    got = camera.project(points)
    assert got.shape == (2, 5, 7, 2)
    np.testing.assert_allclose(got[1, 3], camera.project(points[1, 3]), rtol=1e-12)

    focals = jnp.array([[500.0, 600], [700, 800], [900, 1000]])
    centers = jnp.array([[0.0, 0], [10, 20], [30, 40]])
    cameras = jax.vmap(PinholeCamera)(focals, centers)
    assert cameras.focal.shape == (3, 2)
    seen = jax.vmap(lambda c, p: c.project(p))(cameras, points[0, :3] + 3)
    for k in range(3):
        single = PinholeCamera(focals[k], centers[k]).project(points[0, k] + 3)
        np.testing.assert_allclose(seen[k], single, rtol=1e-12)


@pytest.mark.parametrize("depth", [2.0, 0.15, 0.05, 0.0, -0.4])
def test_gradient_is_that_of_finite_differences(x64, depth):
    camera = PinholeCamera([900.0, 1100.0], [310.0, 255.0], translation=[0.1, 0.2, depth])
    weights = jnp.array([[0.3, -0.8], [1.0, 0.4]])

    def total(camera, points):
        return jnp.sum(weights * camera.project(points))

    points = jnp.array([[0.2, -0.3, 0.01], [-0.5, 0.1, 0.02]])
    by_camera, by_points = jax.jit(jax.grad(total, argnums=(0, 1)))(camera, points)
    step = 1e-6
    for k in range(3):
        move = jnp.zeros((2, 3)).at[1, k].set(step)
        rise = (total(camera, points + move) - total(camera, points - move)) / (2 * step)
        np.testing.assert_allclose(by_points[1, k], rise, rtol=1e-6, atol=1e-6)
    longer = PinholeCamera(camera.focal + step, camera.center, translation=camera.translation)
    rise = (total(longer, points) - total(camera, points)) / step
    np.testing.assert_allclose(jnp.sum(by_camera.focal), rise, rtol=1e-5)


def test_finite_and_continuous_at_and_behind_the_camera(dtype):
    camera = PinholeCamera(np.asarray(1000, dtype), np.zeros(2, dtype))

    def x_of(depth):
        return camera.project(jnp.stack([jnp.ones_like(depth), depth, depth])[None])[0, 0]

    depths = jnp.asarray([5, 0.1, 1e-30, 0, -1e-30, -0.1, -3, -1e6], dtype)
    both = jax.jit(jax.vmap(jax.value_and_grad(x_of)))
    values, slopes = both(depths)
    assert np.isfinite(values).all() and np.isfinite(slopes).all()
    # Farther behind is farther out, on the same side: the way back leads to the front.
    assert (np.diff(values) >= 0).all() and (np.asarray(slopes) < 0).all()
    just = jnp.asarray([0.1 * (1 - 1e-6), 0.1 * (1 + 1e-6)], dtype)
    values, slopes = both(just)
    np.testing.assert_allclose(values[0], values[1], rtol=1e-5)
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-5)


def test_a_descent_brings_a_point_from_behind_to_the_front(x64):
    camera = PinholeCamera(1.0, (0.0, 0.0))

    def error(depth):
        return (
            jnp.sum((camera.project(jnp.array([[0.3, 0.0, 1.0]]) * depth) - 0.1) ** 2)
            + (
                camera.project(jnp.stack([jnp.array([0.3]), jnp.zeros(1), depth[None]], -1))[0, 0]
                - 0.1
            )
            ** 2
        )

    depth, slope = jnp.asarray(-2.0), jax.jit(jax.grad(error))
    for _ in range(4000):
        depth = depth - 1e-3 * jnp.clip(slope(depth), -1, 1)
    assert depth > 0.1


_angles = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
_shifts = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
_scales = st.floats(1e-3, 1e3).flatmap(lambda s: st.sampled_from([s, -s]))


@given(st.floats(50, 6000), st.floats(50, 6000), st.floats(-500, 4000), _angles, _shifts, _scales)
def test_matrix_and_back_whatever_its_scale(fx, fy, cx, angles, shift, scale):
    intrinsic = np.array([[fx, 0, cx], [0, fy, 700], [0, 0, 1]])
    turn = slow_rotation(angles)
    matrix = intrinsic @ np.concatenate([turn, shift[:, None]], axis=1)
    camera = PinholeCamera.from_matrix(scale * matrix)  # its arrays are float32 here
    np.testing.assert_allclose(camera.focal, [fx, fy], rtol=1e-6)
    np.testing.assert_allclose(camera.center, [cx, 700], rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(camera.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(camera.translation, shift, rtol=1e-5, atol=1e-5)
    assert np.linalg.det(np.asarray(camera.rotation, np.float64)) > 0.999


def test_matrix_projects_as_the_camera_does(rng, x64):
    camera, points = _camera("float64"), rng.uniform(-1, 1, (5, 3))
    image = np.concatenate([points, np.ones((5, 1))], axis=1) @ np.asarray(camera.matrix).T
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], camera.project(points), rtol=1e-10)
    again = PinholeCamera.from_matrix(np.asarray(camera.matrix))
    np.testing.assert_allclose(again.project(points), camera.project(points), rtol=1e-10)


def test_skew_is_dropped_where_it_moves_nothing_and_else_refused(x64):
    intrinsic = np.array([[1000, 0.5, 320], [0, 1000, 240], [0, 0, 1.0]])
    matrix = intrinsic @ np.concatenate([_TURN, np.array([[0.1], [0.2], [4]])], axis=1)
    camera = PinholeCamera.from_matrix(matrix)
    np.testing.assert_allclose(camera.focal, 1000)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    image = np.concatenate([points, np.ones((50, 1))], axis=1) @ matrix.T
    np.testing.assert_allclose(camera.project(points), image[:, :2] / image[:, 2:], atol=0.5)
    intrinsic[0, 1] = 20
    with pytest.raises(ValueError, match="no skew: got 20 pixels for a focal length of 1000"):
        PinholeCamera.from_matrix(np.concatenate([intrinsic, np.ones((3, 1))], axis=1))


def test_field_of_view():
    camera = PinholeCamera.from_field_of_view(480, 640)
    edge = jnp.array([[0.0, np.tan(np.radians(55 / 2)), 1.0]])
    np.testing.assert_allclose(camera.project(edge), [[240, 640]], rtol=1e-6)


_EYE = np.eye(3)
_GOOD = np.concatenate([_EYE, np.zeros((3, 1))], axis=1)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: PinholeCamera(-1.0, (0, 0)), ValueError, "focal must be positive"),
        (lambda: PinholeCamera((1.0, 0.0), (0, 0)), ValueError, "focal must be positive"),
        (lambda: PinholeCamera((1.0, 2.0, 3.0), (0, 0)), ValueError, r"focal must have shape"),
        (lambda: PinholeCamera("far", (0, 0)), TypeError, "focal must hold real numbers"),
        (lambda: PinholeCamera(np.nan, (0, 0)), ValueError, "focal must be finite"),
        (lambda: PinholeCamera(1.0, 5.0), ValueError, r"center must have shape \(2,\)"),
        (lambda: PinholeCamera(1.0, (0, np.inf)), ValueError, "center must be finite"),
        (lambda: PinholeCamera(1.0, (0, 0), 2 * _EYE), ValueError, "must be orthonormal"),
        (lambda: PinholeCamera(1.0, (0, 0), -_EYE), ValueError, "determinant"),
        (lambda: PinholeCamera(1.0, (0, 0), np.ones(3)), ValueError, r"rotation must have shape"),
        (lambda: PinholeCamera(1.0, (0, 0), None, (0, 0)), ValueError, "translation must have"),
        (lambda: PinholeCamera(1.0, (0, 0), near=0.0), ValueError, "near must be positive"),
        (lambda: PinholeCamera(1.0, (0, 0), near="0"), TypeError, "near must be a number"),
        (lambda: PinholeCamera.from_matrix(_EYE), ValueError, r"shape \(3, 4\)"),
        (lambda: PinholeCamera.from_matrix(0 * _GOOD), ValueError, "full rank"),
        (lambda: PinholeCamera.from_matrix(np.ones((3, 4))), ValueError, "full rank"),
        (
            lambda: PinholeCamera.from_matrix(np.diag([1.0, 1, 0]) @ _GOOD),
            ValueError,
            "affine or orthographic",
        ),
        (lambda: PinholeCamera.from_matrix(np.nan * _GOOD), ValueError, "finite"),
        (lambda: PinholeCamera.from_matrix([["a"] * 4] * 3), TypeError, "real numbers"),
        (lambda: PinholeCamera.from_matrix(1j * _GOOD), TypeError, "real numbers"),
        (lambda: jax.jit(PinholeCamera.from_matrix)(_GOOD), TypeError, "outside jit"),
        (lambda: PinholeCamera.from_field_of_view(0, 5), ValueError, "width must be positive"),
        (lambda: PinholeCamera.from_field_of_view(5, 5, 180), ValueError, "degrees must be"),
        (lambda: PinholeCamera.from_field_of_view(5, "a"), TypeError, "height must be a number"),
        (lambda: _camera().project(np.zeros(3)), ValueError, "write one point"),
        (lambda: _camera().project(np.zeros((2, 3), int)), TypeError, "floating-point"),
    ],
)
def test_wrong_arguments_are_named(untyped, make, error, message):
    with pytest.raises(error, match=message):
        make()
