"""Strictness for the whole suite: types checked, promotions explicit, both precisions run."""

import gc
import os
import shutil
import subprocess
import sys
import tempfile

import jax
import numpy as np
import pytest
from hypothesis import settings
from jaxtyping import config, install_import_hook

# The same examples on every machine, no database of them in the tree, and no deadline: how long one
# takes depends on what else the machine does.
settings.register_profile("suite", derandomize=True, database=None, deadline=None)
settings.load_profile("suite")

# Most of the suite's time is compiling, of programs that then run for milliseconds. With these
# flags `test_fit_pose.py` took half of a core's time; neither changes what a program means. Level 0
# is no faster in all, and two programs of one search round differently there. The flags are read
# when JAX first compiles, and handed down to workers and to programs that tests start. A jaxlib
# that does not know one ends the process: so another process is asked.
_QUICK = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false"
# jaxlib 0.10.2 crashes (SIGSEGV in slinky::internal::can_fuse, called by ynn_invoke_runtime) where
# a fit runs under vmap on a processor without AVX-512: its library of fused kernels is left out.
_QUICK += " --xla_cpu_experimental_ynn_fusion_type="
if "XLA_FLAGS" not in os.environ:
    flags = os.environ | {"XLA_FLAGS": _QUICK}
    asked = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"], env=flags, capture_output=True
    )
    os.environ["XLA_FLAGS"] = _QUICK if asked.returncode == 0 else ""

# Compiled programs are many objects that live to the end: looking through all of them for garbage
# took 4 % of a worker's time. The tests of what is given back collect it themselves.
gc.set_threshold(700, 10, 60)

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

with install_import_hook("spt_jax", "beartype.beartype"):
    import spt_jax

    for name in dir(spt_jax):  # those too that are imported when they are asked for
        getattr(spt_jax, name)


_COMPILED = "SPT_JAX_TESTS_COMPILED"


def pytest_configure(config):
    """One folder of compiled programs for all workers: most of the suite's time is compiling."""
    if not hasattr(config, "workerinput"):
        os.environ[_COMPILED] = tempfile.mkdtemp(prefix="spt-jax-tests-")
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", os.environ[_COMPILED])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ.pop(_COMPILED), ignore_errors=True)


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Run a test once in each precision; the test builds its arrays with the value given."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", request.param == "float64")
    yield np.dtype(request.param)
    jax.config.update("jax_enable_x64", before)


@pytest.fixture
def x64():
    """Run a test in double precision."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture
def rng():
    """One seeded generator a test."""
    return np.random.default_rng(0)


@pytest.fixture
def untyped():
    """Run as users do, without the suite's own type checks, so that our errors show."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)
