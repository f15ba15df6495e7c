"""Second derivatives of the overlap volume: analytic values, laws, and central differences."""

import numpy as np
import pytest
from helpers import bent_tube, box, embedded_body, join, posed_bodies, sampling, sphere
from helpers_collisions import body_exclusions
from scipy.spatial.transform import Rotation

from spt_jax._exclusions import as_exclusions
from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.measure import measure

EXACT = sampling(None)
TURN = Rotation.from_rotvec([0.3, 0.2, 0.5]).as_matrix()


def measured(vertices, faces, exclusions=NOTHING):
    return measure(vertices, faces, EXACT, exclusions)


def gradient(vertices, faces, exclusions=NOTHING):
    return measured(vertices, faces, exclusions).gradient("boundary", "vertex")


def differences(vertices, faces, velocity, step, exclusions=NOTHING):
    """The derivative of the gradient along a velocity, by differences of fourth order."""
    near, far = (
        gradient(vertices + h * velocity, faces, exclusions)
        - gradient(vertices - h * velocity, faces, exclusions)
        for h in (step, 2 * step)
    )
    return (8 * near - far) / (12 * step)


def solids():
    """Two spheres, three, a hole, copies in one place, and a box upright in another."""
    ball, other = sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2)
    third = sphere(center=(0.6, 0.9, 0.3), subdivisions=2)
    turned = box((1.0, 1.2, 0.8), (0.6, 0.3, 0.2))
    shapes = {
        "spheres": join(ball, other),
        "three spheres": join(ball, other, third),
        "boxes": join(box(), (turned[0] @ TURN.T, turned[1])),
        "a sphere with a hole": join(
            (ball[0], ball[1][(ball[1] != ball[1][0, 0]).all(axis=1)]), other
        ),
        "copies": join(ball, other, other),
        "a tube in itself": bent_tube(0.4, 0.3, 0.2, sides=12, steps=60),
    }
    return {name: (vertices @ TURN, faces) for name, (vertices, faces) in shapes.items()}


@pytest.mark.parametrize("name", solids())
def test_products_equal_differences_and_are_symmetric(name, rng):
    vertices, faces = solids()[name]
    curvature = measured(vertices, faces).curvature
    velocities = rng.standard_normal((2, *vertices.shape))
    if name == "copies":  # which are smooth in what moves both
        velocities[:, -162:] = velocities[:, -324:-162]
    first, second = (curvature.times(velocity) for velocity in velocities)
    for velocity, product in zip(velocities, (first, second), strict=True):
        expected = differences(vertices, faces, velocity, 1e-7)
        np.testing.assert_allclose(product, expected, atol=1e-7 * np.abs(expected).max())
    size = np.linalg.norm(first) * np.linalg.norm(velocities[1])
    assert abs((first * velocities[1]).sum() - (second * velocities[0]).sum()) < 1e-13 * size


def test_boxes_that_move_against_each_other():
    # (1 - x) (1 - y) (1 - z): of x and y the derivative is 1 - z, of x twice it is nothing.
    shift = np.array([0.3, 0.2, 0.1])
    vertices, faces = join(box(), box(center=shift))
    vertices = vertices @ TURN
    curvature = measured(vertices, faces).curvature
    moves = np.zeros((3, *vertices.shape))
    moves[:, 8:] = TURN[:, None]
    hessian = [[(curvature.times(x) * y).sum() for y in moves] for x in moves]
    x, y, z = 1 - shift
    np.testing.assert_allclose(hessian, [[0, z, y], [z, 0, x], [y, x, 0]], atol=1e-12)


def test_a_lens_gets_steeper_with_its_depth():
    # V = pi (4 + s) (2 - s)^2 / 12 of two unit spheres at distance s, and V'' = pi s / 2 > 0.
    found = []
    for subdivisions in (3, 4):
        vertices, faces = join(
            sphere(subdivisions=subdivisions), sphere(center=(1.2, 0, 0), subdivisions=subdivisions)
        )
        move = np.zeros_like(vertices)
        move[len(vertices) // 2 :, 0] = 1.0
        product = measured(vertices @ TURN, faces).curvature.times(move @ TURN)
        found.append(product * (move @ TURN))
    error = [abs(x.sum() / (np.pi * 0.6) - 1) for x in found]
    assert error[1] < 0.01 and error[1] < 0.5 * error[0]


@pytest.mark.parametrize("name", ["three spheres", "a sphere with a hole", "copies"])
def test_laws_of_motion_and_scale(name):
    vertices, faces = solids()[name]
    found = measured(vertices, faces)
    forces, curvature = found.gradient("boundary", "vertex"), found.curvature
    size = np.abs(forces).max()
    # Shifted as a whole nothing changes; turned, the gradient turns; scaled, it grows squared.
    np.testing.assert_allclose(curvature.times(np.ones_like(vertices)), 0, atol=1e-11 * size)
    axis = np.array([0.2, -0.5, 1.0])
    turned = curvature.times(np.cross(axis, vertices))
    np.testing.assert_allclose(turned, np.cross(axis, forces), atol=1e-11 * size)
    np.testing.assert_allclose(curvature.times(vertices), 2 * forces, atol=1e-11 * size)


@pytest.mark.parametrize("frame", ["cartwheel/0103", "spinkick/0058"])
def test_folds_and_groups_of_bodies(frame, rng):
    body = embedded_body()
    (vertices,), faces = posed_bodies([frame]), np.asarray(body.faces, np.int64)
    groups = as_exclusions(body.part_groups, body.neighbor_pairs, None, faces)
    velocity = np.sin(vertices @ rng.standard_normal((3, 3)) * 8)
    for exclusions in (body_exclusions(), groups):
        found = measured(vertices, faces, exclusions)
        assert found.overlap.judged is not None and found.volume > 0
        product = found.curvature.times(velocity)
        expected = differences(vertices, faces, velocity, 1e-9, exclusions)
        off = np.linalg.norm(product - expected)
        assert 0 < off < 1e-5 * np.linalg.norm(expected)


def test_where_nothing_overlaps_there_is_no_curvature():
    vertices, faces = join(box(), box(center=(3.0, 0.0, 0.0)))
    assert not measured(vertices, faces).curvature.times(np.ones_like(vertices)).any()
    # Nor where sides lie in one plane, of what cannot be distinguished from contact.
    vertices, faces = join(box(), box(center=(0.6, 0.0, 0.0)))
    product = measured(vertices, faces).curvature.times(vertices)
    assert np.isfinite(product).all() and np.abs(product).max() < 10
