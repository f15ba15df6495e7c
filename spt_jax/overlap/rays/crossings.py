"""Triangles x rays -> crossings, sorted by depth along each ray (paper, Algorithm 1, lines 3-11).

A list of crossings sorted along every ray of a screen is a layered depth image. It is made in bands
of rows, from the spans of `scanlines.py`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.overlap.rays.beam import Beam, ScreenPoints
from spt_jax.overlap.rays.scanlines import Spans, bands, paired, scan

# Depth is quantised only for the sort; below this many bits the packed key would confuse sheets
# that are a few micrometres apart on a body, and a wider two-part sort takes over.
_FEWEST_DEPTH_BITS = 20
_MOST_DEPTH_BITS = 32


@dataclass(frozen=True)
class Crossings:
    """Crossings of one beam with a mesh, sorted by ray and then by depth.

    Attributes:
        ray: number of the ray, as in `Beam.locate`.
        face: the triangle that is crossed.
        sign: +1 where the ray enters (the triangle faces it), -1 where it leaves.
        depth_quantum: two crossings nearer than this may stand in the wrong order.
        open_rays: rays whose signs do not sum to zero, because the mesh has a hole there. They
            are dropped: nothing on them can be classified.
        met: crossings in all, those that are left out counted.
    """

    ray: Int[np.ndarray, "N"]
    face: Int[np.ndarray, "N"]
    sign: Int[np.ndarray, "N"]
    depth_quantum: float
    open_rays: int
    met: int


def cast(
    beam: Beam, points: ScreenPoints, faces: Int[np.ndarray, "F 3"], *, simple_rays: bool = True
) -> Crossings:
    """The crossings of the beam's rays with the triangles, sorted along each ray.

    Without `simple_rays`, rays that are seen to meet no overlap before anything is sorted are left
    out: those that enter and leave the mesh once or twice, in that order.
    """
    near = points.depth.min(initial=np.inf)
    thickness = points.depth.max(initial=-np.inf) - near
    sorter = _Sorter(near, thickness, len(faces), simple_rays)
    parts = []
    for rows, face in bands(points, faces, beam.shape):
        spans = scan(points, faces, face, rows)
        first = (spans.row - rows.begin) * beam.shape[1] + spans.first_column
        num_pixels = (rows.end - rows.begin) * beam.shape[1]
        parts.append(sorter.crossings(spans, first, num_pixels, rows.begin * beam.shape[1]))
    if len(parts) == 1:
        return parts[0]
    nothing = np.zeros(0, np.int64)
    return Crossings(
        *(
            np.concatenate([nothing, *(getattr(part, name) for part in parts)])
            for name in ("ray", "face", "sign")
        ),
        depth_quantum=max((part.depth_quantum for part in parts), default=0.0),
        open_rays=sum(part.open_rays for part in parts),
        met=sum(part.met for part in parts),
    )


@dataclass(frozen=True)
class _Sorter:
    """Spans -> crossings, sorted.

    Attributes:
        near: depth of the nearest vertex.
        thickness: depth of the farthest one, from there.
        num_faces: of the mesh.
        simple_rays: whether rays without an overlap are wanted.
    """

    near: float
    thickness: float
    num_faces: int
    simple_rays: bool

    def crossings(
        self, spans: Spans, first: Int[np.ndarray, "S"], num_pixels: int, first_ray: int = 0
    ) -> Crossings:
        """The crossings of these spans.

        Args:
            spans: of all triangles that cover any of the pixels.
            first: number of each span's first pixel.
            num_pixels: the numbers are below this.
            first_ray: the ray of pixel 0.
        """
        face_bits = max(self.num_faces - 1, 1).bit_length()
        pixel_bits = num_pixels.bit_length()
        depth_bits = min(_MOST_DEPTH_BITS, 62 - pixel_bits - face_bits)
        packed = depth_bits >= _FEWEST_DEPTH_BITS
        if not packed:
            depth_bits = min(40, 62 - pixel_bits)
        steps = float((1 << depth_bits) - 1)
        per_unit = steps / self.thickness if self.thickness > 0 else 0.0

        # Everything of a crossing is linear in its number i: what its span has at i = 0, and i.
        span = np.repeat(np.arange(len(spans.width)), spans.width)
        number = np.arange(len(span))
        before = np.cumsum(spans.width) - spans.width
        # Exits are counted behind all pixels.
        start = first - before + num_pixels * spans.leaves
        slot = start.take(span)
        slot += number
        depth_step = spans.depth_step * per_unit
        with np.errstate(invalid="ignore"):  # of empty spans
            start_depth = (spans.first_depth - self.near) * per_unit - depth_step * before
        line = paired(start_depth, depth_step).take(span)
        depth = np.imag(line) * number
        depth += np.real(line)
        met = len(span)

        keep, open_rays = _worth_sorting(num_pixels, slot, depth, self.simple_rays)
        if keep is not None:
            kept = np.flatnonzero(np.tile(keep, 2).take(slot))
            span, slot, depth = span.take(kept), slot.take(kept), depth.take(kept)
        np.clip(depth, 0.0, steps, out=depth)
        quantum = 1.0 / per_unit if per_unit else 0.0

        # At equal depth a ray enters before it leaves; either order makes a gap of no length.
        if packed:
            # Packed into one integer, nothing has to be gathered after the sort.
            pixel_shift = depth_bits + 1 + face_bits
            exit_bit = (1 << face_bits) - (num_pixels << pixel_shift)
            key = (spans.leaves * exit_bit + spans.face).take(span)
            key += slot << pixel_shift
            key += depth.astype(np.int64) << (1 + face_bits)
            key = key.view(np.uint64)
            key.sort()
            key = key.view(np.int64)
            ray = (key >> pixel_shift) + first_ray
            sign = 1 - 2 * ((key >> face_bits) & 1)
            face = key & ((1 << face_bits) - 1)
            return Crossings(ray, face, sign, quantum, open_rays, met)
        leaves = spans.leaves.take(span)
        pixel = slot - num_pixels * leaves
        order = np.lexsort((leaves, (pixel << depth_bits) | depth.astype(np.int64)))
        sign = 1 - 2 * leaves.take(order).astype(np.int64)
        return Crossings(
            pixel.take(order) + first_ray,
            spans.face.take(span.take(order)),
            sign,
            quantum,
            open_rays,
            met,
        )


def _worth_sorting(
    num_pixels: int, slot: Int[np.ndarray, "N"], depth: Float[np.ndarray, "N"], simple_rays: bool
) -> tuple[Bool[np.ndarray, "P"] | None, int]:
    """Which pixels to keep (None: all), and the number of open rays.

    Decided from each pixel's number of entries and exits and, where there are at most two of
    each, from their depths, before the sort, which costs more than all of this.

    Args:
        num_pixels: of the band.
        slot: a crossing's pixel; that and num_pixels where the ray leaves.
        depth: along the ray.
        simple_rays: keep all rays but open ones.
    """
    count = np.bincount(slot, minlength=2 * num_pixels)
    entries, exits = count[:num_pixels], count[num_pixels:]
    is_open = entries != exits
    open_rays = int(np.count_nonzero(is_open))
    if simple_rays or not len(slot):
        return (~is_open if open_rays else None), open_rays
    # Of two depths: the one that is written last, and what the sum is more than it.
    last = np.zeros(2 * num_pixels)
    last[slot] = depth
    other = np.bincount(slot, depth, 2 * num_pixels)
    other -= last
    np.copyto(other, last, where=count == 1)
    first = np.minimum(other, last)
    np.maximum(other, last, out=last)
    first_entry, first_exit = first[:num_pixels], first[num_pixels:]
    last_entry, last_exit = last[:num_pixels], last[num_pixels:]
    # Two passes are apart where the second entry lies behind the first exit; a ray that starts with
    # an exit or ends with an entry meets an inverted part; of three passes nothing is known yet.
    simple = (first_entry <= first_exit) & (last_entry <= last_exit)
    simple &= (entries < 2) | (first_exit <= last_entry)
    simple &= entries < 3
    simple |= is_open
    return ~simple, open_rays
