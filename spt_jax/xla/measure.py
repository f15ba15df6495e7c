"""One mesh measured on the device: volume, gradient, the triangle rule's labels, folds."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.rays.beam import Rays
from spt_jax.xla.beam import Aims
from spt_jax.xla.exclusions import ExclusionTables, find_contour_faces, included_intervals
from spt_jax.xla.gradient import add_codes, boundary_gradient
from spt_jax.xla.levels import Intervals, kept_only
from spt_jax.xla.settings import Xla
from spt_jax.xla.strips import Ray, Usage, over_strips


class Wants(NamedTuple):
    """What to find by the rays; the rest costs nothing."""

    volume: bool = False
    gradient: bool = False
    labels: bool = False


class Found(NamedTuple):
    """What the rays found.

    Attributes:
        volume: E, the integral of w (w - 1) / 2; the mean over directions.
        gradient: the boundary integral of w_out (v . n).
        codes: the triangle rule's labels, as `gradient.add_codes` collects them.
    """

    volume: Float[Array, ""]
    gradient: Float[Array, "V 3"]
    codes: Int[Array, "V"]


def nothing_found(vertices: Float[Array, "V 3"]) -> Found:
    """Before any ray is cast."""
    return Found(
        volume=jnp.zeros((), vertices.dtype),
        gradient=jnp.zeros_like(vertices),
        codes=jnp.zeros(len(vertices), jnp.int32),
    )


def cast_beams(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    rays: Rays,
    aimed: Aims,
    settings: Xla,
    wants: Wants,
    exclusions: ExclusionTables | None = None,
) -> tuple[Found, Usage, Bool[Array, ""]]:
    """Every beam of the sampling through one mesh; twice where something is excluded.

    Args:
        vertices, faces: finite, and in range.
        rays: how many.
        aimed: their directions.
        settings: sizes of the buffers.
        wants: what to find.
        exclusions: which overlaps are excluded; None: none are.

    Returns:
        What was found, what it took, and whether all of it was measured: where it was not, nothing
        of it can be used.
    """
    counted = None
    if exclusions is not None:
        contour_faces = find_contour_faces(exclusions, vertices, faces)
        overlapped = _overlapped(vertices, faces, rays, aimed, settings)
        included = contour_faces.included(faces, overlapped)
        counted = functools.partial(
            included_intervals,
            exclusions,
            faces=faces,
            contour_faces=contour_faces,
            included=included,
        )

    def add(found: Found, intervals: Intervals, ray: Ray) -> Found:
        if counted is not None:
            intervals = kept_only(intervals, counted(intervals))
        if wants.volume:
            found = found._replace(volume=found.volume + intervals.size * ray.area)
        if wants.gradient:
            share = boundary_gradient(vertices, faces, intervals, ray)
            found = found._replace(gradient=found.gradient + share)
        if wants.labels:
            found = found._replace(codes=add_codes(found.codes, faces, intervals))
        return found

    start = nothing_found(vertices)
    found, usage, usable = over_strips(vertices, faces, rays, aimed, settings, add, start)
    return found._replace(volume=found.volume / len(aimed.direction)), usage, usable


def _overlapped(vertices, faces, rays, aimed, settings) -> Bool[Array, "V"]:
    """The corners of all triangles at which rays see an overlap."""

    def add(codes, intervals: Intervals, ray: Ray):
        return add_codes(codes, faces, intervals)

    start = jnp.zeros(len(vertices), jnp.int32)
    return over_strips(vertices, faces, rays, aimed, settings, add, start)[0] > 0
