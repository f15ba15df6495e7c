"""What was measured last: no mesh is measured twice, and none is taken for another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spt_jax.bridge import callback, on_host
from spt_jax.bridge.result_cache import _ENTRY_BYTES, ResultCache

FACES = np.array([[0, 1, 2], [0, 2, 1]], np.int32)
measured = []


def twice(vertices, faces, options):
    """A host function that says for what it was called."""
    measured.append((float(vertices.sum()), faces.tolist(), options))
    return np.array(vertices.sum()), 2 * vertices


@pytest.fixture(autouse=True)
def nothing_yet():
    measured.clear()
    callback.clear_results()


def ask(vertices, faces=FACES, options=None):
    name = vertices.dtype.name
    results = ((), name), (vertices.shape[-2:], name)
    found = callback.call_on_host(twice, options, results, vertices, jnp.asarray(faces))
    return jax.block_until_ready(found)


def some(count, dtype="float32", seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(count, 3, 3)), dtype)


def test_each_mesh_is_measured_once(dtype):
    batch = some(5, dtype)
    first = ask(batch)
    assert len(measured) == 5
    again = ask(batch[::-1])
    under_vmap = jax.jit(jax.vmap(ask))(batch)
    alone = ask(batch[3])
    assert len(measured) == 5
    for k in (0, 1):
        np.testing.assert_array_equal(again[k], first[k][::-1])
        np.testing.assert_array_equal(under_vmap[k], first[k])
        np.testing.assert_array_equal(alone[k], first[k][3])
    np.testing.assert_array_equal(first[1], 2 * batch)
    ask(jnp.concatenate([batch, some(1, dtype, seed=1)]))
    assert len(measured) == 6


def test_equal_meshes_of_a_batch_are_measured_once():
    one, other = some(2)
    value, double = ask(jnp.stack([one, other, one, one, other]))
    assert len(measured) == 2
    np.testing.assert_array_equal(double, 2 * jnp.stack([one, other, one, one, other]))
    assert value[0] == value[2] == value[3] != value[1] == value[4]


def test_what_differs_in_anything_is_measured():
    (one,) = some(1)
    ask(one)
    ask(one.at[0, 0].set(jnp.nextafter(one[0, 0], 9.0)))
    ask(one, FACES[::-1].copy())
    ask(one, options="others")
    assert len(measured) == 4
    assert [call[1:] for call in measured[2:]] == [
        (FACES[::-1].tolist(), None),
        (FACES.tolist(), "others"),
    ]
    zero = jnp.zeros((3, 3), "float32")
    ask(zero)
    ask(-zero)
    assert len(measured) == 6
    nothing = zero * jnp.nan
    ask(nothing)
    ask(nothing)
    assert len(measured) == 7


def test_results_cannot_be_changed_through_what_was_returned():
    (one,) = some(1)
    work = on_host.Work(twice, None, (((), "float32"), ((3, 3), "float32")))
    for _ in range(2):
        _, found = on_host.measured(work, np.asarray(one)[None], FACES[None])
        np.testing.assert_array_equal(found[0], 2 * one)
        found[:] = 7.0
    assert len(measured) == 1


# Vertices, results, and what Python keeps for an entry.
ENTRY = 144 + _ENTRY_BYTES


def remember(cache, vertices, faces, asked="doubled"):
    def measure(meshes):
        measured.extend(meshes)
        return [(2 * v,) for v, _ in meshes]

    return cache.results(asked, [(v, cache.faces(faces)) for v in vertices], measure)


def test_memory_is_bounded_and_the_oldest_goes_first(rng):
    cache = ResultCache(most_bytes=10 * ENTRY)
    meshes = rng.normal(size=(12, 3, 3))
    for mesh in meshes[:10]:
        remember(cache, [mesh], FACES)
    remember(cache, meshes[:1], FACES)  # used again, so not the oldest any more
    assert len(measured) == 10
    remember(cache, meshes[10:], FACES)
    assert cache._bytes == 10 * ENTRY
    remember(cache, [meshes[0], *meshes[3:]], FACES)
    assert len(measured) == 12
    remember(cache, meshes[1:2], FACES)
    assert len(measured) == 13
    cache.clear()
    assert cache._bytes == 0


def test_a_few_lists_of_faces_and_only_their_results(rng):
    cache = ResultCache(most_faces=2)
    (mesh,) = rng.normal(size=(1, 3, 3))
    lists = [np.roll(FACES, k, axis=1) for k in range(3)]
    assert cache.faces(lists[0]) is cache.faces(lists[0].copy())
    assert cache.faces(lists[0]).dtype == np.int64
    for faces in lists:
        remember(cache, [mesh], faces)
    assert len(cache._results) == 2 and cache._bytes == 2 * ENTRY
    remember(cache, [mesh], lists[2])
    assert len(measured) == 3
    remember(cache, [mesh], lists[0])
    assert len(measured) == 4


def test_larger_than_the_memory_is_not_kept(rng):
    cache = ResultCache(most_bytes=100)
    mesh = rng.normal(size=(1, 3, 3))
    np.testing.assert_array_equal(remember(cache, mesh, FACES)[0][0], 2 * mesh[0])
    assert cache._bytes == 0 and not cache._results


def test_a_few_questions_and_only_their_results(rng):
    """Options may hold megabytes: a loop that asks with new ones each time keeps few of them."""
    cache = ResultCache(most_queries=2)
    (mesh,) = rng.normal(size=(1, 3, 3))
    for asked in ("one", "two", "one", "three"):
        remember(cache, [mesh], FACES, asked)
    assert len(measured) == 3
    assert list(cache._queries) == ["one", "three"]
    assert len(cache._results) == 2 and cache._bytes == 2 * ENTRY
    remember(cache, [mesh], FACES, "two")
    assert len(measured) == 4
    cache.clear_all()
    assert not cache._queries and not cache._faces and cache._bytes == 0
