"""Laplacian regularization: against its definition, and its laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, random_rotation
from helpers import sphere as solid_sphere

from spt_jax.fit.regularizers.laplacian import MeshLaplacian, laplacian_penalty

VERTICES, FACES = solid_sphere(subdivisions=1)
COUNT = len(VERTICES)


@pytest.fixture
def laplacian(dtype):
    return MeshLaplacian.from_faces(FACES, COUNT)


def slow_coordinates(vertices, faces):
    """One vertex after the other, straight from the definition."""
    out = np.zeros_like(vertices)
    for v in range(len(vertices)):
        around = {int(w) for f in faces if v in f for w in f} - {v}
        if around:
            out[v] = vertices[v] - np.mean([vertices[w] for w in around], axis=0)
    return out


def moved(rng, dtype):
    return jnp.asarray(VERTICES + 0.1 * rng.normal(size=VERTICES.shape), dtype)


@pytest.mark.parametrize("mesh", [(VERTICES, FACES), box((1.0, 2.0, 0.5))])
def test_coordinates_equal_the_slow_definition(mesh, dtype):
    vertices, faces = mesh
    laplacian = MeshLaplacian.from_faces(faces, len(vertices))
    got = laplacian.coordinates(jnp.asarray(vertices, dtype))
    assert got.dtype == dtype
    tolerance = 1e-6 if dtype == np.float32 else 1e-14
    np.testing.assert_allclose(got, slow_coordinates(vertices, faces), atol=tolerance)


def test_the_penalty_is_the_mean_square_of_their_change(laplacian, rng, dtype):
    start = jnp.asarray(VERTICES, dtype)
    end = moved(rng, dtype)
    change = slow_coordinates(np.asarray(end), FACES) - slow_coordinates(np.asarray(start), FACES)
    expected = (change**2).sum(axis=1).mean()
    np.testing.assert_allclose(laplacian_penalty(laplacian, start, end), expected, rtol=2e-5)
    np.testing.assert_allclose(laplacian_penalty(laplacian, end, start), expected, rtol=2e-5)


def test_zero_without_a_change_and_for_a_translation(laplacian, dtype):
    start = jnp.asarray(VERTICES, dtype)
    value, slope = jax.value_and_grad(laplacian_penalty, 2)(laplacian, start, start)
    assert value == 0 and not slope.any()
    shift = jnp.asarray([[0.5, -0.25, 2.0]], dtype)
    assert laplacian_penalty(laplacian, start, start + shift) < 10 * jnp.finfo(dtype).eps ** 2


def test_turning_both_changes_nothing_and_turning_one_costs(rng, x64):
    laplacian = MeshLaplacian.from_faces(FACES, COUNT)
    start, end = jnp.asarray(VERTICES), moved(rng, np.float64)
    turn = jnp.asarray(random_rotation(rng))
    value = laplacian_penalty(laplacian, start, end)
    np.testing.assert_allclose(laplacian_penalty(laplacian, start @ turn, end @ turn), value)
    np.testing.assert_allclose(laplacian_penalty(laplacian, 3 * start, 3 * end), 9 * value)
    assert laplacian_penalty(laplacian, start, start @ turn) > 1e-3


def test_order_and_winding_of_faces_do_not_matter(laplacian, rng, dtype):
    shuffled = np.roll(rng.permutation(FACES), 1, axis=1)[:, ::-1]
    other = MeshLaplacian.from_faces(jnp.asarray(shuffled), COUNT)
    assert jnp.array_equal(other.edges, laplacian.edges)
    assert jnp.array_equal(other.valence, laplacian.valence)


def test_numbering_of_vertices_does_not_matter(laplacian, rng, dtype):
    order = rng.permutation(COUNT)
    end, start = moved(rng, dtype), jnp.asarray(VERTICES, dtype)
    renumbered = MeshLaplacian.from_faces(np.argsort(order)[FACES], COUNT)
    np.testing.assert_allclose(
        laplacian_penalty(renumbered, start[order], end[order]),
        laplacian_penalty(laplacian, start, end),
        rtol=1e-5,
    )


def test_a_vertex_without_neighbors_costs_nothing(dtype):
    laplacian = MeshLaplacian.from_faces(FACES, COUNT + 2)
    start = jnp.asarray(np.concatenate([VERTICES, np.ones((2, 3))]), dtype)
    end = start.at[COUNT:].add(5.0)
    value, slope = jax.value_and_grad(laplacian_penalty, 2)(laplacian, start, end)
    assert value == 0 and not slope.any()


def test_derivative_equals_finite_differences(rng, x64):
    laplacian = MeshLaplacian.from_faces(FACES, COUNT)
    start, end = jnp.asarray(VERTICES), moved(rng, np.float64)
    for argument in (1, 2):
        slope = jax.grad(laplacian_penalty, argument)(laplacian, start, end)
        along = jnp.asarray(rng.normal(size=end.shape))

        def loss(t, argument=argument, along=along):
            pair = [start, end]
            pair[argument - 1] += t * along
            return laplacian_penalty(laplacian, *pair)

        expected = (loss(1e-5) - loss(-1e-5)) / 2e-5
        np.testing.assert_allclose(jnp.sum(slope * along), expected, rtol=1e-8)
        np.testing.assert_allclose(jax.jvp(loss, (0.0,), (1.0,))[1], expected, rtol=1e-8)


def test_batches_broadcast_and_equal_single_calls(laplacian, rng, dtype):
    start = jnp.asarray(VERTICES, dtype)
    ends = jnp.stack([moved(rng, dtype) for _ in range(6)]).reshape(2, 3, COUNT, 3)
    got = laplacian_penalty(laplacian, start, ends)
    assert got.shape == (2, 3)
    one = jax.jit(lambda end: laplacian_penalty(laplacian, start, end))
    single = [[one(end) for end in row] for row in ends]
    np.testing.assert_allclose(got, single, rtol=1e-5)
    mapped = jax.vmap(jax.vmap(jax.grad(one)))(ends)
    np.testing.assert_allclose(mapped[1, 2], jax.grad(one)(ends[1, 2]), rtol=1e-5, atol=1e-7)


def test_the_laplacian_may_be_an_argument_of_jit(laplacian, rng, dtype):
    start, end = jnp.asarray(VERTICES, dtype), moved(rng, dtype)
    jitted = eqx.filter_jit(laplacian_penalty)(laplacian, start, end)
    np.testing.assert_allclose(jitted, laplacian_penalty(laplacian, start, end), rtol=1e-6)


def test_errors_name_the_argument(untyped):
    laplacian = MeshLaplacian.from_faces(FACES, COUNT)
    right, wrong = jnp.zeros((COUNT, 3)), jnp.zeros((COUNT + 1, 3))
    with pytest.raises(ValueError, match=rf"vertices must have shape .*{COUNT}"):
        laplacian_penalty(laplacian, right, wrong)
    with pytest.raises(ValueError, match="reference must have shape"):
        laplacian_penalty(laplacian, wrong, right)
    with pytest.raises(ValueError, match="faces must index into vertices"):
        MeshLaplacian.from_faces(FACES, COUNT - 1)
    with pytest.raises(TypeError, match="faces must be known"):
        jax.jit(lambda faces: MeshLaplacian.from_faces(faces, COUNT).valence)(FACES)
