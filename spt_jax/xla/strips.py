"""The loops over directions and strips of rows."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.rays.beam import Rays
from spt_jax.xla.arrays import last_within
from spt_jax.xla.beam import Aims, Screen, aim
from spt_jax.xla.crossings import (
    DEPTH_STEPS,
    Rows,
    Strip,
    cast,
    cut_by_rows,
    cut_into_segments,
)
from spt_jax.xla.levels import Intervals, find_overlaps, most_levels, thickness
from spt_jax.xla.settings import BufferSizes, Xla, buffer_sizes, resolve_rays

Sums = TypeVar("Sums")


class Usage(NamedTuple):
    """How much of its buffers the fullest beam needed.

    Attributes:
        segments, crossings, sorted: of the fullest row of the screen. A row that needs more than
            there is makes the value NaN.
        levels: the deepest winding number, or how many parts are over each other; likewise.
        strips: how many strips the screen was worked off in, over all directions.
        open_rays: rays that met a hole and were left out, over all directions.
    """

    segments: Int[Array, ""]
    crossings: Int[Array, ""]
    sorted: Int[Array, ""]
    levels: Int[Array, ""]
    strips: Int[Array, ""]
    open_rays: Int[Array, ""]


def no_usage() -> Usage:
    """Before any ray is cast."""
    return Usage(*[jnp.int32(0) for _ in Usage._fields])


class Ray(NamedTuple):
    """What the rays of one direction have in common.

    Attributes:
        direction: the unit vector along them.
        directions: all of the sampling.
        area: of screen that one stands for.
    """

    direction: Float[Array, "3"]
    directions: Float[Array, "D 3"]
    area: Float[Array, ""]


def over_strips(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    rays: Rays,
    aimed: Aims,
    settings: Xla,
    add: Callable[[Sums, Intervals, Ray], Sums],
    sums: Sums,
) -> tuple[Sums, Usage, Bool[Array, ""]]:
    """Add up what the intervals of every strip of every direction give.

    Args:
        vertices, faces: finite, and in range.
        rays: how many.
        aimed: their directions.
        settings: sizes of the buffers.
        add: gives the sums with a strip's intervals.
        sums: before any of them.

    Returns:
        The sums, the usage of the buffers, and whether all rays fitted.
    """
    rays = resolve_rays(rays)
    space = buffer_sizes(settings, rays)
    directions = jnp.asarray(aimed.direction)

    def along(state, one: Aims):
        sums, usage, usable = state
        screen = aim(vertices, one, rays)
        rows = cut_by_rows(screen, faces, space.rows)
        ray = Ray(jnp.asarray(one.direction), directions, screen.pixel[0] * screen.pixel[1])
        num_rows = jnp.minimum(screen.shape[0], space.rows)

        def next_strip(state):
            begin, sums, usage = state
            end, intervals, usage = _strip(screen, rows, faces, space, begin, num_rows, usage)
            return end, add(sums, intervals, ray), usage

        state = jnp.int32(0), sums, usage
        _, sums, usage = jax.lax.while_loop(lambda state: state[0] < num_rows, next_strip, state)
        usable &= screen.usable
        usable &= (screen.shape[0] <= space.rows) & (screen.shape[1] <= space.columns)
        return (sums, usage, usable), None

    state = sums, no_usage(), jnp.bool_(True)
    (sums, usage, usable), _ = jax.lax.scan(along, state, aimed)
    for name in ("segments", "crossings", "sorted"):
        usable &= getattr(usage, name) <= getattr(space, name)
    return sums, usage, usable & (usage.levels <= most_levels(space.sorted))


def _strip(
    screen: Screen,
    rows: Rows,
    faces: Int[Array, "F 3"],
    space: BufferSizes,
    begin: Int[Array, ""],
    num_rows: Int[Array, ""],
    usage: Usage,
) -> tuple[Int[Array, ""], Intervals, Usage]:
    """One strip from the row `begin` on: where it ends, its intervals and the usage with it."""
    deep = thickness(screen)
    per_unit = DEPTH_STEPS / jnp.where(deep > 0, deep, jnp.ones_like(deep))
    end = jnp.minimum(last_within(rows.before, begin, space.segments), num_rows)
    segments = cut_into_segments(rows, begin, end, per_unit, space.segments)
    strip = Strip(begin, end, space.columns)
    sizes = space.crossings, space.sorted
    crossings, done, open_rays, fullest = cast(segments, strip, space.rows, sizes)
    end = jnp.minimum(done, end)
    intervals, deepest = find_overlaps(screen, faces, crossings, begin, space.columns)
    index = jnp.arange(space.rows, dtype=jnp.int32)
    per_row = jnp.where((index >= begin) & (index < end), jnp.diff(rows.before), 0)
    return (
        end,
        intervals,
        Usage(
            segments=jnp.maximum(usage.segments, per_row.max()),
            crossings=jnp.maximum(usage.crossings, fullest[0]),
            sorted=jnp.maximum(usage.sorted, fullest[1]),
            levels=jnp.maximum(usage.levels, deepest),
            strips=usage.strips + 1,
            open_rays=usage.open_rays + open_rays,
        ),
    )
