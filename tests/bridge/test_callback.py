"""The bridge to the host: no deadlock, no crash at exit, cores that change nothing."""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import join, sphere

from spt_jax import (
    classify_vertices,
    config,
    self_intersection_penalty,
)
from spt_jax.bridge import callback, on_host, process_pool
from spt_jax.overlap import host_functions

SCRIPTS = Path(__file__).parents[1] / "scripts"


def run(*arguments, timeout):
    return subprocess.run(
        [sys.executable, *map(str, arguments)], timeout=timeout, capture_output=True, text=True
    )


@pytest.mark.parametrize(
    "cores", [pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.slow)]
)
def test_no_deadlock(cores):
    """https://github.com/jax-ml/jax/issues/24255, https://github.com/jax-ml/jax/issues/25861.

    With whole arrays instead of pieces the program hangs at 147 kB.
    """
    done = run(SCRIPTS / "no_deadlock.py", cores, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("finished") == 2


def test_work_that_nobody_waits_for_does_not_crash_the_exit():
    done = run(SCRIPTS / "exit_without_waiting.py", timeout=100)
    assert (done.returncode, done.stdout.strip()) == (0, "end"), done.stderr


def test_double_precision_in_a_context_reaches_the_host():
    """The callback's thread does not see the caller's `enable_x64`: nothing is rounded there."""
    vertices, faces = join(sphere(), sphere(center=(1.1, 0.2, 0.1)))
    with jax.enable_x64(True):
        step = jax.jit(jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, rays=32)))
        exact = jnp.asarray(vertices * (1 + 1e-9))
        results = [jax.block_until_ready(step(exact)) for _ in range(20)]
        batch = jax.block_until_ready(jax.vmap(step)(exact[None]))
    for value, gradient in results:
        assert value.dtype == gradient.dtype == np.float64
        assert float(value) == float(results[0][0])
    assert float(batch[0][0]) == float(results[0][0])
    with jax.enable_x64(True):
        rounded = step(jnp.asarray(vertices))
    assert 0 < abs(float(rounded[0]) / float(results[0][0]) - 1) < 1e-7  # not cut to float32


def test_one_callback_for_a_batch_and_known_faces_stay_here():
    """`vmap` asks once for all lanes; what is known when traced is no operand of the program."""
    vertices, faces = join(sphere(subdivisions=3), sphere(subdivisions=3))
    batch = jnp.zeros((5, 4, *vertices.shape), "float32")
    step = jax.jit(jax.vmap(jax.vmap(lambda v: self_intersection_penalty(v, faces, rays=8))))
    program = step.lower(batch).as_text()
    (call,) = [line for line in program.splitlines() if "xla_ffi_python" in line]
    # In pieces of at most 96 kB, and with no piece of the faces.
    operands = [int(size) for size in re.findall(r"tensor<(\d+)xf32>", call.split(") ->")[0])]
    assert sum(operands) == 20 * vertices.size and max(operands) <= 24 * 1024
    assert "xi32>" not in call


def test_a_batch_sharded_over_devices_stays_sharded():
    """Each of four devices has its own meshes measured, in every way of calling."""
    done = run(SCRIPTS / "sharded.py", timeout=100)
    assert (done.returncode, done.stdout.strip()) == (0, "end"), done.stderr


def test_export_says_what_it_cannot_hold():
    vertices, faces = join(sphere(subdivisions=1), sphere(subdivisions=1))
    exact = jax.jit(lambda v: self_intersection_penalty(v, faces))
    shape = jax.ShapeDtypeStruct(vertices.shape, "float32")
    with pytest.raises(ValueError, match=r'jax.export cannot hold .* with backend="xla"'):
        jax.export.export(exact)(shape)
    labels = jax.jit(lambda v: classify_vertices(v, faces, backend="xla").labels)
    exported = jax.export.export(labels)(shape)
    given = jnp.asarray(vertices, "float32")
    np.testing.assert_array_equal(exported.call(given), classify_vertices(given, faces).labels)


def test_shard_map():
    vertices, faces = join(sphere(subdivisions=2), sphere(center=(1.1, 0.2, 0.1), subdivisions=2))
    batch = jnp.stack([jnp.asarray(vertices * s, "float32") for s in (1.0, 1.1)])

    def total(v):
        return self_intersection_penalty(v, faces, rays=32)

    devices = jax.make_mesh((1,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = jax.sharding.PartitionSpec("d")
    # The type of a callback's result does not say that it differs by device.
    sharded = jax.shard_map(total, mesh=devices, in_specs=spec, out_specs=spec, check_vma=False)
    np.testing.assert_allclose(sharded(batch), total(batch))
    gradient = jax.jit(jax.grad(lambda v: sharded(v).sum()))(batch)
    np.testing.assert_allclose(gradient, jax.grad(lambda v: total(v).sum())(batch))


def test_too_little_memory_is_nan_and_no_crash(monkeypatch):
    def hungry(*_):
        raise MemoryError

    monkeypatch.setattr(host_functions, "measure", hungry)
    vertices, faces = join(sphere(subdivisions=1), sphere(subdivisions=1))
    step = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, rays=31))
    value, gradient = step(jnp.asarray(vertices, "float32"))
    assert np.isnan(value) and np.abs(gradient).max() == 0


def test_an_import_alone_leaves_quietly():
    code = "import os; os.environ['JAX_PLATFORMS'] = 'nowhere'; import spt_jax; print('end')"
    done = run("-c", code, timeout=100)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "end", "")


def test_a_single_core_gives_the_same_result(monkeypatch):
    vertices, faces = join(sphere(), sphere(center=(1.1, 0.2, 0.1)))
    batch = jnp.stack([jnp.asarray(vertices * s, "float32") for s in (1.0, 1.1, 1.2)])
    step = jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, rays=64).sum())
    monkeypatch.setattr(config, "processes", "auto")
    shared = jax.block_until_ready(step(batch))
    monkeypatch.setattr(process_pool, "usable_cores", lambda: 1)
    callback.clear_results()
    alone = jax.block_until_ready(step(batch))
    assert shared[0] == alone[0]
    np.testing.assert_array_equal(shared[1], alone[1])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child_gets_threads_of_its_own():
    on_host.executor().submit(abs, -1).result()
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python warn of forks in threaded processes
        child = os.fork()
    if child == 0:
        os.write(writer, str(on_host.executor().submit(abs, -7).result(timeout=60)).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(reader, 10) == b"7"
