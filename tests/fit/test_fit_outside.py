"""What no photograph shows is a status of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import embedded_body
from helpers_fit import camera, frames, objective, seen

from spt_jax import RESULTS, PinholeCamera
from spt_jax._status import OUTSIDE, names_of
from spt_jax.fit.problem import photograph
from spt_jax.fit.problem.photograph import DISTANCE, FOCAL, SIZE, is_too_wide, outside_photographs
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.result import FitResult

POSE = frames("walk/0010")[0]
ONES = np.ones(22)


@jax.jit
def _status(eye, keypoints, trust, place, scale):
    body, dtype = embedded_body(), keypoints.dtype
    part = objective(keypoints, camera=eye, confidence=trust)
    vector = part.pack(Variables(POSE.astype(dtype), jnp.zeros(body.num_shape, dtype), place))
    return outside_photographs(part, vector, scale * VERTICES)


VERTICES = embedded_body()(POSE).vertices
POINTS = np.asarray(seen(POSE))


def status(
    dtype, *, z=0.0, focal=1000.0, center=(500.0, 480.0), scale=1.0, points=POINTS, trust=ONES
):
    """Of a body that walks 4 m before a camera, moved by z towards it and resized."""
    usual = camera(dtype)
    eye = (np.asarray(focal, dtype), np.asarray(center, dtype), usual.rotation, usual.translation)
    place = np.array([0.0, 0.0, z], dtype)
    scale = np.asarray(scale, np.float32)
    found = _status(
        PinholeCamera(*eye), np.asarray(points, dtype), trust.astype(dtype), place, scale
    )
    return int(found)


def test_what_photographs_show_is_none_of_them(dtype):
    assert status(dtype) == 0
    assert status(dtype, z=-150.0) == status(dtype, z=3.0) == 0  # 154 m and 1 m away
    astray = POINTS.copy()
    astray[[3, 8]] = 1e5  # a detector's mistakes
    assert status(dtype, points=astray) == 0
    assert status(dtype, trust=np.arange(22) == 4) == 0


@pytest.mark.parametrize(
    ("code", "given"),
    [
        (DISTANCE, {"z": -250.0, "focal": 1e5}),
        (DISTANCE, {"z": 3.95}),
        (DISTANCE, {"z": 9.0}),  # behind the camera
        (SIZE, {"z": -190.0, "focal": 500.0}),
        (SIZE, {"scale": 5.0}),
        (SIZE, {"scale": 0.05}),
        (FOCAL, {"focal": 35.0, "center": (900.0, 500.0)}),  # in millimetres
    ],
)
def test_what_no_photograph_shows(code, given, dtype):
    assert status(dtype, **given) == code


def test_each_status_is_said_in_words():
    shapes = {"pose": (0, 3), "shape": (0,), "translation": (3,), "vertices": (0, 3)}
    shapes |= {"joints": (0, 3), "keypoints": (0, 2)}
    names = ("successful", "nonlinear_max_steps_reached", "not_finite", "unseen", *OUTSIDE)
    arrays = {name: jnp.zeros((7, *shape)) for name, shape in shapes.items()}
    each = [getattr(RESULTS, name) for name in names]
    status = jax.tree.map(lambda *leaves: jnp.stack([*map(jnp.asarray, leaves)]), *each)
    result = FitResult(**arrays, steps=jnp.arange(7), terms={}, status=status)
    assert result.as_dict()["status"] == names_of(status) == list(names)
    assert result.converged.tolist() == [True] + [False] * 6
    # The messages quote the limits, which stand elsewhere.
    quoted = {
        DISTANCE: (photograph.NEAREST, photograph.FARTHEST),
        SIZE: (photograph.SMALLEST, photograph.LARGEST, photograph.LEAST_PIXELS),
        FOCAL: (photograph.WIDEST,),
    }
    for reason, limits in zip(result.reason[4:], quoted.values(), strict=True):
        assert reason.split(":")[0].endswith("outside any photograph")
        assert all(f" {limit:g} " in reason for limit in limits)


def test_focal_lengths_in_millimetres_are_too_wide():
    size = (640, 480)
    assert is_too_wide(PinholeCamera(35.0, (320.0, 240.0)), size)
    assert not is_too_wide(PinholeCamera(150.0, (320.0, 240.0)), size)
    assert not is_too_wide(PinholeCamera.from_field_of_view(*size), size)
    assert not is_too_wide(PinholeCamera(5000.0, (112.0, 112.0)), (224, 224))
