"""One mesh through all of its beams on the device, one direction after the other."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax.device.arrays import last_within
from spt_jax.device.beam import Aims, aim, aims
from spt_jax.device.crossings import DEPTH_STEPS, Strip, cast, cut_by_rows, cut_into_segments
from spt_jax.device.gradient import add_codes, boundary_gradient
from spt_jax.device.levels import Intervals, find_overlaps, kept_only, most_levels, thickness
from spt_jax.device.settings import Room, Xla, known, room
from spt_jax.overlap.measure import Sampling


class Wants(NamedTuple):
    """What to find by the rays; the rest costs nothing."""

    volume: bool = False
    gradient: bool = False
    labels: bool = False


class Usage(NamedTuple):
    """What the fullest beam needed of the room that there is.

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


class Found(NamedTuple):
    """What the rays found.

    Attributes:
        volume: E, the mean over directions.
        gradient: the boundary integral.
        codes: the triangle rule's labels, as `gradient.add_codes` collects them.
        usage: of the room.
        usable: whether all of it was measured; where it was not, nothing of it can be used.
    """

    volume: Float[Array, ""]
    gradient: Float[Array, "V 3"]
    codes: Int[Array, "V"]
    usage: Usage
    usable: Bool[Array, ""]


def nothing_found(vertices: Float[Array, "V 3"]) -> Found:
    """Before any ray is cast."""
    return Found(
        volume=jnp.zeros((), vertices.dtype),
        gradient=jnp.zeros_like(vertices),
        codes=jnp.zeros(len(vertices), jnp.int32),
        usage=Usage(*[jnp.int32(0)] * len(Usage._fields)),
        usable=jnp.bool_(True),
    )


class _State(NamedTuple):
    begin: Int[Array, ""]
    found: Found


def cast_beams(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    sampling: Sampling,
    settings: Xla,
    wants: Wants,
    counts=None,
) -> Found:
    """Every beam of the sampling through one mesh.

    Args:
        vertices, faces: finite, and in range.
        sampling: rays and directions.
        settings: of the room.
        wants: what to find.
        counts: which intervals count; None: all.
    """
    rays = known(sampling.rays)
    sampling = sampling._replace(rays=rays)
    space = room(settings, rays)
    aimed = aims(sampling, vertices.dtype)
    zero = jnp.int32(0)
    found = Found(
        volume=jnp.zeros((), vertices.dtype),
        gradient=jnp.zeros_like(vertices),
        codes=jnp.zeros(len(vertices), jnp.int32),
        usage=Usage(*[zero] * len(Usage._fields)),
        usable=jnp.bool_(True),
    )

    def along(found: Found, one: Aims):
        return _along(
            vertices, faces, one, aimed.direction, rays, space, wants, counts, found
        ), None

    found, _ = jax.lax.scan(along, found, aimed)
    usage = found.usage
    fits = (
        (usage.segments <= space.segments)
        & (usage.crossings <= space.crossings)
        & (usage.sorted <= space.sorted)
        & (usage.levels <= most_levels(space.sorted))
    )
    return found._replace(
        volume=found.volume / len(sampling.directions), usable=found.usable & fits
    )


def _along(vertices, faces, one, directions, rays, space: Room, wants, counts, found) -> Found:
    screen = aim(vertices, one, rays)
    rows = cut_by_rows(screen, faces, space.rows)
    deep = thickness(screen)
    per_unit = DEPTH_STEPS / jnp.where(deep > 0, deep, jnp.ones_like(deep))
    ray_area = screen.pixel[0] * screen.pixel[1]
    num_rows = jnp.minimum(screen.shape[0], space.rows)

    def more(state: _State):
        return state.begin < num_rows

    def next_strip(state: _State) -> _State:
        begin, found = state
        end = jnp.minimum(last_row(begin), num_rows)
        segments = cut_into_segments(rows, begin, end, per_unit, space.segments)
        strip = Strip(begin, end, space.columns)
        sizes = space.crossings, space.sorted
        crossings, end, open_rays, fullest = cast(segments, strip, space.rows, sizes)
        end = jnp.minimum(end, strip.end)
        intervals, deepest = find_overlaps(screen, faces, crossings, begin, space.columns)
        if counts is not None:
            intervals = kept_only(intervals, counts(intervals))
        found = _with_strip(found, intervals)
        used = found.usage
        index = jnp.arange(space.rows, dtype=jnp.int32)
        per_row = jnp.where((index >= begin) & (index < end), jnp.diff(rows.before), 0)
        usage = Usage(
            segments=jnp.maximum(used.segments, per_row.max()),
            crossings=jnp.maximum(used.crossings, fullest[0]),
            sorted=jnp.maximum(used.sorted, fullest[1]),
            levels=jnp.maximum(used.levels, deepest),
            strips=used.strips + 1,
            open_rays=used.open_rays + open_rays,
        )
        return _State(end, found._replace(usage=usage))

    def last_row(begin):
        return last_within(rows.before, begin, space.segments)

    def _with_strip(found: Found, intervals: Intervals) -> Found:
        if wants.volume:
            # In two steps: float32 sums of many small lengths lose less.
            lengths = jnp.pad(intervals.length, (0, -len(intervals.length) % 256))
            volume = lengths.reshape(256, -1).sum(axis=1).sum() * ray_area
            found = found._replace(volume=found.volume + volume)
        if wants.gradient:
            share = boundary_gradient(
                vertices, faces, intervals, ray_area, one.direction, directions
            )
            found = found._replace(gradient=found.gradient + share)
        if wants.labels:
            found = found._replace(codes=add_codes(found.codes, faces, intervals))
        return found

    found = jax.lax.while_loop(more, next_strip, _State(jnp.int32(0), found)).found
    fits = (screen.shape[0] <= space.rows) & (screen.shape[1] <= space.columns)
    return found._replace(usable=found.usable & screen.usable & fits)
