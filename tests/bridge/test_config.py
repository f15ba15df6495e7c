"""`spt_jax.config`: no process unless it is told, and how much of the results is kept."""

import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import join, sphere

from spt_jax import config, self_intersection_penalty
from spt_jax._settings import Config
from spt_jax.bridge import process_pool
from spt_jax.bridge.result_cache import ResultCache
from spt_jax.overlap.host_functions import value_on_host

MESH = join(sphere(), sphere(center=(1.1, 0.2, 0.1)))


@pytest.mark.skipif(not process_pool.can_start(), reason="no workers on this system")
def test_a_loss_starts_no_processes_unless_told(monkeypatch):
    monkeypatch.setattr(process_pool, "usable_cores", lambda: 4)
    monkeypatch.setattr(process_pool, "_WORTH_STARTING", 0.0)
    monkeypatch.setattr(process_pool, "_WORTH_SHARING", 0)
    pool = process_pool.Workers()
    work = process_pool.packed(value_on_host, None)
    assert config.processes == 0 and pool._ready(work, 3) == [] and pool._number == 0
    try:
        monkeypatch.setattr(config, "processes", 2)
        pool._ready(work, 3)
        assert pool._number == 2  # however many cores there are
        monkeypatch.setattr(config, "processes", 0)
        assert pool._ready(work, 3) == []  # those that were started are no longer asked
    finally:
        pool.close()


def test_the_numbers_of_processes():
    config = Config()
    assert config.most_processes(2) == config.most_processes(64) == 0
    config.processes = "auto"
    assert [config.most_processes(cores) for cores in (1, 2, 64)] == [0, 1, 7]
    config.processes = 3
    assert config.most_processes(1) == 3


@pytest.mark.parametrize("wrong", [-1, 2.0, True, "all", None])
def test_wrong_settings_are_refused_and_change_nothing(wrong, untyped):
    config = Config()
    with pytest.raises(ValueError, match=r"processes must be .auto. or a whole number"):
        config.processes = wrong
    with pytest.raises(ValueError, match="result_cache_bytes must be a whole number"):
        config.result_cache_bytes = wrong
    assert (config.processes, config.result_cache_bytes) == (0, 64 << 20)


def test_results_are_kept_as_far_as_the_setting_goes(monkeypatch):
    cache, calls = ResultCache(), []

    def measured(meshes):
        calls.append(len(meshes))
        return [(np.zeros(3),) for _ in meshes]

    faces = cache.faces(MESH[1])
    for most, expected in ((64 << 20, [1]), (0, [1, 1, 1])):
        monkeypatch.setattr(config, "result_cache_bytes", most)
        cache.clear()
        calls.clear()
        for _ in range(3):
            cache.results("question", [(MESH[0], faces)], measured)
        assert calls == expected


def test_the_environment_sets_it():
    code = "import spt_jax; print(spt_jax.config)"
    given = {"SPT_JAX_PROCESSES": "auto", "SPT_JAX_RESULT_CACHE_BYTES": "1000"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | given)
    assert done.stdout.strip() == "Config(processes='auto', result_cache_bytes=1000)", done.stderr
    given["SPT_JAX_PROCESSES"] = "many"
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | given)
    assert "SPT_JAX_PROCESSES must be a whole number: got 'many'" in done.stderr


def test_what_is_measured_does_not_depend_on_it(monkeypatch):
    vertices, faces = jnp.asarray(MESH[0], "float32"), MESH[1]
    batch = jnp.stack([vertices, 1.1 * vertices])
    found = []
    for cache in (64 << 20, 0):
        monkeypatch.setattr(config, "result_cache_bytes", cache)
        found.append(np.asarray(self_intersection_penalty(batch, faces)))
    np.testing.assert_array_equal(*found)
