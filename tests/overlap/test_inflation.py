"""The surface moved outwards on the host: the same as in JAX, and the same derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import body_faces, box, embedded_body, join, mocap, sphere

from spt_jax import self_intersection_penalty
from spt_jax._geometry import inflate
from spt_jax.overlap.inflation import Inflated


def posed():
    body = embedded_body()
    vertices = body(body.pose_from_smpl(jnp.asarray(mocap().pose[300]))).vertices
    return np.asarray(vertices, np.float64), body_faces().astype(np.int64)


def cone():
    mesh = trimesh.creation.cone(0.1, 2.0)  # with a tip that moves three distances at most
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def with_slivers():
    """Triangles without an area, a vertex of no triangle, and two of one place."""
    vertices, faces = box()
    vertices = np.concatenate([vertices, [[5.0, 5.0, 5.0]], vertices[:1]])
    return vertices, np.concatenate([faces, [[0, 0, 1], [0, 9, 1]]]).astype(np.int64)


MESHES = {
    "body": posed,
    "box": box,
    "boxes": lambda: join(box(), box(center=(0.7, 0.6, 0.5))),
    "sphere": lambda: sphere(subdivisions=2),
    "cone": cone,
    "slivers": with_slivers,
    "point": lambda: (np.zeros((3, 3)), np.array([[0, 1, 2]])),
}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("distance", [0.01, -0.003])
def test_the_host_moves_a_surface_as_jax_does(name, distance, x64):
    vertices, faces = MESHES[name]()
    faces = np.asarray(faces, np.int64)
    rng = np.random.default_rng(3)
    found = Inflated(vertices, faces, distance, float(np.finfo(np.float64).eps))
    there, back = jax.vjp(lambda v: inflate(v, faces, distance), jnp.asarray(vertices))
    np.testing.assert_allclose(found.vertices, there, atol=1e-13)
    for part in (1.0, 0.05):
        forces = rng.normal(size=vertices.shape) * (rng.random(len(vertices)) < part)[:, None]
        (expected,) = back(jnp.asarray(forces))
        np.testing.assert_allclose(
            found.pulled_back(forces), expected, rtol=1e-9, atol=1e-9 * (1 + np.abs(expected).max())
        )


def test_no_force_stays_none():
    vertices, faces = sphere(subdivisions=2)
    found = Inflated(vertices, np.asarray(faces, np.int64), 0.1, 1e-16)
    assert not found.pulled_back(np.zeros(vertices.shape)).any()


def test_a_margin_is_the_penalty_of_the_surface_moved_outwards(x64):
    vertices, faces = posed()
    found = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, margin=0.004))
    apart = jax.value_and_grad(lambda v: self_intersection_penalty(inflate(v, faces, 0.002), faces))
    (value, gradient), (expected, slope) = (f(jnp.asarray(vertices)) for f in (found, apart))
    assert value == pytest.approx(float(expected), rel=1e-12) and value > 0
    np.testing.assert_allclose(gradient, slope, rtol=1e-8, atol=1e-9 * np.abs(slope).max())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_nan(bad):
    vertices, faces = box()
    vertices = np.array(vertices, np.float32)
    vertices[0, 0] = bad
    call = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, margin=0.1))
    value, gradient = call(jnp.asarray(vertices))
    assert np.isnan(value)
    np.testing.assert_array_equal(gradient, 0.0)
