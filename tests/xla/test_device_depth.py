"""Overlaps of any depth on the device: every pair of solids counts once, whatever lies over what.

Without `overlap.measure` and the public functions: the device path by itself, against the host's
beams and against arithmetic.
"""

import functools

import jax
import numpy as np
import pytest
from helpers import moved, random_rotation, sampling
from helpers_depth import DEEP, as_mesh, by_rays, from_pairs, overlap, pushes

from spt_jax.xla.backend import Program, as_task, penalty_on_device
from spt_jax.xla.settings import Xla

RAYS = 96
DIRECTION = (0.0, 0.0, -1.0)
_TURNED = random_rotation(np.random.default_rng(3))
_MOST = max(map(len, DEEP.values()))
# As parts of the largest result: single precision, and rounding alone.
EXACT = {"float32": 1e-5, "float64": 1e-12}


def padded(name, dtype, rotation=_TURNED):
    """The boxes in arrays of one size, so that the device path is compiled once a precision."""
    vertices, faces = moved(as_mesh(DEEP[name]), rotation)
    vertices = np.concatenate([vertices, np.repeat(vertices[:1], 8 * _MOST - len(vertices), 0)])
    faces = np.concatenate([faces, np.zeros((12 * _MOST - len(faces), 3), int)])
    return vertices.astype(dtype), faces.astype(np.int32)


@jax.jit
def on_device(vertices, faces):
    program = Program(Xla(), RAYS, value="volume", gradient="boundary")
    task = as_task(program, sampling(RAYS, [DIRECTION]), vertices.dtype)
    return penalty_on_device(vertices, faces, task)


def together(function, mesh):
    volume, gradient = function(*mesh)
    return np.append(np.float64(volume), np.asarray(gradient, np.float64))


@pytest.mark.parametrize("name", DEEP)
def test_equals_the_host_s_beams(name, dtype):
    vertices, faces = padded(name, dtype)
    volume, gradient = on_device(vertices, faces)
    mesh = vertices.astype(np.float64), faces.astype(np.int64)
    expected, slope = by_rays(mesh, RAYS, [DIRECTION])
    assert volume.dtype == dtype and gradient.dtype == dtype
    assert float(volume) == pytest.approx(expected, rel=EXACT[dtype.name], abs=0.0)
    scale = np.abs(slope).max()
    np.testing.assert_allclose(gradient, slope, rtol=0, atol=EXACT[dtype.name] * scale)
    assert (name == "box in a cavity") == (scale == 0)


@pytest.mark.parametrize("name", DEEP)
def test_boxes_by_arithmetic(name, dtype):
    """The volume, and how it changes as each box moves, without the host's path."""
    parts = DEEP[name]
    volume, gradient = on_device(*padded(name, dtype))
    scale = sum(np.prod(part.extents) for part in parts)
    assert float(volume) == pytest.approx(overlap(parts), rel=1e-4, abs=1e-12 * scale)
    by_part = np.asarray(gradient, np.float64).reshape(_MOST, 8, 3)[: len(parts)].sum(axis=1)
    np.testing.assert_allclose(by_part @ _TURNED, pushes(parts), rtol=0, atol=1e-2 * scale)


@pytest.mark.parametrize("name", ["four boxes", "inverted nest", "inverted nest in a box"])
def test_splits_into_pairs(name, dtype):
    """On the same rays, so to rounding."""
    mesh, both = padded(name, dtype), functools.partial(together, on_device)
    whole = both(mesh)
    expected = from_pairs(both, mesh, [12] * len(DEEP[name]))
    np.testing.assert_allclose(
        whole, expected, rtol=0, atol=EXACT[dtype.name] * np.abs(whole).max()
    )


@pytest.mark.parametrize("name", ["four boxes", "inverted nest", "inverted box half in a box"])
def test_gradient_is_the_derivative_of_the_sampled_volume(name, x64, rng):
    """Central differences as all vertices move, by so little that few rays change triangles."""
    vertices, faces = padded(name, "float64")
    _, gradient = on_device(vertices, faces)
    for _ in range(4):
        change = rng.normal(size=vertices.shape)
        up, down = (on_device(vertices + t * change, faces)[0] for t in (1e-7, -1e-7))
        exact = float((gradient * change).sum())
        assert float(up - down) / 2e-7 == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize("name", ["four boxes", "inverted box half in a box"])
def test_gradient_is_the_derivative_along_the_rays(name, dtype):
    """In single precision too: as a box moves along the rays, by less than what is between any two
    walls, all lengths change in proportion, so that the steps may be large."""
    vertices, faces = padded(name, dtype, np.eye(3))
    _, gradient = on_device(vertices, faces)
    for part in range(len(DEEP[name])):
        change = np.zeros_like(vertices)
        change[8 * part : 8 * part + 8, 2] = 1.0
        step = dtype.type(2.0**-8)
        up, down = (on_device(vertices + t * change, faces)[0] for t in (step, -step))
        exact = float((gradient * change).sum())
        assert abs(exact) > 0.01
        tolerance = 1e-3 if dtype == np.float32 else 1e-9
        assert float(up - down) / (2 * float(step)) == pytest.approx(exact, rel=tolerance)
