"""`jax.jit` with a bounded cache: programs of shapes that are no longer used are released."""

import functools
import threading
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

# How many different calls are compiled before all are dropped. A program takes 1 to 5 MB.
_MOST = 64


class BoundedJit:
    """A jitted function that drops its programs after so many different calls.

    JAX keeps 4,096 programs of a function, or for ever what other caches refer to: some
    gigabytes where every call brings another shape.

    Args:
        function: its first argument is static, all others are arrays.
        most: kinds of calls that are kept; calls of one kind differ in values alone.
    """

    def __init__(self, function: Callable[..., Any], most: int = _MOST):
        self._function, self._most = function, most
        self._lock = threading.Lock()
        self._reset()

    def __call__(self, static: Any, *arrays: Any) -> Any:
        """The function of its arguments."""
        leaves, structure = jax.tree.flatten(arrays)
        # Under the trace of a program nothing is compiled here; under `jax.grad` alone it is.
        if not isinstance(jnp.zeros(()), Tracer):
            kind = static, structure, *((leaf.shape, leaf.dtype) for leaf in leaves)
            with self._lock:
                if kind not in self._seen and len(self._seen) >= self._most:
                    self._reset()
                self._seen.add(kind)
        return self._jitted(static, *arrays)

    def __len__(self) -> int:
        return len(self._seen)

    def clear(self) -> None:
        """Drop all programs."""
        with self._lock:
            self._reset()

    def _reset(self) -> None:
        function = self._function

        @functools.wraps(function)
        def anew(static: Any, *arrays: Any) -> Any:
            return function(static, *arrays)

        # A new function: JAX's caches, also those of functions derived from it, are freed with it.
        self._seen: set[Any] = set()
        self._jitted: Any = jax.jit(anew, static_argnums=0)
