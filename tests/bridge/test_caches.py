"""What is kept between calls: bounded whatever changes, and given back when that is asked for."""

import gc
import resource
import sys
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, join

from spt_jax import (
    RestSurface,
    _geometry,
    classify_vertices,
    clear_caches,
    self_intersection_penalty,
)
from spt_jax.bridge import on_host
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.overlap.triangles import manifold

PAIR = join(box(), box(center=(0.6, 0.13, 0.07)))


def test_a_bounded_jit_forgets_and_still_answers():
    traced = []

    def scaled(factor, values):
        traced.append(values.shape)
        return factor * values

    bounded = BoundedJit(scaled, most=3)
    for count in (1, 2, 3, 3, 2, 1):
        assert bounded(2.0, jnp.ones(count)).sum() == 2 * count
    assert len(traced) == 3 == len(bounded) == bounded._jitted._cache_size()
    bounded(2.0, jnp.ones(4))
    assert len(bounded) == 1 == bounded._jitted._cache_size()
    assert bounded(3.0, jnp.ones(4)).sum() == 12 and len(bounded) == 2
    assert jax.jit(lambda x: bounded(2.0, x))(jnp.ones(5)).sum() == 10 and len(bounded) == 2
    bounded.clear()
    assert len(bounded) == 0 and bounded(2.0, jnp.ones(1))[0] == 2


@pytest.mark.long
@pytest.mark.parametrize("how", ["value", "gradient"])
def test_inflating_meshes_of_ever_other_sizes_keeps_a_bounded_number_of_programs(how):
    """Under `jax.grad`, too, where arrays are tracers and programs are compiled all the same."""
    clear_caches()

    def step(vertices):
        inflated = lambda v: _geometry.inflate(v, PAIR[1], 0.01)  # noqa: E731
        if how == "value":
            return inflated(vertices)
        return jax.vjp(inflated, vertices)[1](vertices)

    live = []
    before, _geometry._inflated._most = _geometry._inflated._most, 3
    try:
        for count in range(10):
            vertices = np.concatenate([PAIR[0], np.zeros((count, 3))])
            step(jax.device_put(np.float32(vertices)))
            live.append(len(jax.devices()[0].client.live_executables()))
    finally:
        _geometry._inflated._most = before
    assert len(_geometry._inflated) == 1
    assert max(live[3:]) <= max(live[:3]), live


def test_a_margin_leaves_no_program():
    """It is kept on the host."""
    clear_caches()
    for count in range(3):
        vertices = np.float32(np.concatenate([PAIR[0], np.zeros((count, 3))]))
        value = self_intersection_penalty(jax.device_put(vertices), PAIR[1], margin=0.01 + count)
        assert value > 0.3
    assert len(_geometry._inflated) == 0


def test_new_values_of_every_option_keep_a_bounded_number_of_things(rng):
    """Directions, groups, distances, faces and rest surfaces, new in every call."""
    vertices = jnp.asarray(PAIR[0], "float32")
    kept = weakref.WeakSet()
    for k in range(40):
        faces = np.roll(PAIR[1], k, axis=0)
        rest = RestSurface(PAIR[0] * (1 + k / 100), faces, distance=0.01)
        kept.add(rest)
        self_intersection_penalty(
            vertices,
            faces,
            directions=rng.normal(size=(3, 3)),
            face_groups=np.roll(np.repeat([0, 1], 12), k),
            ignore_groups=((0, 0),),
            rest_surface=rest,
            margin=1e-3 * k,
        )
        classify_vertices(vertices, faces, rest_surface=rest)
    gc.collect()
    assert len(kept) <= 16
    cache = on_host._result_cache
    assert len(cache._queries) <= 8 and len(cache._faces) <= 4 and len(cache._results) <= 8
    clear_caches()
    assert len(kept) <= 1  # the last one is this function's own
    assert not cache._results and not cache._faces and len(manifold._manifolds) == 0


def test_compiled_programs_are_given_back_too():
    """Equinox' own way to clear its caches leaves those of JAX: 370 MB of 60 programs stayed."""
    client = jax.devices()[0].client
    for count in range(8, 12):
        vertices = np.concatenate([PAIR[0], np.zeros((count, 3))])
        step = lambda v: _geometry.inflate(v, PAIR[1], 0.01).sum()  # noqa: E731
        jax.value_and_grad(step)(jnp.asarray(vertices, "float32"))
    assert len(client.live_executables()) >= 8
    clear_caches()
    assert len(client.live_executables()) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_does_not_grow_with_the_number_of_calls(rng):
    """1.3 MB a call were kept once; here 120 calls may keep 10 MB."""
    vertices = jnp.asarray(PAIR[0], "float32")

    def calls(count):
        for _ in range(count):
            options = {"rays": 8, "directions": rng.normal(size=(3, 3))}
            jax.value_and_grad(lambda v: self_intersection_penalty(v, PAIR[1], **options))(vertices)  # noqa: B023

    def resident():
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize()

    calls(30)
    before = resident()
    calls(120)
    assert resident() - before < 10e6
