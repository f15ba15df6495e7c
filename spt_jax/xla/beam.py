"""The world's lattice of rays, on the device: the same as `overlap.rays.beam`, in either precision.

A screen coordinate is a whole number of pixels and a part of one. In float32 that keeps what a
single number of some hundred pixels would round away (3e-5 pixels), so that a ray meets the same
triangle as on the host, where coordinates are float64: products with the frame are split into terms
that are exact, and only the sum of their parts below a pixel is rounded.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax.overlap.measure import Sampling
from spt_jax.overlap.rays.beam import LADDER_STEPS, SHIFT, screen_frame, turned_frame

# Half of float32's 24 bits: products of two numbers of so many bits are exact.
_HALF_BITS = 12
_UPPER_HALF = np.uint32(0xFFFFF000)

# A pixel is a power of two times one of these.
_LADDER = np.exp2(np.arange(LADDER_STEPS) / LADDER_STEPS)


class Fixed(NamedTuple):
    """Numbers as a whole part and the rest, from 0 to 1."""

    whole: Float[Array, "V"]
    part: Float[Array, "V"]


class Screen(NamedTuple):
    """The vertices in a beam's own coordinates.

    Attributes:
        column, row: in pixels from the screen's first ray.
        depth: likewise, in the width of a pixel.
        pixel: width and height of a pixel, in the mesh's unit.
        shape: rows and columns of the screen.
        usable: whether all of this is finite.
    """

    column: Fixed
    row: Fixed
    depth: Fixed
    pixel: Float[Array, "2"]
    shape: Int[Array, "2"]
    usable: Bool[Array, ""]


class Aims(NamedTuple):
    """What one direction or, with a leading axis, every direction of a sampling asks of the screen.

    Attributes:
        direction: the unit vector along the rays.
        outline: the two axes along which the mesh's outline is measured.
        frame: for each of the three axes of the screen, its coefficients at each pixel of the
            ladder, in parts that add up to them.
    """

    direction: Float[Array | np.ndarray, "*D 3"]
    outline: Float[Array | np.ndarray, "*D 2 3"]
    frame: Float[Array | np.ndarray, "*D 3 S 3 P"]


def aims(sampling: Sampling, dtype: np.dtype) -> Aims:
    """The directions of a sampling as arrays of values, for a loop over them."""
    directions = [np.array(direction) for direction in sampling.directions]
    outline = np.stack([screen_frame(direction)[:2] for direction in directions])
    turned = not isinstance(sampling.rays, tuple)
    frames = np.stack([turned_frame(d) if turned else screen_frame(d) for d in directions])
    frames = frames[:, :, None, :] / _LADDER[:, None]
    parts = [frames]
    if dtype == np.float32:
        parts = []
        for _ in range(3):
            mantissa, exponent = np.frexp(frames)
            part = np.ldexp(np.round(np.ldexp(mantissa, _HALF_BITS)), exponent - _HALF_BITS)
            parts.append(part)
            frames = frames - part
    arrays = np.stack(directions), outline, np.stack(parts, axis=-1)
    return Aims(*(array.astype(dtype) for array in arrays))


def most_pixels(rays: int | tuple[int, int]) -> tuple[int, int]:
    """Rows and columns that no screen exceeds, whatever the mesh."""
    # The ladder's pixel is smaller than asked by less than one step.
    finer = 2.0 ** (1.0 / LADDER_STEPS)
    if isinstance(rays, tuple):
        rows, columns = rays
    else:
        # A turned square has sides of cos + sin of the turn.
        u = turned_frame(np.array([0.0, 0.0, -1.0]))[0]
        rows = columns = rays * float(np.abs(u).sum())
    return int(rows * finer) + 4, int(columns * finer) + 4


def aim(vertices: Float[Array, "V 3"], aimed: Aims, rays: int | tuple[int, int]) -> Screen:
    """The screen of one direction and the vertices on it, as `overlap.rays.beam.aim`."""
    dtype = vertices.dtype
    across = _dot(vertices, aimed.outline[0]), _dot(vertices, aimed.outline[1])
    extent = jnp.stack([x.max() - x.min() for x in across])
    if isinstance(rays, tuple):
        wanted = extent / jnp.asarray([rays[1], rays[0]], dtype)
    else:
        wanted = jnp.full(2, extent.max() / rays)
    rung, power = _ladder(jnp.where(wanted > 0, wanted, jnp.ones_like(wanted)))
    pixel = jnp.ldexp(jnp.asarray(_LADDER, dtype)[rung], power)
    scale = jnp.ldexp(jnp.ones(2, dtype), -power)
    coordinates = []
    # Depths are in the pixel's width.
    for axis, side, shift in ((0, 0, SHIFT[0]), (1, 1, SHIFT[1]), (2, 0, 0.0)):
        fixed = _fixed(vertices * scale[side], aimed.frame[axis, rung[side]], float(shift))
        coordinates.append(Fixed(fixed.whole - fixed.whole.min(), fixed.part))
    column, row, depth = coordinates
    shape = jnp.stack([row.whole.max(), column.whole.max()]).astype(jnp.int32) + 2
    usable = jnp.isfinite(extent).all() & jnp.isfinite(depth.whole).all()
    return Screen(column, row, depth, pixel, shape, usable)


def _ladder(wanted: Float[Array, "2"]) -> tuple[Int[Array, "2"], Int[Array, "2"]]:
    # By comparison, not by a logarithm: float32's would miss extents that are powers of two.
    mantissa, exponent = jnp.frexp(wanted)
    steps = np.arange(1, LADDER_STEPS + 1)
    rungs = jnp.asarray(0.5 * np.exp2((steps - 1e-9) / LADDER_STEPS), wanted.dtype)
    rung = jnp.sum(mantissa[:, None] >= rungs[None, :], axis=1, dtype=jnp.int32)
    return rung % LADDER_STEPS, exponent.astype(jnp.int32) - 1 + rung // LADDER_STEPS


def _dot(vectors: Float[Array, "V 3"], axis: Float[Array, "3"]) -> Float[Array, "V"]:
    # Not a matrix product: accelerators round those to fewer bits.
    return vectors[:, 0] * axis[0] + vectors[:, 1] * axis[1] + vectors[:, 2] * axis[2]


def _fixed(vectors: Float[Array, "V 3"], parts: Float[Array, "3 P"], shift: float) -> Fixed:
    if vectors.dtype == jnp.float32:
        bits = jax.lax.bitcast_convert_type(vectors, jnp.uint32) & _UPPER_HALF
        upper = jax.lax.bitcast_convert_type(bits, jnp.float32)
        halves = jnp.stack([upper, vectors - upper])
        terms = halves[:, :, :, None] * parts[None, None]
        nearest = jnp.round(terms)
        whole = nearest.sum(axis=(0, 2, 3))
        part = (terms - nearest).sum(axis=(0, 2, 3)) + shift
    else:
        part = _dot(vectors, parts[:, 0])
        whole = jnp.floor(part)
        part = part - whole + shift
    carry = jnp.floor(part)
    return Fixed(whole + carry, part - carry)
