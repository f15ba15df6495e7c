"""Sizes of the buffers of the path in JAX alone."""

from typing import Any, NamedTuple

import jax

from spt_jax.overlap.rays.beam import Rays
from spt_jax.xla.beam import most_pixels

# What `rays=None` means here.
DEFAULT_RAYS = 512

# Of memory, for meshes of a batch that are worked on together on an accelerator.
_MOST_BYTES = 1 << 30

# Below these, arrays cost nothing.
_FEWEST_CROSSINGS, _FEWEST_SORTED = 1 << 14, 1 << 13


class Xla(NamedTuple):
    """Settings of `backend="xla"`, which stands for `Xla()`.

    The screen is processed in strips of rows that fit; a strip that would need larger buffers is
    made lower, so these numbers decide speed and memory and not the result. Only a single row that
    does not fit makes the value NaN (`device_usage` reports it).

    Attributes:
        segments: rows of triangles in a strip; None: half as many as crossings.
        crossings: of rays and triangles in a strip; None: one for each of n x n rays.
        sorted: crossings of a strip on rays that may meet an overlap; None: a quarter of those.
        meshes_at_once: of a batch; each needs the memory of one. None: 1 on a CPU and as many as
            1 GB holds elsewhere.
    """

    segments: int | None = None
    crossings: int | None = None
    sorted: int | None = None
    meshes_at_once: int | None = None


class BufferSizes(NamedTuple):
    """Sizes of the arrays of one mesh and direction."""

    rows: int
    columns: int
    segments: int
    crossings: int
    sorted: int


def resolve_rays(rays: Rays) -> int | tuple[int, int]:
    """The number of rays, with None replaced by the default."""
    return DEFAULT_RAYS if rays is None else rays


def bytes_needed(space: BufferSizes, num_vertices: int, num_faces: int, itemsize: int) -> int:
    """An upper bound of the memory that one mesh takes: half as much again as XLA's own figure.

    With R x C pixels, S segments, N crossings, M of them sorted, and w bytes a number:
    24 R C + (48 + 26 w) S + (36 + 3 w) N + (56 + 40 w) M + (24 + 34 w) F + (8 + 24 w) V.
    """
    w = itemsize
    return (
        24 * space.rows * space.columns
        + (48 + 26 * w) * space.segments
        + (36 + 3 * w) * space.crossings
        + (56 + 40 * w) * space.sorted
        + (24 + 34 * w) * num_faces
        + (8 + 24 * w) * num_vertices
    )


def meshes_at_once(settings: Xla, rays: Rays, vertices: Any, faces: Any) -> int:
    """How many meshes of a batch to work on together."""
    if settings.meshes_at_once is not None:
        return settings.meshes_at_once
    if jax.default_backend() == "cpu":
        return 1  # a core has enough to do with one
    space = buffer_sizes(settings, rays)
    each = bytes_needed(space, vertices.shape[1], faces.shape[1], vertices.dtype.itemsize)
    return max(1, min(len(vertices), _MOST_BYTES // each))


def buffer_sizes(settings: Xla, rays: Rays) -> BufferSizes:
    """The sizes, from static numbers alone.

    Raises:
        ValueError: a size that is not positive, or that counters of 32 bits cannot hold.
    """
    for name, value in settings._asdict().items():
        if value is not None and (not isinstance(value, int) or value < 1):
            raise ValueError(
                f"{name} must be a positive whole number or None: got {value!r} in {settings}."
            )
    rays = resolve_rays(rays)
    rows, columns = most_pixels(rays)
    height, width = rays if isinstance(rays, tuple) else (rays, rays)
    crossings = settings.crossings or max(height * width, _FEWEST_CROSSINGS)
    most_segments = (2**31 - 1 - crossings) // columns
    if most_segments < 1:
        raise ValueError(f"crossings must leave room in 32 bits: got {crossings}; take fewer.")
    segments = settings.segments or min(crossings // 2 + 1, most_segments)
    if segments > most_segments:
        raise ValueError(
            f"segments must be at most {most_segments} for {columns} columns: got {segments}."
        )
    chosen = settings.sorted or max(crossings // 4, _FEWEST_SORTED)
    if chosen > 2**24:
        raise ValueError(f"sorted must be at most {2**24}: got {chosen}; take fewer.")
    return BufferSizes(rows, columns, segments, crossings, chosen + chosen % 2)
