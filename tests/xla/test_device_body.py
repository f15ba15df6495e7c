"""The device path on real poses: as the host's rays, with folds and without."""

import jax
import numpy as np
import pytest
from helpers import body_faces, embedded_body, posed_bodies
from helpers_device import on_host

from spt_jax import classify_vertices, self_intersection_penalty

FACES = body_faces().astype(np.int32)
RAYS = 128


@pytest.mark.slow
def test_poses_as_on_the_host():
    """A batch of two in single precision; a part of a ray or two may meet the next triangle."""
    bodies = posed_bodies(["crawl/0092", "run/0010"]).astype(np.float32)

    def penalty(vertices):
        return self_intersection_penalty(vertices, FACES, rays=RAYS, backend="xla")

    values, pullback = jax.vjp(penalty, bodies)
    (gradients,) = pullback(np.ones_like(values))
    for body, value, gradient in zip(bodies, values, gradients, strict=True):
        found = on_host(body, FACES, RAYS, 3)
        assert found.volume > 1e-6
        assert float(value) == pytest.approx(found.volume, rel=1e-5)
        expected = found.gradient("boundary", "triangle")
        assert np.linalg.norm(gradient - expected) < 1e-5 * np.linalg.norm(expected)


@pytest.mark.slow
def test_folds_do_not_count():
    """Whether anything counts, which vertices, and which part of a region that folds here and
    collides there: that hangs on all of its rim, which few rays meet."""
    bodies = posed_bodies(["crawl/0028", "walk/0002", "backflip/0000"]).astype(np.float32)
    rest = embedded_body().rest_surface

    def ratio(vertices):
        return self_intersection_penalty(
            vertices, FACES, value="ratio", rays=RAYS, rest_surface=rest, backend="xla"
        )

    values, pullback = jax.vjp(ratio, bodies)
    (gradients,) = pullback(np.ones_like(values))
    expected = classify_vertices(bodies, FACES, rest_surface=rest, backend="numpy").ratio
    np.testing.assert_allclose(values, expected, rtol=1e-5)
    assert values[0] > 0 and values[2] > 0
    assert values[1] == 0 and not gradients[1].any()
    for k in (0, 2):
        volume, slope = jax.value_and_grad(
            lambda v: self_intersection_penalty(
                v, FACES, rays=RAYS, rest_surface=rest, backend="numpy"
            )
        )(bodies[k])
        assert volume > 0
        assert np.linalg.norm(gradients[k] - slope) < 1e-3 * np.linalg.norm(slope)
