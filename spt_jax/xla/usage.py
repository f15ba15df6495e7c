"""Whether the arrays of the device path are large enough for a mesh."""

from typing import Any

import numpy as np
from jaxtyping import Array, Float, Integer

from spt_jax._query import as_directions, as_mesh, as_rays
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.overlap.measure import Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.xla.backend import Program, Task, as_task, usage_on_device
from spt_jax.xla.settings import BufferSizes, Xla, buffer_sizes
from spt_jax.xla.strips import Usage


def device_usage(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    *,
    rays: Rays = None,
    directions: Any = 3,
    settings: Xla | None = None,
) -> tuple[Usage, BufferSizes]:
    """What `backend="xla"` needs of its arrays for these meshes, and what it has.

    Args:
        vertices, faces, rays, directions: as in `self_intersection_penalty`.
        settings: as passed for its `backend`; None: as for "xla".

    Returns:
        What each mesh needs, and the buffer sizes. Where the fullest row of the screen needs more
        `segments`, `crossings` or `sorted` than there are, the penalty is NaN.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax.xla.settings import Xla
        >>> from spt_jax.xla.usage import device_usage
        >>> box = trimesh.creation.box()
        >>> few = Xla(crossings=100)
        >>> need, have = device_usage(jnp.asarray(box.vertices, "float32"), box.faces,
        ...                           rays=64, settings=few)
        >>> print(have.crossings, int(need.crossings) > 100)
        100 True
    """
    vertices, faces = as_mesh(vertices, faces)
    program = Program(settings or Xla(), as_rays(rays))
    task = as_task(program, Sampling(program.rays, as_directions(directions)), vertices.dtype)
    return _usage(program, vertices, faces, task.tables), buffer_sizes(
        program.settings, program.rays
    )


def _usage_of(program, vertices, faces, tables):
    return usage_on_device(vertices, faces, Task(program, tables))


_usage = BoundedJit(_usage_of)
