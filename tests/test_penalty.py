"""The penalty as a JAX function: values, derivatives and transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    embedded_body,
    inverted,
    join,
    lens_volume,
    mocap,
    moved,
    random_rotation,
    sphere,
)
from helpers_penalty import FACES, HALF, PAIR, as_jax, compiled_names, loss
from jax.test_util import check_grads

from spt_jax import classify_vertices, paper_penalty, self_intersection_penalty


def test_value_and_gradient(dtype):
    fine = join(sphere(), sphere(center=(1.2, 0.1, 0.05)))
    value, gradient = jax.value_and_grad(lambda v: self_intersection_penalty(v, fine[1], rays=256))(
        as_jax(fine, dtype)
    )
    assert value.dtype == dtype and gradient.dtype == dtype
    assert value == pytest.approx(lens_volume(np.linalg.norm([1.2, 0.1, 0.05])), rel=0.01)
    push = np.asarray(gradient[len(gradient) // 2 :].sum(axis=0))
    distance = np.array([1.2, 0.1, 0.05])
    expected = -np.pi * (1 - (distance @ distance) / 4) * distance / np.linalg.norm(distance)
    np.testing.assert_allclose(push, expected, rtol=0.01, atol=0.01)


def test_both_precisions_agree(rng):
    mesh = moved(PAIR, random_rotation(rng), (0.31, 0.17, 0.23))  # no ray meets an edge
    single = jax.value_and_grad(loss)(as_jax(mesh, "float32"))
    with jax.enable_x64(True):
        double = jax.value_and_grad(loss)(as_jax(mesh, "float64"))
    assert float(single[0]) == pytest.approx(float(double[0]), rel=1e-5)
    np.testing.assert_allclose(np.asarray(single[1]), np.asarray(double[1]), atol=2e-5)


def test_gradient_is_the_derivative_of_the_value(x64):
    """Through JAX, for a translation of one part, in one direction."""
    vertices = as_jax(moved(PAIR, random_rotation(np.random.default_rng(1))), "float64")

    def shifted(t):
        moved_part = vertices.at[HALF:].add(jnp.array([1.0, 0.3, 0.2]) * t)
        return self_intersection_penalty(moved_part, FACES, rays=64, directions=1)

    check_grads(shifted, (0.0,), order=1, modes=["rev"], eps=1e-7, rtol=1e-3)


def test_gradient_on_the_body_is_the_derivative_of_the_value(x64):
    """Through JAX, from the pose: central differences of the value on the lattice, 1e-3."""
    body = embedded_body()
    names = list(mocap().names)
    pose = body.pose_from_smpl(jnp.asarray(mocap().pose[names.index("roll/0056")], "float64"))
    rng = np.random.default_rng(4)

    @jax.jit
    def along(t, change):
        vertices = body(pose.at[1:22].add(t * change)).vertices
        return self_intersection_penalty(vertices, body.faces, rays=200, directions=1)

    for _ in range(5):
        change = jnp.asarray(rng.normal(size=(21, 3)))
        exact = jax.grad(along)(0.0, change)
        numeric = (along(1e-7, change) - along(-1e-7, change)) / 2e-7
        assert float(numeric) == pytest.approx(float(exact), rel=1e-3)


@pytest.mark.parametrize("gradient", ["vertex", "unit"])
def test_the_paper_s_pair(dtype, gradient):
    """The ratio counts the labels; the gradient is Eq. 9 or 10 on them and zero elsewhere."""
    vertices = as_jax(PAIR, dtype)
    value, slope = jax.value_and_grad(
        lambda v: paper_penalty(v, FACES, rays=64, normalize=gradient == "unit")
    )(vertices)
    found = classify_vertices(vertices, FACES, rays=64, directions=1, rule="triangle")
    assert value == pytest.approx(float(found.ratio), rel=1e-6)
    assert 0.05 < value < 0.5
    norm = np.linalg.norm(slope, axis=1)
    np.testing.assert_array_equal(norm > 0, found.penetrating)
    if gradient == "unit":
        np.testing.assert_allclose(norm[np.asarray(found.penetrating)], 1.0, rtol=1e-5)
    outward = np.sum(slope[:HALF] * vertices[:HALF], axis=1)  # a unit sphere at the origin
    assert (outward[np.asarray(found.penetrating[:HALF])] > 0).all()


def test_descending_the_paper_s_gradient_separates_the_parts():
    shift = jnp.zeros(3)

    def moved_value(t):
        return paper_penalty(as_jax(PAIR, "float32").at[HALF:].add(t), FACES, rays=64)

    values = []
    for _ in range(40):
        value, slope = jax.value_and_grad(moved_value)(shift)
        values.append(float(value))
        shift = shift - 2e-3 * slope
    assert values[0] > 0.1 and values[-1] == 0.0


def test_inside_out_surfaces_are_pushed_inwards(dtype):
    """V_in: an inverted sphere shrinks when its gradient is followed."""
    vertices, faces = inverted(sphere(subdivisions=2))
    value, slope = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, rays=64))(
        jnp.asarray(vertices, dtype)
    )
    assert value == pytest.approx(4 / 3 * np.pi, rel=0.06)
    assert (np.sum(slope * vertices.astype(dtype), axis=1) > 0).all()


@pytest.mark.parametrize("index_dtype", ["int32", "int64", "uint32", "int16"])
def test_faces_of_any_integer_kind(index_dtype):
    faces = FACES.astype(index_dtype)
    vertices = as_jax(PAIR, "float32")
    assert loss(vertices, faces) == loss(vertices)
    assert loss(vertices, jnp.asarray(faces)) == loss(vertices)


def test_transformations_agree(dtype):
    vertices = as_jax(PAIR, dtype)
    shifts = jnp.linspace(0.0, 0.5, 6, dtype=dtype)

    def one(t):
        return loss(vertices.at[HALF:, 0].add(t))

    values = jnp.stack([one(t) for t in shifts])
    slopes = jnp.stack([jax.grad(one)(t) for t in shifts])
    assert (jnp.diff(values) < 0).all() and (slopes < 0).all()
    for function, expected in ((one, values), (jax.grad(one), slopes)):
        close = dict(rtol=1e-5)
        np.testing.assert_allclose([jax.jit(function)(t) for t in shifts], expected, **close)
        np.testing.assert_allclose(jax.vmap(function)(shifts), expected, **close)
        np.testing.assert_allclose(jax.jit(jax.vmap(function))(shifts), expected, **close)
        np.testing.assert_allclose(jax.lax.map(function, shifts), expected, **close)
        nested = jax.vmap(jax.vmap(function))(shifts.reshape(2, 3))
        np.testing.assert_allclose(nested, expected.reshape(2, 3), **close)
        _, scanned = jax.lax.scan(lambda c, t: (c, function(t)), 0, shifts)  # noqa: B023
        np.testing.assert_allclose(scanned, expected, **close)
    both = jax.vmap(jax.value_and_grad(one))(shifts)
    np.testing.assert_allclose(both[0], values, rtol=1e-5)
    np.testing.assert_allclose(both[1], slopes, rtol=1e-5)


def test_vmapped_cotangents(dtype):
    vertices = as_jax(PAIR, dtype)
    value, pull = jax.vjp(loss, vertices)
    (gradients,) = jax.vmap(pull)(jnp.arange(3, dtype=dtype))
    for k in range(3):
        np.testing.assert_allclose(gradients[k], k * gradients[1])
    assert np.abs(gradients[1]).max() > 0 and value > 0


def test_batch_axes(dtype):
    shifts = np.linspace(0, 0.4, 6).reshape(2, 3)
    batch = np.broadcast_to(PAIR[0], (2, 3, *PAIR[0].shape)).copy()
    batch[:, :, HALF:, 0] += shifts[..., None]
    vertices = jnp.asarray(batch, dtype)
    values = loss(vertices)
    assert values.shape == (2, 3) and values.dtype == dtype
    one_by_one = [[float(loss(v)) for v in row] for row in vertices]
    np.testing.assert_allclose(values, one_by_one, rtol=1e-6)
    weights = jnp.arange(6, dtype=dtype).reshape(2, 3)
    gradient = jax.grad(lambda v: jnp.sum(weights * loss(v)))(vertices)
    expected = jax.grad(loss)(vertices[1, 2]) * 5
    np.testing.assert_allclose(gradient[1, 2], expected, rtol=1e-5, atol=1e-6)
    assert loss(vertices[:0]).shape == (0, 3)


def test_faces_may_be_batched_by_vmap():
    one, two = jnp.asarray(FACES), jnp.asarray(FACES[:, ::-1].copy())
    vertices = as_jax(PAIR, "float32")
    values = jax.vmap(loss, in_axes=(None, 0))(vertices, jnp.stack([one, two]))
    np.testing.assert_allclose(values, [loss(vertices, one), loss(vertices, two)])
    both = jax.vmap(jax.vmap(loss, in_axes=(0, None)), in_axes=(None, 0))(
        jnp.stack([vertices, 2 * vertices]), jnp.stack([one, two])
    )
    np.testing.assert_allclose(both, jnp.stack([values, 8 * values], axis=1), rtol=0.02)


def test_numpy_arrays_are_differentiated_as_they_are(dtype):
    vertices = PAIR[0].astype(dtype)
    value, gradient = jax.value_and_grad(loss)(as_jax(PAIR, dtype))
    plain = jax.value_and_grad(loss)(vertices)
    batch = jax.vmap(jax.value_and_grad(loss))(vertices[None])
    assert plain[0] == value == batch[0][0] == loss(vertices)
    np.testing.assert_array_equal(plain[1], gradient)
    np.testing.assert_array_equal(batch[1][0], gradient)
    square = jax.hessian(lambda t: loss(vertices + t) ** 2)(np.zeros((), dtype))
    assert abs(square) < 1e-3  # moved as a whole


def test_repeated_calls_are_traced_once():
    traces = 0

    @jax.jit
    def step(vertices):
        nonlocal traces
        traces += 1
        return jax.value_and_grad(loss)(vertices)

    vertices = as_jax(PAIR, "float32")
    for k in range(5):
        step(vertices + 0.01 * k)
    assert traces == 1


def test_outside_jit_nothing_is_compiled_whatever_changes(dtype):
    """New values of every option, and shapes, leave no program behind."""
    groups = np.repeat([0, 1], len(FACES) // 2)

    def calls(k):
        options = {
            "rays": 8 + k,
            "directions": np.eye(3) + 0.01 * k,
            "face_groups": np.roll(groups, k),
            "ignore_groups": ((0, 1),),
        }
        more = np.concatenate([PAIR[0] + 0.1 * k, np.zeros((k, 3))])
        more = jax.device_put(more.astype(dtype))
        jax.value_and_grad(lambda v: self_intersection_penalty(v, FACES, **options))(more)
        return classify_vertices(more, np.roll(FACES, k, axis=0))

    calls(0)  # what JAX itself compiles for its own parts
    with compiled_names() as names:
        calls(1)
        calls(2)
    assert names == []


def test_second_derivatives_take_the_penalty_as_linear(dtype):
    vertices = as_jax(PAIR, dtype)

    def total(t):
        return loss(vertices.at[HALF:].add(t)) + jnp.sum(t**2) * 3

    at, along = jnp.zeros(3, dtype), jnp.array([1.0, 2.0, 3.0], dtype)
    _, product = jax.jvp(jax.grad(total), (at,), (along,))
    np.testing.assert_allclose(product, 6 * along, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.hessian(total))(at), 6 * np.eye(3), atol=1e-5)
    # Through a nonlinear map the map's own curvature stays.
    curved = jax.grad(jax.grad(lambda s: loss(jnp.exp(s) * vertices)))
    zero = jnp.zeros((), dtype)
    slope = jax.grad(lambda s: loss(jnp.exp(s) * vertices))
    np.testing.assert_allclose(curved(zero), slope(zero), rtol=1e-4)


@pytest.mark.parametrize("in_jit", [False, True])
def test_hessians_of_functions_of_the_penalty_keep_their_own_curvature(x64, in_jit):
    """Of f(E): f''(E) g g^T, with E counted as linear; the third derivative likewise."""
    dtype = np.dtype("float32" if in_jit else "float64")
    vertices = as_jax(PAIR, dtype)
    one = jax.jit(loss) if in_jit else loss

    def moved_loss(t):
        return one(vertices.at[HALF:].add(t))

    at = jnp.zeros(3, dtype)
    slope = np.asarray(jax.grad(moved_loss)(at))
    square = jax.hessian(lambda t: moved_loss(t) ** 2)
    expected = 2 * np.outer(slope, slope)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(square(at), expected, rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jit(square)(at), expected, rtol=2e-5, atol=1e-6)
    twice = jax.jacrev(jax.jacrev(lambda t: moved_loss(t) ** 2))
    np.testing.assert_allclose(twice(at), expected, rtol=2e-5, atol=1e-6)
    along = lambda s: moved_loss(jnp.stack([s, s, s])) ** 3  # noqa: E731
    third = jax.grad(jax.grad(jax.grad(along)))(jnp.zeros((), dtype))
    assert float(third) == pytest.approx(6 * slope.sum() ** 3, rel=1e-4)
    batch = jax.vmap(square)(jnp.stack([at, at]))
    np.testing.assert_allclose(batch[1], expected, rtol=2e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numpy", "xla"])
def test_forward_mode_says_what_to_take(backend):
    vertices = as_jax(PAIR, "float32")
    small = lambda v: self_intersection_penalty(v, FACES, rays=8, backend=backend)  # noqa: E731
    summed = lambda v: jax.lax.scan(lambda c, _: (c + small(v), None), 0.0, length=2)[0]  # noqa: E731
    calls = (
        lambda: jax.jvp(small, (vertices,), (vertices,)),
        lambda: jax.jit(lambda v: jax.jvp(small, (v,), (v,)))(vertices),
        lambda: jax.jacfwd(lambda t: small(vertices + t))(0.0),
        lambda: jax.linearize(small, vertices)[1](vertices),
        lambda: jax.jvp(summed, (vertices,), (vertices,)),
    )
    for call in calls if backend == "numpy" else calls[:1]:
        with pytest.raises(TypeError, match=r'no forward mode .*options=dict\(jac="bwd"\)'):
            call()
    # Reverse mode passes through all that forward mode does not.
    gradient = jax.grad(small)(vertices)
    (linear,) = jax.linear_transpose(jax.linearize(small, vertices)[1], vertices)(jnp.ones(()))
    np.testing.assert_array_equal(linear, gradient)
    if backend == "numpy":
        np.testing.assert_array_equal(jax.grad(jax.checkpoint(small))(vertices), gradient)
        np.testing.assert_allclose(jax.grad(summed)(vertices), 2 * gradient, rtol=1e-6)
