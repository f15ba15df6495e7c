"""What is checked of arrays whose values are known; without JAX, which workers do not import."""

import sys
from typing import Any

import numpy as np


def is_traced(value: Any) -> bool:
    """Whether JAX is tracing this value. Where JAX has not been imported, nothing is traced."""
    core = sys.modules.get("jax.core")
    return core is not None and isinstance(value, core.Tracer)


def check_indices(faces: np.ndarray, num_vertices: int) -> None:
    """Raise ValueError unless every index names a vertex."""
    if faces.size == 0:
        return
    lowest, highest = int(faces.min()), int(faces.max())
    if lowest < 0 or highest >= num_vertices:
        raise ValueError(
            f"faces must index into vertices: got index {lowest if lowest < 0 else highest} for "
            f"{num_vertices} vertices; indices are 0-based."
        )
