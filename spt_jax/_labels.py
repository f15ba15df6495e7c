"""Which vertices lie in self-intersection: the paper's V_0, V_out and V_in (Algorithm 1)."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int8, Integer

from spt_jax._exclusions import as_exclusions
from spt_jax._query import (
    as_backend,
    as_choice,
    as_directions,
    as_faces,
    as_rays,
    as_vertices,
)
from spt_jax._result import Result, plain
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.bridge.callback import call_on_host
from spt_jax.overlap.host_functions import LabelOptions, labels_on_host
from spt_jax.overlap.labels import CLEAR, INVERTED, PENETRATING
from spt_jax.overlap.measure import Rule, Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface
from spt_jax.xla.backend import Program, Task, as_task, labels_on_device
from spt_jax.xla.settings import Xla


class VertexLabels(Result):
    """Whether each vertex penetrates another part, is inverted, or is clear.

    Attributes:
        labels: +1 where a vertex is `penetrating`, that is inside another part of the surface (the
            paper's V_out); -1 where the surface there is `inverted`, that is inside out (V_in); 0
            where it is `clear` of self-intersection (V_0).

    Example:
        >>> import trimesh
        >>> from spt_jax import classify_vertices
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.3, 0.2]))
        >>> found = classify_vertices(pair.vertices, pair.faces)
        >>> int(found.penetrating.sum()), int(found.inverted.sum()), f"{found.ratio:.3f}"
        (2, 0, '0.125')
    """

    labels: Int8[Array, "*batch V"]

    @property
    def penetrating(self) -> Bool[Array, "*batch V"]:
        """Vertices inside another part of the surface (V_out)."""
        return self.labels == PENETRATING

    @property
    def inverted(self) -> Bool[Array, "*batch V"]:
        """Vertices where the surface is inside out (V_in)."""
        return self.labels == INVERTED

    @property
    def clear(self) -> Bool[Array, "*batch V"]:
        """Vertices in no self-intersection (V_0)."""
        return self.labels == CLEAR

    @property
    def ratio(self) -> Float[Array, "*batch"]:
        """The fraction of the vertices in self-intersection (paper, Eq. 11)."""
        return jnp.mean(jnp.where(self.clear, 0.0, 1.0), axis=-1)

    def as_dict(self) -> dict[str, Any]:
        """The number of vertices with each label, and the ratio, as JSON types."""
        return {
            "num_penetrating": plain(self.penetrating.sum(axis=-1)),
            "num_inverted": plain(self.inverted.sum(axis=-1)),
            "num_clear": plain(self.clear.sum(axis=-1)),
            "ratio": plain(self.ratio),
        }


def classify_vertices(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    *,
    rays: Rays = None,
    directions: Any = 3,
    rule: Rule = "vertex",
    face_groups: Integer[Array, "F"] | np.ndarray | None = None,
    ignore_groups: Any = (),
    rest_surface: RestSurface | None = None,
    backend: str | Xla = "auto",
) -> VertexLabels:
    """Label each vertex as penetrating, inverted or clear (paper, section 3.2).

    The label is the sign of the winding number w_out just outside the surface at the vertex: zero
    on clear vertices (the paper's V_0), positive on penetrating ones (V_out), negative on inverted
    ones (V_in). This holds at any depth of overlap, whereas the counters of the paper's Algorithm 1
    stop at two.

    The vertex rule computes w_out at the vertex itself, exactly, by propagating it along the
    surface from one point of each connected part. Surfaces that touch do not overlap: a vertex
    that lies on another part of the surface, up to rounding, takes the winding number nearest to
    zero. A vertex whose own triangles intersect each other takes the number found on most of its
    edges.

    The triangle rule is the paper's Algorithm 1: each crossing of a ray on a lattice passes its
    label to the three corners of its triangle. Where the triangles around a vertex disagree,
    penetrating takes precedence over inverted, and both over clear. The rule labels whole triangles
    along an intersection contour and misses what lies between the rays: a vertex that no ray
    reaches is clear.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        rays: for the triangle rule: None casts no rays and takes every triangle that lies in an
            overlap anywhere; or the number of rays along the longer side of the screen; or
            (rows, columns). The vertex rule does not use it.
        directions: 1, 3 or the rows of a D x 3 array: for the triangle rule, which takes a label
            seen along any of them.
        rule: "vertex" or "triangle", as above.
        face_groups, ignore_groups, rest_surface: excluded overlaps, as in
            `self_intersection_penalty`; their vertices are clear. Those of an overlap that counts
            in part are not.
        backend: as in `self_intersection_penalty`.

    Returns:
        The labels. Beside an open sheet, where the penalty is NaN, solids are labelled as without
        it, and the sheet's vertices are penetrating where they lie in a solid. Where the penalty is
        NaN otherwise every vertex is clear.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`.

    Differentiation: none; the labels are constants.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax import classify_vertices
        >>> box = trimesh.creation.box()
        >>> inner = box.copy().apply_scale(0.5)
        >>> both = trimesh.util.concatenate(box, inner)
        >>> found = classify_vertices(jnp.asarray(both.vertices, "float32"), both.faces)
        >>> print(found.labels)
        [0 0 0 0 0 0 0 0 1 1 1 1 1 1 1 1]
        >>> print(found.ratio)
        0.5
    """
    vertices = as_vertices(vertices)
    faces = as_faces(faces, vertices.shape[-2])
    sampling = Sampling(as_rays(rays), as_directions(directions))
    exclusions = as_exclusions(face_groups, ignore_groups, rest_surface, faces)
    rule = as_choice("rule", rule, Rule)
    device = as_backend(backend)
    if device is not None:
        program = Program(device, sampling.rays, rule=rule)
        task = as_task(program, sampling, vertices.dtype, exclusions)
        return VertexLabels(_on_device(program, vertices, jnp.asarray(faces), task.tables))
    rounding = float(np.finfo(vertices.dtype).eps)
    options = LabelOptions(rule, sampling, exclusions, rounding)
    results = ((vertices.shape[-2:-1], "int8"),)
    (label,) = call_on_host(labels_on_host, options, results, vertices, faces)
    return VertexLabels(label)


def _labels_of(program, vertices, faces, tables):
    return labels_on_device(vertices, faces, Task(program, tables)).astype(jnp.int8)


_on_device = BoundedJit(_labels_of)
