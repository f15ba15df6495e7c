"""The penalty as a JAX function: values, derivatives, transformations and wrong input."""

import ipctk
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import (
    body_faces,
    box,
    embedded_body,
    inverted,
    join,
    lens_volume,
    mocap,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from spt_jax import classify_vertices, host, paper_penalty, penalty, self_intersection_penalty
from spt_jax.rays import measure

PAIR = join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2))
FACES = PAIR[1].astype(np.int32)
HALF = len(PAIR[0]) // 2


def loss(vertices, faces=FACES):
    return self_intersection_penalty(vertices, faces, rays=48)


def as_jax(mesh, dtype):
    return jnp.asarray(mesh[0], dtype)


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


@pytest.mark.parametrize("value", ["volume", "ratio"])
@pytest.mark.parametrize("gradient", ["boundary", "vertex", "unit"])
@pytest.mark.parametrize("mesh", [sphere(), join(box(), box(center=(1.5, 0, 0)))])
def test_no_overlap_is_exactly_zero(dtype, mesh, gradient, value):
    options = {"value": value, "gradient": gradient, "rays": 100}
    found, slope = jax.value_and_grad(lambda v: self_intersection_penalty(v, mesh[1], **options))(
        as_jax(mesh, dtype)
    )
    assert found == 0.0
    np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize("gradient", ["vertex", "unit"])
def test_the_paper_s_pair(dtype, gradient):
    """The ratio counts the classes; the gradient is Eq. 9 or 10 on them and zero elsewhere."""
    vertices = as_jax(PAIR, dtype)
    value, slope = jax.value_and_grad(
        lambda v: paper_penalty(v, FACES, rays=64, normalize=gradient == "unit")
    )(vertices)
    classes = classify_vertices(vertices, FACES, rays=64, directions=1)
    assert value == pytest.approx(float(classes.ratio), rel=1e-6)
    assert 0.05 < value < 0.5
    norm = np.linalg.norm(slope, axis=1)
    np.testing.assert_array_equal(norm > 0, classes.out)
    if gradient == "unit":
        np.testing.assert_allclose(norm[np.asarray(classes.out)], 1.0, rtol=1e-5)
    outward = np.sum(slope[:HALF] * vertices[:HALF], axis=1)  # a unit sphere at the origin
    assert (outward[np.asarray(classes.out[:HALF])] > 0).all()


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
    # Outside jit the penalty brings its own cache: nothing is traced again for the host either.
    caches = (host._bridge, host._host_entry)
    jax.value_and_grad(loss)(vertices)
    loss(vertices)
    before = penalty._penalty._cache_size(), [cache.cache_info().misses for cache in caches]
    for k in range(5):
        loss(vertices + 0.01 * k)
        jax.value_and_grad(loss)(vertices + 0.01 * k)
    after = penalty._penalty._cache_size(), [cache.cache_info().misses for cache in caches]
    assert after == before


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


def test_forward_mode_says_no():
    with pytest.raises(TypeError, match="custom_vjp"):
        jax.jvp(loss, (as_jax(PAIR, "float32"),), (as_jax(PAIR, "float32"),))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_vertices_that_are_not_finite_give_nan_and_no_gradient(dtype, bad):
    vertices = as_jax(PAIR, dtype).at[5, 1].set(bad)
    for run in (jax.value_and_grad(loss), jax.jit(jax.value_and_grad(loss))):
        value, gradient = run(vertices)
        assert np.isnan(value)
        np.testing.assert_array_equal(gradient, 0.0)
    # The rest of a batch is not touched.
    batch = jnp.stack([as_jax(PAIR, dtype), vertices])
    values, gradients = jax.vmap(jax.value_and_grad(loss))(batch)
    assert values[0] == loss(batch[0]) and np.isnan(values[1])
    assert np.abs(gradients[0]).max() > 0 and np.abs(gradients[1]).max() == 0


def test_traced_faces_out_of_range_give_nan():
    wrong = jnp.asarray(FACES).at[3, 1].set(len(PAIR[0]))
    value, gradient = jax.jit(jax.value_and_grad(loss))(as_jax(PAIR, "float32"), wrong)
    assert np.isnan(value) and np.abs(gradient).max() == 0


def test_faces_seen_edge_on_make_no_overlap(dtype):
    """Solids with walls along the rays, where rounding decides which rays hit them."""
    cylinder = trimesh.creation.cylinder(0.5, 1.0)
    cone = trimesh.creation.cone(0.5, 1.0)
    for k in range(8):
        turn = trimesh.transformations.rotation_matrix(k * np.pi / 4, [1, k % 3, 0])[:3, :3]
        for solid in (cylinder, cone, trimesh.creation.box()):
            for shift in ((0, 0, 0), (0, 0, 0.5)):
                mesh = moved((np.array(solid.vertices), np.array(solid.faces)), turn, shift)
                for rays in (16, 100, (64, 64)):
                    value = self_intersection_penalty(as_jax(mesh, dtype), mesh[1], rays=rays)
                    assert value == 0.0


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([box(), sphere(subdivisions=2), box((1, 2, 0.5))]),
    st.sampled_from([(8, 8), (64, 64), (32, 64), 16, 64, 7]),
    st.sampled_from([0.0, 1e-16, 1e-15, 1e-13, 1e-11, 1e-8]),
    st.sampled_from([0.001, 0.5, 1.0, 10.0]),
    st.sampled_from([1, 3]),
    st.integers(0, 2**32 - 1),
)
def test_convex_solids_never_overlap(mesh, rays, noise, scale, directions, seed):
    rng = np.random.default_rng(seed)
    corner = rng.choice(mesh[0])
    vertices = (mesh[0] - corner * rng.integers(0, 2)) * scale
    vertices = vertices + noise * rng.normal(size=vertices.shape)
    probes = measure.probe(vertices, mesh[1], sampling(rays, directions))
    assert measure.volume(probes) == 0
    assert not measure.labels(mesh[1], len(vertices), probes).any()


def test_bodies_that_ipctk_calls_free_are_exactly_free():
    """No self-intersection of the mesh by ipctk, an exact test: value and gradient are zero."""
    faces = body_faces().astype(np.int32)
    edges = ipctk.edges(faces)
    for vertices in posed_bodies(
        ["cartwheel/0034", "dance_a/0017", "dance_a/0035", "dance_a/0044"]
    ):
        mesh = ipctk.CollisionMesh(vertices, edges, faces)
        assert not ipctk.has_intersections(mesh, vertices)
        for rays in (512, (300, 300)):
            value, gradient = jax.value_and_grad(
                lambda v: self_intersection_penalty(v, faces, rays=rays)  # noqa: B023
            )(jnp.asarray(vertices, "float32"))
            assert value == 0.0 and np.abs(gradient).max() == 0.0


def test_extreme_scales(x64):
    vertices = jnp.asarray(moved(PAIR, random_rotation(np.random.default_rng(2)))[0])
    value, gradient = jax.value_and_grad(loss)(vertices)
    for exponent in (-300, -200, 200, 300):  # powers of two keep the lattice's pixels
        scale = 2.0**exponent
        scaled_value, scaled_gradient = jax.value_and_grad(loss)(vertices * scale)
        assert float(scaled_value / scale / scale / scale) == pytest.approx(float(value))
        np.testing.assert_allclose(scaled_gradient / scale / scale, gradient, atol=1e-12)


def test_overflow_is_nan_and_no_crash(dtype):
    huge = as_jax(PAIR, dtype) * np.asarray(1e30 if dtype == np.float32 else 1e307, dtype)
    value, gradient = jax.value_and_grad(loss)(huge)
    assert not value < np.inf  # too large for the dtype
    assert not np.isnan(gradient).any()


def test_meshes_without_triangles_or_extent_are_free():
    none = np.zeros((0, 3), np.int32)
    assert loss(jnp.zeros((0, 3)), none) == 0
    assert jax.vmap(lambda v: loss(v, none))(jnp.zeros((2, 0, 3))).shape == (2,)
    empty = np.zeros((0, 3), np.int32)
    assert loss(jnp.zeros((4, 3)), empty) == 0
    value, gradient = jax.value_and_grad(loss)(jnp.full((4, 3), 0.7), np.array([[0, 1, 2]]))
    assert value == 0 and np.abs(gradient).max() == 0


def _wrong(**options):
    return lambda: self_intersection_penalty(jnp.asarray(PAIR[0], "float32"), FACES, **options)


def _wrong_mesh(vertices, faces=FACES):
    return lambda: self_intersection_penalty(vertices, faces)


GOOD = jnp.asarray(PAIR[0], "float32")
ERRORS = {
    "vertices shape": (_wrong_mesh(GOOD[:, :2]), ValueError, "vertices must have shape"),
    "vertices rank": (_wrong_mesh(GOOD[0]), ValueError, r"vertices must have shape .*got \(3,\)"),
    "vertices dtype": (_wrong_mesh(jnp.ones((4, 3), "int32")), TypeError, "got int32"),
    "vertices half": (_wrong_mesh(GOOD.astype("float16")), TypeError, "got float16"),
    "faces shape": (_wrong_mesh(GOOD, FACES[:, :2]), ValueError, "faces must have shape"),
    "faces rank": (_wrong_mesh(GOOD, FACES[0]), ValueError, r"faces must have shape .*\(3,\)"),
    "faces dtype": (_wrong_mesh(GOOD, FACES * 1.0), TypeError, "faces must be whole numbers"),
    "face too large": (
        _wrong_mesh(GOOD, np.where(FACES == 7, len(GOOD), FACES)),
        ValueError,
        f"got index {len(GOOD)} for {len(GOOD)} vertices; indices are 0-based",
    ),
    "face negative": (_wrong_mesh(GOOD, FACES - 1), ValueError, "got index -1"),
    "no rays": (_wrong(rays=0), ValueError, "rays must be from 1 to .*got 0"),
    "far too many rays": (_wrong(rays=5000), ValueError, "from 1 to 4096 a side: got 5000"),
    "negative rays": (_wrong(rays=(3, -4)), ValueError, r"got \(3, -4\)"),
    "fractional rays": (_wrong(rays=3.5), TypeError, "whole number"),
    "auto rays": (_wrong(rays="auto"), ValueError, "not in this version"),
    "value": (_wrong(value="area"), ValueError, "value must be one of 'volume', 'ratio'"),
    "gradient": (_wrong(gradient="exact"), ValueError, "gradient must be one of 'boundary'"),
    "two directions": (_wrong(directions=2), ValueError, "directions must be 1, 3 or an array"),
    "zero direction": (_wrong(directions=[[0, 0, 0]]), ValueError, "finite and not zero.*row 0"),
    "nan direction": (
        _wrong(directions=[[0, 0, 1], [np.nan, 0, 1]]), ValueError, "not zero.*row 1"
    ),
    "flat direction": (_wrong(directions=[0, 0, 1]), ValueError, r"got shape \(3,\)"),
    "named direction": (_wrong(directions="up"), TypeError, "got 'up'"),
    "backend": (_wrong(backend="cuda"), ValueError, "backend must be one of"),
    "later backend": (_wrong(backend="xla"), ValueError, "not in this version"),
    "margin": (_wrong(margin=0.01), ValueError, "margin is not in this version"),
    "groups": (_wrong(face_groups=np.zeros(3)), ValueError, "face_groups is not in"),
    "ignored": (_wrong(ignore_groups=((0, 1),)), ValueError, "ignore_groups is not in"),
    "folds": (_wrong(folds=object()), ValueError, "folds is not in this version"),
}  # fmt: skip


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_input_fails_when_traced(name, untyped):
    call, kind, message = ERRORS[name]
    with pytest.raises(kind, match=message):
        call()
    with pytest.raises(kind, match=message):
        jax.eval_shape(call)


def test_traced_directions_are_refused(untyped):
    with pytest.raises(TypeError, match="directions must be known when traced"):
        jax.jit(lambda d: self_intersection_penalty(GOOD, FACES, directions=d))(jnp.eye(3))


def test_directions_scale_and_type_do_not_matter():
    one = self_intersection_penalty(GOOD, FACES, rays=32, directions=[[0, 0, -2.5]])
    assert one == self_intersection_penalty(GOOD, FACES, rays=32, directions=1)
    assert one == self_intersection_penalty(GOOD, FACES, rays=32, directions=[[0, 0, -1e-200]])
    three = self_intersection_penalty(GOOD, FACES, rays=32, directions=jnp.eye(3))
    assert three == pytest.approx(float(one), rel=0.05)
