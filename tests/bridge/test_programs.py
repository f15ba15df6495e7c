"""Programs that are compiled with options: only where they may be, and only options that exist."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spt_jax.bridge import programs
from spt_jax.bridge.programs import program


@pytest.fixture
def options(monkeypatch):
    """The options that each program was compiled with, in order."""
    seen, jit = [], programs.eqx.filter_jit

    def noted(function, **given):
        compiled = jit(function, **given)

        def call(*args):
            seen.append(given)
            return compiled(*args)

        return call

    monkeypatch.setattr(programs.eqx, "filter_jit", noted)
    return seen


def test_options_are_for_the_outermost_jit_alone(options):
    double = program(lambda x: 2 * x)
    given = {"compiler_options": {"xla_cpu_use_fusion_emitters": False}}
    on_cpu = given if jax.default_backend() == "cpu" else {}
    assert double(3.0) == 6
    assert jax.jit(double)(3.0) == 6
    assert jax.jit(lambda: double(3.0))() == 6  # nothing that it is called with is traced
    np.testing.assert_array_equal(jax.vmap(double)(jnp.arange(3.0)), [0, 2, 4])
    assert jax.grad(double)(1.0) == 2
    assert options == [on_cpu, {}, {}, {}, {}]


def test_an_option_that_jaxlib_does_not_know_is_left_out(options, monkeypatch):
    unknown = {"compiler_options": {"xla_cpu_no_such_option": True}}
    monkeypatch.setattr(programs, "_SOONER", unknown)
    programs._is_known.cache_clear()
    try:
        assert program(lambda x: 2 * x)(3.0) == 6
    finally:
        programs._is_known.cache_clear()
    assert options == [{}]
