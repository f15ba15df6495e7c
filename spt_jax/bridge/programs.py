"""How the programs of fits and of untangling are compiled."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

_P = ParamSpec("_P")
_R = TypeVar("_R")

# On a CPU, XLA brings each fused loop to LLVM by way of MLIR. A fit has hundreds of them, all
# small: without that it compiles in 0.6 of the time and runs as fast; so does a descent.
_SOONER: dict[str, Any] = {"compiler_options": {"xla_cpu_use_fusion_emitters": False}}


def program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """`equinox.filter_jit`, compiled sooner on a CPU; inside other transformations, just that."""
    usual = eqx.filter_jit(function)
    sooner = eqx.filter_jit(function, **_SOONER)

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        # Only the outermost jit may have options. What is made under another one is traced.
        given = jax.tree.leaves((args, kwargs))
        outermost = not any(isinstance(leaf, Tracer) for leaf in (jnp.zeros(()), *given))
        if outermost and jax.default_backend() == "cpu" and _is_known():
            return sooner(*args, **kwargs)
        return usual(*args, **kwargs)

    return call


@cache
def _is_known() -> bool:
    """Whether this jaxlib has the option, which XLA does not promise to keep."""
    try:
        jax.jit(lambda: 0, **_SOONER)()
    except jax.errors.JaxRuntimeError:
        return False
    return True
