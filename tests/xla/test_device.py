"""The device path against the host path: values, gradients, and what cannot be measured."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_device import SOLIDS, on_host, padded

from spt_jax import self_intersection_penalty
from spt_jax._query import as_backend
from spt_jax.overlap import boundary
from spt_jax.xla.gradient import vertex_gradient
from spt_jax.xla.settings import Xla

RAYS = 48
# Three directions in single precision and one in double: as few compilations as possible.
DIRECTIONS = {"float32": 3, "float64": 1}


@functools.partial(jax.jit, static_argnums=2)
def value_and_gradient(vertices, faces, directions):
    def penalty(vertices):
        return self_intersection_penalty(
            vertices, faces, rays=RAYS, directions=directions, backend="xla"
        )

    return jax.value_and_grad(penalty)(vertices)


@pytest.mark.parametrize("name", SOLIDS)
def test_equals_the_host(name, dtype):
    """To 1e-5, though the host computes in double precision; without overlap exactly zero."""
    vertices, faces = padded(name, dtype)
    value, gradient = value_and_gradient(vertices, faces, DIRECTIONS[dtype.name])
    found = on_host(vertices, faces, RAYS, DIRECTIONS[dtype.name])
    expected = found.gradient("boundary", "triangle")
    assert value.dtype == dtype and gradient.dtype == dtype
    assert float(value) == pytest.approx(found.volume, rel=1e-5, abs=0.0)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-5 * scale)
    if name == "apart":
        assert value == 0 and not gradient.any()
    else:
        assert value > 0.01 and scale > 0


def test_gradient_is_the_derivative_of_the_sampled_volume(x64):
    """Central differences with one part moved, in one direction of rays."""
    vertices, faces = padded("two spheres", "float64")
    vertices = vertices + np.array([0.013, 0.007, 0.003])
    half = len(vertices) // 2
    rng = np.random.default_rng(0)
    _, gradient = value_and_gradient(vertices, faces, 1)
    for _ in range(5):
        change = np.zeros_like(vertices)
        change[half:] = rng.normal(size=3) + 0.1 * rng.normal(size=(half, 3))
        up, down = (value_and_gradient(vertices + t * change, faces, 1)[0] for t in (1e-7, -1e-7))
        exact = float((gradient * change).sum())
        assert float(up - down) / 2e-7 == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, "face", "far"])
def test_what_cannot_be_measured_is_nan(bad):
    vertices, faces = padded("two spheres", "float32")
    if bad == "face":
        faces[5, 1] = len(vertices)
    elif bad == "far":
        vertices += np.float32(1e7)
    else:
        vertices[3, 2] = bad
    value, gradient = value_and_gradient(vertices, faces, 3)
    assert np.isnan(value) and not gradient.any()


def test_no_triangles_and_no_vertices():
    for vertices in (np.ones((3, 3), "float32"), np.ones((0, 3), "float32")):
        nothing = np.zeros((0, 3), np.int32)
        assert self_intersection_penalty(vertices, nothing, backend="xla") == 0


@pytest.mark.parametrize("unit", [False, True])
def test_the_paper_s_gradient(unit):
    """Eq. 9 and 10 from the same classes."""
    vertices, faces = padded("two spheres", "float32")
    label = on_host(vertices, faces, RAYS, 3).labels("triangle")
    found = jax.jit(functools.partial(vertex_gradient, unit=unit))(
        vertices, faces, jnp.asarray(label, jnp.int32)
    )
    expected = boundary.vertex_gradient(vertices.astype(float), faces.astype(int), label, unit=unit)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("platform", ["cpu", "gpu", "tpu"])
def test_the_device_path_has_to_be_asked_for(platform, monkeypatch):
    """On every platform the host path is exact, and the device path samples."""
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    assert as_backend("auto") is None
    assert as_backend("numpy") is None and as_backend("xla") == Xla()
    assert as_backend(Xla(sorted=100)) == Xla(sorted=100)


def test_the_program_never_returns_to_the_host():
    vertices, faces = padded("apart", jnp.dtype("float32"))

    def goes_to_the_host(backend):
        def loss(vertices):
            return self_intersection_penalty(vertices, faces, rays=RAYS, backend=backend)

        text = jax.jit(jax.value_and_grad(loss)).lower(vertices).as_text()
        return [word for word in ("callback", "infeed", "outfeed", "send", "recv") if word in text]

    assert goes_to_the_host("xla") == []
    assert goes_to_the_host("numpy") == ["callback"]
