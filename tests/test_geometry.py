"""Inflation: how far triangles move, and that nothing in it is ever NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from helpers import bent_tube, body_faces, box, inverted, moved, posed_bodies, random_rotation
from helpers import sphere as solid_sphere

from spt_jax._geometry import FARTHEST, inflate


def normals(vertices, faces):
    a, b, c = np.asarray(vertices, float)[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross / np.where(length > 0, length, 1)


def slow_displacement(vertices, faces):
    """One vertex after the other, straight from the definition."""
    normal = normals(vertices, faces)
    out = np.zeros_like(vertices)
    for v in range(len(vertices)):
        total, around = np.zeros(3), []
        for f in np.flatnonzero((faces == v).any(axis=1)):
            k = list(faces[f]).index(v)
            p, q = (vertices[faces[f][(k + i) % 3]] - vertices[v] for i in (1, 2))
            cosine = p @ q / np.linalg.norm(p) / np.linalg.norm(q)
            total += np.arccos(np.clip(cosine, -1, 1)) * normal[f]
            around.append((np.arccos(np.clip(cosine, -1, 1)), normal[f]))
        direction = total / np.linalg.norm(total)
        angles, cosines = np.array([(angle, n @ direction) for angle, n in around]).T
        needed = 1 / np.maximum(cosines, 1 / FARTHEST)
        # A smooth largest one: the logarithm of a mean of exponentials.
        mitre = scipy.special.logsumexp(8192 * needed, b=angles / angles.sum()) / 8192
        assert 0.999 * needed.max() <= mitre <= needed.max() * (1 + 1e-12)
        out[v] = mitre * direction
    return out


MESHES = {
    "box": moved(box((1.0, 2.0, 0.1)), random_rotation(np.random.default_rng(1))),
    "sphere": solid_sphere(subdivisions=1),
    "tube": bent_tube(0.5, 0.2, 0.1, sides=8, steps=24),
}


@pytest.mark.parametrize("name", MESHES)
def test_equals_the_slow_definition(name, dtype):
    vertices, faces = MESHES[name]
    got = inflate(jnp.asarray(vertices, dtype), faces, 0.25)
    assert got.dtype == dtype
    expected = vertices + 0.25 * slow_displacement(vertices, faces)
    np.testing.assert_allclose(got, expected, atol=2e-6 if dtype == np.float32 else 1e-12)


def test_every_triangle_of_a_posed_body_moves_at_least_the_distance(x64):
    vertices, faces = posed_bodies(["crawl/0092"])[0], body_faces()
    shift = np.asarray(inflate(jnp.asarray(vertices), faces, 1.0)) - vertices
    outwards = np.einsum("fkc,fc->fk", shift[faces], normals(vertices, faces))
    length = np.linalg.norm(shift, axis=1)
    whole = (length < 0.999 * FARTHEST)[faces]  # neither cut short by the farthest move
    assert whole.mean() > 0.99
    assert outwards[whole].min() > 1 - 1e-3  # of small angles among large ones
    assert np.median(outwards[whole]) > 1 - 1e-9
    assert length.max() <= FARTHEST + 1e-9
    assert np.median(length) < 1.05


def test_a_box_grows_by_the_distance_on_every_side(x64):
    vertices, faces = box((1.0, 2.0, 0.1), center=(3.0, 0.0, 0.0))
    grown = np.asarray(inflate(jnp.asarray(vertices), faces, 0.2))
    np.testing.assert_allclose(grown - vertices, 0.2 * np.sign(vertices - [3.0, 0, 0]), atol=1e-12)
    inner = np.asarray(inflate(jnp.asarray(vertices), inverted((vertices, faces))[1], 0.01))
    np.testing.assert_allclose(inner - vertices, -0.01 * np.sign(vertices - [3.0, 0, 0]), atol=1e-9)


def test_moves_and_scales_with_the_mesh(x64, rng):
    vertices, faces = MESHES["tube"]
    turned, _ = moved((vertices, faces), random_rotation(np.random.default_rng(3)), (1, 2, 3), 1e-9)
    shift = slow_displacement(turned, faces) * 1e-11
    got = inflate(jnp.asarray(turned), faces, 1e-11)
    np.testing.assert_allclose(got, turned + shift, atol=1e-20 + 1e-15)
    order = rng.permutation(len(faces))
    shuffled = inflate(jnp.asarray(vertices), np.roll(faces[order], 1, axis=1), 0.1)
    np.testing.assert_allclose(shuffled, inflate(jnp.asarray(vertices), faces, 0.1), atol=1e-14)


def test_batches_jit_and_vmap_agree():
    vertices, faces = MESHES["tube"]
    batch = jnp.asarray(np.stack([vertices, 2 * vertices, vertices + 1]), "float32")[None]
    together = inflate(batch, faces, 0.1)
    assert together.shape == batch.shape
    one_by_one = jnp.stack([inflate(v, faces, 0.1) for v in batch[0]])[None]
    np.testing.assert_allclose(together, one_by_one, atol=1e-6)
    mapped = jax.vmap(jax.vmap(lambda v: inflate(v, jnp.asarray(faces), 0.1)))(batch)
    np.testing.assert_allclose(mapped, together, atol=1e-6)
    traced = jax.jit(inflate)(batch[0, 0], jnp.asarray(faces), jnp.asarray(0.1))
    np.testing.assert_allclose(traced, together[0, 0], atol=1e-6)


def test_derivatives_equal_finite_differences(x64, rng):
    vertices, faces = solid_sphere(subdivisions=1)
    vertices = jnp.asarray(vertices + rng.normal(scale=0.03, size=vertices.shape))
    weights = jnp.asarray(rng.normal(size=vertices.shape))

    def number(v, distance=0.2):
        return jnp.sum(weights * inflate(v, faces, distance))

    direction = jnp.asarray(rng.normal(size=vertices.shape))
    step = 1e-6
    slope = (number(vertices + step * direction) - number(vertices - step * direction)) / (2 * step)
    by_distance = (number(vertices, 0.2 + step) - number(vertices, 0.2 - step)) / (2 * step)
    gradient, distance_gradient = jax.jit(jax.grad(number, (0, 1)))(vertices, 0.2)
    np.testing.assert_allclose(jnp.sum(gradient * direction), slope, rtol=1e-6)
    np.testing.assert_allclose(distance_gradient, by_distance, rtol=1e-7)


# All of one shape, so that they are compiled once.
FLAT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
SOLID = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
ODD = {
    "unreferenced": (FLAT, [[0, 1, 2]] * 4),
    "no area": (FLAT, [[0, 1, 1], [2, 2, 2], [3, 0, 3], [0, 0, 0]]),
    "collinear": (np.outer([0, 1, 2, 5], [1.0, 2.0, 3.0]), SOLID),
    "all at one point": (0 * FLAT + 1, SOLID),
    "normals cancel": (FLAT, [[0, 1, 2], [0, 2, 1]] * 2),
    "needles": (FLAT * [1, 1e-30, 1], SOLID),
    "tiny": (FLAT * 1e-36, SOLID),
    "huge": (FLAT * 1e36, SOLID),
    "overflow": ((FLAT - 0.5) * 6e38, SOLID),
}


@jax.jit
def _inflated_and_slope(vertices, faces, cotangent):
    moved_vertices, pull = jax.vjp(lambda v: inflate(v, faces, 0.1), vertices)
    return moved_vertices, pull(cotangent)[0]


@pytest.mark.parametrize("name", ODD)
def test_odd_meshes_give_no_nan(name, dtype):
    vertices, faces = jnp.asarray(ODD[name][0], dtype), jnp.asarray(ODD[name][1])
    got, slope = _inflated_and_slope(vertices, faces, jnp.ones_like(vertices))
    assert np.isfinite(got).all() and np.isfinite(slope).all()
    still = np.asarray(got == vertices).all(axis=1)
    if name in ("no area", "collinear", "all at one point", "normals cancel"):
        assert still.all()
        np.testing.assert_array_equal(slope, 1.0)
    if name == "unreferenced":
        np.testing.assert_array_equal(still, [False, False, False, True])


def test_no_faces_and_no_vertices():
    none = np.zeros((0, 3), np.int32)
    np.testing.assert_array_equal(inflate(jnp.asarray(FLAT, "float32"), none, 0.1), FLAT)
    assert inflate(jnp.zeros((2, 0, 3)), none, 0.1).shape == (2, 0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_where_it_is(dtype, bad):
    vertices = jnp.asarray(FLAT, dtype).at[2, 1].set(bad)
    got, slope = _inflated_and_slope(vertices, jnp.asarray(SOLID), jnp.zeros_like(vertices))
    np.testing.assert_array_equal(np.argwhere(~np.isfinite(got)), [[2, 1]])
    np.testing.assert_array_equal(slope, 0.0)


def test_wrong_meshes_are_named(untyped):
    with pytest.raises(ValueError, match="vertices must have shape"):
        inflate(jnp.ones((4, 2)), box()[1], 0.1)
    with pytest.raises(ValueError, match="faces must index into vertices"):
        inflate(jnp.ones((4, 3)), box()[1], 0.1)
