"""Which vertices lie in self-intersection: V_0, V_out and V_in of the paper's Algorithm 1."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int8, Integer

from spt_jax.arguments import (
    as_backend,
    as_choice,
    as_directions,
    as_faces,
    as_rays,
    as_vertices,
)
from spt_jax.bounded_jit import BoundedJit
from spt_jax.device.backend import Program, Task, as_task, labels_on_device
from spt_jax.device.settings import Xla
from spt_jax.exclusions import as_exclusions
from spt_jax.host import call_on_host
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.labels import CLEAR, INSIDE, OUT
from spt_jax.overlap.measure import Rule, Sampling, Unmeasurable, measure
from spt_jax.rest_surface import RestSurface


class VertexClasses(eqx.Module):
    """The class of every vertex, and what follows from it.

    Attributes:
        label: 0 on V_0 (not in self-intersection), +1 on V_out (within another part of the
            surface), -1 on V_in (where the surface is inside out).

    Example:
        >>> import trimesh
        >>> from spt_jax import classify_vertices
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.3, 0.2]))
        >>> classes = classify_vertices(pair.vertices, pair.faces)
        >>> int(classes.out.sum()), int(classes.inside.sum()), f"{classes.ratio:.3f}"
        (2, 0, '0.125')
    """

    label: Int8[Array, "*batch V"]

    @property
    def out(self) -> Bool[Array, "*batch V"]:
        """The vertices of V_out."""
        return self.label == OUT

    @property
    def inside(self) -> Bool[Array, "*batch V"]:
        """The vertices of V_in."""
        return self.label == INSIDE

    @property
    def clear(self) -> Bool[Array, "*batch V"]:
        """The vertices of V_0."""
        return self.label == CLEAR

    @property
    def ratio(self) -> Float[Array, "*batch"]:
        """The part of the vertices in self-intersection (paper, Eq. 11)."""
        return jnp.mean(jnp.where(self.clear, 0.0, 1.0), axis=-1)


def classify_vertices(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    *,
    rays: int | tuple[int, int] | str = "auto",
    directions: Any = 3,
    rule: Rule = "vertex",
    face_groups: Integer[Array, "F"] | np.ndarray | None = None,
    ignore_groups: Any = (),
    folds: RestSurface | None = None,
    backend: str | Xla = "auto",
) -> VertexClasses:
    """Sort the vertices into V_0, V_out and V_in (paper, section 3.2).

    A vertex's class is the sign of the winding number w_out just outside the surface there: 0 on
    V_0, more on V_out, less on V_in, for any depth of overlap, where the counters of the paper's
    Algorithm 1 stop at two.

    The vertex rule finds w_out at the vertex itself, exactly, by following it along the surface
    from one place of each connected part. Sheets that touch do not overlap: on another sheet, but
    for rounding, a vertex takes the number nearest to 0. At a vertex whose own triangles pass
    through one another it is the number on most of its edges.

    The triangle rule is Algorithm 1's: rays on a lattice give the class of each crossing to the
    three corners of its triangle; where triangles around a vertex disagree, V_out goes before
    V_in and both go before V_0. It takes whole triangles at the rim of an overlap, and misses what
    is between the rays: a vertex that no ray reaches is V_0.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        rays: for the triangle rule: "auto", no rays at all, every triangle that lies in an overlap
            anywhere; rays along the longer side of the screen; or (rows, columns). The vertex rule
            does not use it.
        directions: 1, 3 or the rows of a D x 3 array: for the triangle rule, by which a class seen
            from any of them counts.
        rule: "vertex" or "triangle", as above.
        face_groups, ignore_groups, folds: overlaps that do not count, as in
            `self_intersection_penalty`; their vertices are V_0. Those of an overlap that counts in
            part are not.
        backend: as in `self_intersection_penalty`.

    Returns:
        The classes; all V_0 where the penalty is NaN.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`.

    Differentiation: none; the labels are constants.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax import classify_vertices
        >>> box = trimesh.creation.box()
        >>> inner = box.copy().apply_scale(0.5)
        >>> both = trimesh.util.concatenate(box, inner)
        >>> classes = classify_vertices(jnp.asarray(both.vertices, "float32"), both.faces)
        >>> print(classes.label)
        [0 0 0 0 0 0 0 0 1 1 1 1 1 1 1 1]
        >>> print(classes.ratio)
        0.5
    """
    vertices = as_vertices(vertices)
    faces = as_faces(faces, vertices.shape[-2])
    sampling = Sampling(as_rays(rays), as_directions(directions))
    exclusions = as_exclusions(face_groups, ignore_groups, folds, faces)
    rule = as_choice("rule", rule, Rule)
    device = as_backend(backend)
    if device is not None:
        program = Program(device, sampling.rays, rule=rule)
        task = as_task(program, sampling, vertices.dtype, exclusions)
        return VertexClasses(_on_device(program, vertices, jnp.asarray(faces), task.tables))
    rounding = float(np.finfo(vertices.dtype).eps)
    options = _Options(rule, sampling, exclusions, rounding)
    results = ((vertices.shape[-2:-1], "int8"),)
    (label,) = call_on_host(_labels_on_host, options, results, vertices, faces)
    return VertexClasses(label)


class _Options(NamedTuple):
    rule: Rule
    sampling: Sampling
    exclusions: Exclusions
    rounding: float  # machine epsilon of the vertices


def _labels_of(program, vertices, faces, tables):
    return labels_on_device(vertices, faces, Task(program, tables)).astype(jnp.int8)


_on_device = BoundedJit(_labels_of)


def _labels_on_host(vertices, faces, options: _Options):
    try:
        found = measure(vertices, faces, options.sampling, options.exclusions, options.rounding)
        return (found.labels(options.rule),)
    except Unmeasurable:
        return (np.zeros(len(vertices), np.int8),)
