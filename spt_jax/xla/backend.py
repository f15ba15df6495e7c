"""The penalty and the labels on the device, for batches of any shape, one mesh after the other."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer

from spt_jax.bridge.batches import as_more_meshes, over_batch
from spt_jax.overlap.exclusions import NOTHING, Exclusions
from spt_jax.overlap.measure import LEAST_EXTENT, Gradient, Rule, Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.xla.gradient import as_labels, vertex_gradient
from spt_jax.xla.measure import Wants, cast_beams, nothing_found
from spt_jax.xla.patches import spread
from spt_jax.xla.settings import Xla, meshes_at_once
from spt_jax.xla.strips import Usage, no_usage
from spt_jax.xla.tables import Tables, tables_of
from spt_jax.xla.winding import vertex_labels


class Program(NamedTuple):
    """What of a task decides what is compiled.

    Attributes:
        settings: of the arrays.
        rays: how many.
        value, gradient, rule: the options of the penalty; without a gradient it is zero.
    """

    settings: Xla
    rays: Rays
    value: str = "volume"
    gradient: Gradient | None = None
    rule: Rule = "vertex"


class Task(NamedTuple):
    """What to find: the program, and the values that it is given."""

    program: Program
    tables: Tables


def as_task(
    program: Program, sampling: Sampling, dtype: np.dtype, exclusions: Exclusions = NOTHING
) -> Task:
    """The task for vertices of one precision."""
    return Task(program, tables_of(sampling, exclusions, dtype))


def penalty_on_device(
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
    task: Task,
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch V 3"]]:
    """Value and gradient of every mesh.

    NaN and zero where a vertex is not finite, a face out of range or a row of the screen did not
    fit into the arrays.
    """
    return over_batch(_mapped(_penalty_of_one, task.program), vertices, faces, task.tables)


def labels_on_device(
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
    task: Task,
) -> Int[Array, "*batch V"]:
    """The labels of every mesh's vertices; 0 where the mesh cannot be measured."""
    return over_batch(_mapped(_labels_of_one, task.program), vertices, faces, task.tables)


def usage_on_device(
    vertices: Float[Array, "*batch V 3"],
    faces: Integer[Array, "F 3"],
    task: Task,
) -> Usage:
    """What the arrays were needed for, mesh by mesh."""
    return over_batch(_mapped(_usage_of_one, task.program), vertices, faces, task.tables)


def _penalty_of_one(vertices, faces, task: Task):
    value, gradient = task.program.value, task.program.gradient
    nothing = jnp.zeros((), vertices.dtype), jnp.zeros_like(vertices)
    usable, clean, faces = _cleaned(vertices, faces)
    if len(faces) == 0:
        return jnp.where(usable, nothing[0], jnp.nan), nothing[1]
    by_class = value == "ratio" or gradient not in (None, "boundary")
    wants = Wants(value == "volume", gradient == "boundary", by_class and _rays_decide_labels(task))
    found, fits = _cast(clean, faces, task, wants)
    usable, result, slope = usable & fits, found.volume, found.gradient
    if by_class:
        label = _labels(clean, faces, task, found.codes)
        if value == "ratio":
            result = jnp.mean((label != 0).astype(vertices.dtype))
        if gradient not in (None, "boundary"):
            slope = vertex_gradient(clean, faces, label, unit=gradient == "unit")
    usable &= jnp.isfinite(result) & jnp.isfinite(slope).all()
    if value == "volume":
        # What underflows has no slope either.
        slope = jnp.where(result >= jnp.finfo(result.dtype).tiny, slope, nothing[1])
    return jnp.where(usable, result, jnp.nan), jnp.where(usable, slope, nothing[1])


def _labels_of_one(vertices, faces, task: Task):
    usable, clean, faces = _cleaned(vertices, faces)
    if len(faces) == 0:
        return jnp.zeros(len(vertices), jnp.int32)
    found, fits = _cast(clean, faces, task, Wants(labels=_rays_decide_labels(task)))
    label = _labels(clean, faces, task, found.codes)
    return jnp.where(usable & fits, label, 0)


def _usage_of_one(vertices, faces, task: Task):
    _, clean, faces = _cleaned(vertices, faces)
    if len(faces) == 0:
        return no_usage()
    return _cast_all(
        clean, faces, task._replace(tables=task.tables._replace(exclusions=None)), Wants()
    )[1]


def _rays_decide_labels(task: Task) -> bool:
    return task.program.rule == "triangle" or task.tables.exclusions is not None


def _cast(clean, faces, task: Task, wants: Wants):
    if not any(wants):
        return nothing_found(clean), True
    found, _, fits = _cast_all(clean, faces, task, wants)
    return found, fits


def _cast_all(clean, faces, task: Task, wants: Wants):
    program, tables = task
    return cast_beams(
        clean, faces, program.rays, tables.aims, program.settings, wants, tables.exclusions
    )


def _labels(clean, faces, task: Task, codes: Int[Array, "V"]):
    if task.program.rule == "triangle":
        return as_labels(codes)
    label = vertex_labels(clean, faces, jnp.asarray(task.tables.frames))
    if task.tables.exclusions is None:
        return label
    # A connected patch is included whole or not at all.
    return jnp.where(spread(codes > 0, label != 0, faces), label, 0)


def _cleaned(vertices, faces):
    """Whether the mesh can be measured, and one that surely can, the same where that holds."""
    if jnp.dtype(faces.dtype).itemsize < 4:
        faces = faces.astype(jnp.int32)
    usable = jnp.isfinite(vertices).all() & ((faces >= 0) & (faces < len(vertices))).all()
    if faces.size:
        # As `overlap.measure.usable`: rounding has eaten the shape.
        extent = (vertices.max(axis=0) - vertices.min(axis=0)).max()
        eaten = LEAST_EXTENT * float(jnp.finfo(vertices.dtype).eps) * jnp.abs(vertices).max()
        usable &= ~((extent > 0) & (extent < eaten))
    faces = jnp.clip(faces, 0, max(len(vertices) - 1, 0)).astype(jnp.int32)
    return usable, jnp.where(usable, vertices, jnp.zeros_like(vertices)), faces


def _mapped(function: Callable, program: Program):
    """The function for a list of meshes, one after the other, also under `vmap`."""

    @as_more_meshes
    def mapped(vertices, faces, tables):
        def one(mesh):
            own = mesh if len(faces) > 1 else (*mesh, faces[0])
            return function(*own, Task(program, tables))

        meshes = (vertices, faces) if len(faces) > 1 else (vertices,)
        if len(vertices) == 1:
            return jax.tree.map(lambda x: x[None], one([x[0] for x in meshes]))
        at_once = meshes_at_once(program.settings, program.rays, vertices, faces)
        if at_once == 1:
            return jax.lax.map(one, meshes)
        return jax.lax.map(one, meshes, batch_size=at_once)

    return mapped
