"""The device path's arrays of fixed size: strips that fit, and what does not fit is reported."""

import jax
import numpy as np
import pytest
from helpers_device import on_host, padded

from spt_jax import self_intersection_penalty
from spt_jax.xla.settings import Xla, buffer_sizes
from spt_jax.xla.usage import device_usage

RAYS = 48
SMALL = Xla(segments=95, crossings=200, sorted=160)
# What the fullest rows of these meshes need more of.
TOO_MUCH = {
    "two spheres": {"segments"},
    "two boxes": {"sorted"},
    "three boxes": {"crossings", "sorted"},
}


@jax.jit
def value_and_gradient(vertices, faces):
    def penalty(vertices):
        return self_intersection_penalty(vertices, faces, rays=RAYS, backend=SMALL)

    return jax.value_and_grad(penalty)(vertices)


def short_of(name):
    need, have = device_usage(*padded(name, "float32"), rays=RAYS, settings=SMALL)
    assert have[2:] == SMALL[:3]
    return need, {key for key in Xla._fields[:3] if getattr(need, key) > getattr(have, key)}


@pytest.mark.slow
def test_small_arrays_take_more_strips_and_change_nothing():
    mesh = padded("box in a box", "float32")
    value, gradient = value_and_gradient(*mesh)
    found = on_host(*mesh, RAYS, 3)
    assert float(value) == pytest.approx(found.volume, rel=1e-5)
    expected = found.gradient("boundary", "triangle")
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    need, short = short_of("box in a box")
    assert not short
    assert need.strips > 50 and need.levels == 2 and need.open_rays == 0


@pytest.mark.parametrize("name", TOO_MUCH)
def test_a_row_that_does_not_fit_is_reported(name):
    """NaN without a gradient, and the array that was too small."""
    value, gradient = value_and_gradient(*padded(name, "float32"))
    assert np.isnan(value) and not gradient.any()
    assert short_of(name)[1] == TOO_MUCH[name]


def test_wrong_sizes():
    with pytest.raises(ValueError, match="crossings must be a positive whole number"):
        buffer_sizes(Xla(crossings=0), 64)
    with pytest.raises(ValueError, match="segments must be at most"):
        buffer_sizes(Xla(segments=2**30), 64)
    with pytest.raises(ValueError, match="sorted must be at most"):
        buffer_sizes(Xla(sorted=2**30), 64)
