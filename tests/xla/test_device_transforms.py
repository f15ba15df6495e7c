"""The device path under JAX's transformations: batches one after the other, or some at once."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_device import SOLIDS, on_host, padded
from jax.sharding import Mesh, PartitionSpec

from spt_jax import paper_penalty, self_intersection_penalty
from spt_jax.xla.settings import Xla

RAYS = 24


def penalty(vertices, faces, settings=None):
    return self_intersection_penalty(
        vertices, faces, rays=RAYS, directions=1, backend=settings or Xla()
    )


@functools.cache
def expected():
    found = [on_host(*padded(name, "float32"), RAYS, 1) for name in SOLIDS]
    return (
        np.array([one.volume for one in found]),
        np.array([one.gradient("boundary", "triangle") for one in found]),
    )


def batch():
    return tuple(
        np.stack(x) for x in zip(*(padded(name, "float32") for name in SOLIDS), strict=True)
    )


def check(values, gradients):
    np.testing.assert_allclose(np.ravel(values), expected()[0], rtol=1e-5, atol=0)
    gradients = np.reshape(gradients, expected()[1].shape)
    np.testing.assert_allclose(gradients, expected()[1], rtol=0, atol=2e-5)


@pytest.mark.slow
def test_nested_vmap_over_meshes_and_faces_in_shard_map():
    """Several meshes at once, of which some take more strips than others, over one device."""
    settings = Xla(segments=200, crossings=600, meshes_at_once=4)
    vertices, faces = (x.reshape(2, 4, *x.shape[1:]) for x in batch())
    one = jax.value_and_grad(functools.partial(penalty, settings=settings))
    spec = PartitionSpec("meshes")
    sharded = jax.shard_map(
        jax.vmap(jax.vmap(one)),
        mesh=Mesh(jax.devices()[:1], "meshes"),
        in_specs=spec,
        out_specs=spec,
        check_vma=False,
    )
    check(*jax.jit(sharded)(vertices, faces))


def test_leading_axes_and_second_derivatives():
    """One call for a batch that shares its faces; the penalty counts as linear, its square not."""
    vertices, faces = padded("two boxes", "float32")
    moved = jnp.stack([vertices, vertices + 0.125, 1.0 * vertices[::1]])[:, None]
    change = jnp.ones_like(moved).at[..., 8:, :].set(0.0)  # of one box alone

    def loss(vertices):
        return (penalty(vertices, faces) ** 2).sum()

    gradient = jax.jit(jax.grad(lambda v: (jax.grad(loss)(v) * change).sum()))(moved)
    found = on_host(vertices, faces, RAYS, 1)
    slope = found.gradient("boundary", "triangle")
    # Of E^2, with E linear: 2 slope (slope . change).
    along = float((slope * np.asarray(change[0, 0])).sum())
    assert abs(along) > 0.1
    np.testing.assert_allclose(gradient[0, 0], 2 * slope * along, atol=1e-4)


def test_the_paper_s_penalty():
    vertices, faces = padded("two spheres", "float32")
    value, gradient = jax.value_and_grad(
        lambda v: paper_penalty(v, faces, rays=RAYS, backend="xla")
    )(vertices)
    found = on_host(vertices, faces, RAYS, 1)
    label = found.labels("triangle")
    assert float(value) == pytest.approx(np.mean(label != 0), rel=1e-6) and value > 0.05
    np.testing.assert_allclose(gradient, found.gradient("unit", "triangle"), atol=1e-5)
