"""Groups and folds of simple solids on the device."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import join, moved, random_rotation, sphere
from helpers_device import SOLIDS, padded

from spt_jax import self_intersection_penalty
from spt_jax.device.pair_search import over_crossing_pairs
from spt_jax.device.patches import spread
from spt_jax.device.triangle_pairs import cross_each_other
from spt_jax.overlap.triangles.pairs import edge_crossings, face_pairs


def test_groups_as_on_the_host():
    """What two of three boxes share does not count, nor does anything where they are only two."""
    faces = padded("three boxes", "float32")[1]
    groups = np.concatenate([np.repeat([0, 1, 2], 12), np.full(len(faces) - 36, 2)])

    def penalty(vertices, faces, backend):
        return self_intersection_penalty(
            vertices, faces, rays=48, face_groups=groups, ignore_groups=[(0, 1)], backend=backend
        )

    both = jax.jit(jax.value_and_grad(penalty), static_argnums=2)
    found, expected = (both(*padded("three boxes", "float32"), name) for name in ("xla", "numpy"))
    assert float(found[0]) == pytest.approx(float(expected[0]), rel=1e-5) and found[0] > 0.1
    scale = np.abs(expected[1]).max()
    np.testing.assert_allclose(found[1], expected[1], rtol=0, atol=1e-5 * scale)
    value, gradient = both(*padded("two boxes", "float32"), "xla")
    assert value == 0 and not gradient.any()


def test_triangles_that_cross(rng):
    """The pairs that the host finds on its own, and no others of as many."""
    vertices, faces = moved(
        join(sphere(subdivisions=2), sphere(center=(1.2, 0.1, 0.05), subdivisions=2)),
        random_rotation(rng),
    )
    half = len(faces) // 2
    first, second = np.divmod(np.arange(half * half), half)
    second += half
    found = cross_each_other(
        *(
            jnp.asarray(x, x.dtype.name.replace("64", "32"))
            for x in (vertices, faces[first], faces[second])
        )
    )
    pairs = {(f, g) for f, g in zip(first[found], second[found], strict=True)}
    assert len(pairs) > 30
    expected = face_pairs(edge_crossings(vertices, faces))
    assert pairs == {tuple(sorted(pair)) for pair in expected.tolist()}


@pytest.mark.parametrize("name", SOLIDS)
def test_the_search_finds_every_pair(name, dtype):
    """As the host's: contact is none, and pairs that share a vertex are among them."""
    vertices, faces = padded(name, dtype)
    # Closer together, a cluster's own triangles cross as well.
    vertices[: len(vertices) // 3] += dtype.type(0.05)

    def add(found, first, second, crosses):
        return found.at[first, second].add(crosses.astype(jnp.int32))

    count = len(faces)
    search = jax.jit(
        lambda v: over_crossing_pairs(
            v, jnp.asarray(faces), add, jnp.zeros((count, count), "int32")
        )
    )
    found = np.asarray(search(jnp.asarray(vertices)))
    assert found.max(initial=0) <= 1 and not (found & found.T).any()
    expected = face_pairs(edge_crossings(vertices.astype(np.float64), faces.astype(np.int64)))
    assert sorted(map(sorted, np.argwhere(found).tolist())) == expected.tolist()


def test_spread_stays_within_a_patch():
    """From one vertex over its own box of the three, though not over all of it."""
    _, faces = SOLIDS["three boxes"]
    members = np.ones(24, bool)
    members[[8, 9]] = False
    seeds = np.zeros(24, bool)
    seeds[12] = True
    reached = np.flatnonzero(spread(*map(jnp.asarray, (seeds, members, faces.astype(np.int32)))))
    assert reached.tolist() == [10, 11, 12, 13, 14, 15]
