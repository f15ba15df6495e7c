"""Holes on the device: the fans of the host, and the gradient through them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, join

from spt_jax import self_intersection_penalty
from spt_jax.xla.holes import closed_on_device


def boxes():
    """Two boxes that overlap, each without a triangle whose hole the other one reaches through."""
    first, second = box(), box()
    vertices, faces = join(first, (second[0] + [0.6, 0.11, 0.07], second[1]))
    normal = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    gone = [int(np.argmax(normal[:12, 0])), 12 + int(np.argmin(normal[12:, 0]))]
    return vertices.astype(np.float32), np.delete(faces, gone, axis=0).astype(np.int32)


def test_fans_close_what_rays_go_through():
    vertices, faces = boxes()
    value = lambda v, backend: self_intersection_penalty(v, faces, backend=backend)  # noqa: E731
    found, slope = jax.value_and_grad(lambda v: value(v, "xla"))(jnp.asarray(vertices))
    exact, wanted = jax.value_and_grad(lambda v: value(v, "numpy"))(jnp.asarray(vertices))
    assert exact > 0.2
    np.testing.assert_allclose(found, exact, rtol=0.01)
    np.testing.assert_allclose(slope, wanted, atol=0.02 * np.abs(wanted).max())
    # A hole that is too large is one on the device, too.
    sheet = faces[[0, 1]]
    wider, _, too_large = closed_on_device(jnp.asarray(vertices), sheet, everything=True)
    assert too_large is not None and bool(too_large)
    assert wider.shape[0] > len(vertices)
    batch = jnp.stack([jnp.asarray(vertices), 2 * jnp.asarray(vertices)])
    fits = closed_on_device(batch, faces, everything=True)[2]
    assert fits is not None and fits.shape == (2,) and not fits.any()


def test_holes_that_stay_open_are_said():
    vertices, faces = boxes()
    with pytest.warns(UserWarning, match="leaves out rays through 2 holes"):
        same = closed_on_device(jnp.asarray(vertices), faces, everything=False)
    assert same[1] is faces and same[2] is None
