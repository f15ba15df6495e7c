"""Boxes over one another to any depth, what they overlap by arithmetic, and beams to measure it."""

import itertools
from typing import NamedTuple

import numpy as np
from helpers import Mesh, box, inverted, join

from spt_jax.overlap.boundary import boundary_gradient
from spt_jax.overlap.rays.beam import Beam, ScreenPoints, aim
from spt_jax.overlap.rays.crossings import cast
from spt_jax.overlap.rays.levels import Overlaps, find_overlaps


class Part(NamedTuple):
    """A box along the axes; its sense is -1 where it is inside out."""

    extents: tuple[float, float, float]
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sense: int = 1


_BIG = Part((1.0, 1.1, 1.2))
DEEP = {
    "three boxes": (
        _BIG,
        Part((0.9, 0.8, 0.7), (0.31, 0.12, 0.23)),
        Part((0.8, 0.7, 1.0), (0.07, 0.42, -0.11)),
    ),
    "four boxes": (
        _BIG,
        Part((0.9, 0.8, 0.7), (0.31, 0.12, 0.23)),
        Part((0.8, 0.7, 1.0), (0.07, 0.42, -0.11)),
        Part((0.7, 0.9, 0.8), (0.17, 0.21, 0.41)),
    ),
    "box in a box": (_BIG, Part((0.5, 0.4, 0.3), (0.1, 0.02, -0.03))),
    "nest": (
        _BIG,
        Part((0.7, 0.8, 0.6), (0.03, 0.01, 0.02)),
        Part((0.5, 0.4, 0.3), (0.1, 0.02, -0.03)),
    ),
    "inverted nest": (
        _BIG._replace(sense=-1),
        Part((0.7, 0.8, 0.6), (0.03, 0.01, 0.02), -1),
        Part((0.5, 0.4, 0.3), (0.1, 0.02, -0.03), -1),
    ),
    "inverted box half in a box": (_BIG, Part((0.5, 0.3, 1.0), (0.41, 0.12, 0.43), -1)),
    "inverted nest in a box": (
        _BIG,
        Part((0.7, 0.8, 0.6), (0.03, 0.01, 0.02), -1),
        Part((0.5, 0.4, 0.3), (0.1, 0.02, -0.03), -1),
    ),
    "box in a cavity": (
        _BIG,
        Part((0.7, 0.8, 0.6), (0.03, 0.01, 0.02), -1),
        Part((0.5, 0.4, 0.3), (0.1, 0.02, -0.03)),
    ),
}


def as_mesh(parts: tuple[Part, ...]) -> Mesh:
    """The boxes as one mesh, of which every eight vertices and twelve triangles are one."""
    solids = (box(part.extents, np.array(part.center)) for part in parts)
    turned = zip(solids, parts, strict=True)
    return join(*(inverted(solid) if part.sense < 0 else solid for solid, part in turned))


def overlap(parts: tuple[Part, ...], shifts: np.ndarray | None = None) -> float:
    """The integral of w (w - 1) / 2, with w the sum of the boxes' senses where they are.

    Squared, that sum has every box once and every pair twice: the integral is that of the pairs'
    overlaps, each with the product of its senses, and the volume of the boxes that are inside out.
    """
    extents = np.array([part.extents for part in parts])
    centers = np.array([part.center for part in parts]) + (0.0 if shifts is None else shifts)
    low, high = centers - extents / 2, centers + extents / 2
    total = sum(np.prod(part.extents) for part in parts if part.sense < 0)
    for i, j in itertools.combinations(range(len(parts)), 2):
        common = np.minimum(high[i], high[j]) - np.maximum(low[i], low[j])
        total += parts[i].sense * parts[j].sense * np.prod(np.maximum(common, 0.0))
    return float(total)


def pushes(parts: tuple[Part, ...]) -> np.ndarray:
    """The derivative of `overlap` with the place of each box: linear in small steps, so exact."""
    found, step = np.zeros((len(parts), 3)), 1e-3
    for k, axis in np.ndindex(found.shape):
        shift = np.zeros_like(found)
        shift[k, axis] = step
        found[k, axis] = (overlap(parts, shift) - overlap(parts, -shift)) / (2 * step)
    return found


def one_beam(mesh: Mesh, direction, rays) -> tuple[Beam, ScreenPoints, Overlaps]:
    """A beam, the vertices on its screen, and the overlaps on its rays."""
    beam, points = aim(mesh[0], np.asarray(direction, float), rays)
    crossings = cast(beam, points, mesh[1], simple_rays=False)
    return beam, points, find_overlaps(beam, points, mesh[1], crossings)


def by_rays(mesh: Mesh, rays, directions) -> tuple[float, np.ndarray]:
    """Volume and gradient from the beams alone, without the rest of the host path."""
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    volumes, gradient = [], np.zeros_like(mesh[0])
    for direction in directions:
        beam, _, overlaps = one_beam(mesh, direction, rays)
        volumes.append(overlaps.size * beam.ray_area)
        gradient += boundary_gradient(*mesh, beam, overlaps, directions)
    return float(np.mean(volumes)), gradient


def without(mesh: Mesh, sizes: list[int], kept: tuple[int, ...]) -> Mesh:
    """The mesh with only some of its parts, of so many triangles each.

    The others shrink to one vertex, so that the rays and the shapes of the arrays stay.
    """
    part = np.repeat(np.arange(len(sizes)), sizes)
    part = np.append(part, np.full(len(mesh[1]) - len(part), -1))
    return mesh[0], np.where(np.isin(part, kept)[:, None], mesh[1], 0).astype(mesh[1].dtype)


def from_pairs(function, mesh: Mesh, sizes: list[int]):
    """What the parts and the pairs of parts give, added up as the integral of w (w - 1) / 2 does.

    w is the sum of the parts' own winding numbers, so the integral of the whole is that of each
    part and, for each pair, what the two have together more than each by itself.
    """
    count = len(sizes)
    alone = [function(without(mesh, sizes, (k,))) for k in range(count)]
    total = sum(alone)
    for i, j in itertools.combinations(range(count), 2):
        total = total + function(without(mesh, sizes, (i, j))) - alone[i] - alone[j]
    return total
