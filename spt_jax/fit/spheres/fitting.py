"""Spheres fitted to the parts of a body at rest; NumPy and SciPy only.

Each part's volume is sampled on a grid of its own, so that a finger is seen as finely as a thigh.
Spheres are chosen one by one: of a number of centers inside the part, the center and radius that
cover the most of the part's volume not covered yet, less what lies outside of the body. Then each
sphere in turn is chosen again, given the others.
"""

import functools
import hashlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.fit.spheres.surface_samples import Surface, sample_surface

# Grid cells in a part's bounding box, and candidate centers. With 600 cells the embedded body's
# spheres lay 7.3 mm from the skin on average, not 6.1; with 100 centers 6.6 mm.
_CELLS = 800
_PADDING = 0.1
_MOST_CENTRES, _DEEPEST = 140, 0.9
_DEEPENINGS = 5
# What covering a sample is worth: outside the body as much as inside, so that a sphere neither
# shrinks to an inscribed one nor swells, and the more the farther out in terms of the part's
# thickness, or one sphere bulges out of the chest by 4 cm; in a neighboring part a little less
# than nothing, since what stands out there moves when the joint bends.
_OUTSIDE, _FAR_OUTSIDE, _NEIGHBOUR = -1.0, 4.0, -0.1
# A further sphere must add this share of its part's volume, and of the body's: a finger's segment
# gets one sphere, a thigh four.
_LEAST_OF_PART, _LEAST_OF_BODY = 0.04, 2e-4
_MOST_SPHERES = 12
_RADII = 48
_SWEEPS = 2
# Which samples of the surface a sphere follows: those nearer to it than this part of its radius.
_SUPPORT, _FEWEST = 0.25, 30
# Holds a center to the mean of its support in directions that the support does not see.
_RIDGE = 1e-3


class Fitted(NamedTuple):
    """Spheres at rest, how they follow the shape, and which pairs may collide."""

    part: Int[np.ndarray, "S"]
    centers: Float[np.ndarray, "S 3"]
    radii: Float[np.ndarray, "S"]
    center_shape_basis: Float[np.ndarray, "S 3 B"]
    radius_shape_basis: Float[np.ndarray, "S B"]
    counts: Bool[np.ndarray, "S S"]


class Rest:
    """A body at rest and what is asked of its spheres, hashed and compared by their bytes.

    Args:
        vertices: of the mean shape.
        faces: of the closed surface.
        groups: the part of each face, a joint.
        parents, joints: the tree, and where its joints are.
        shape_basis: displacement of the vertices for each shape coefficient.
        share: of each part's volume to cover.
        fold_distance: pairs of spheres nearer along the limbs do not collide.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        groups: Int[np.ndarray, "F"],
        joints: Float[np.ndarray, "J 3"],
        parents: tuple[int, ...],
        shape_basis: Float[np.ndarray, "V 3 B"],
        share: float,
        fold_distance: float,
    ):
        self.vertices, self.faces, self.groups = vertices, faces, groups
        self.joints, self.parents, self.shape_basis = joints, parents, shape_basis
        self.share, self.fold_distance = share, fold_distance
        digest = hashlib.blake2b(repr((parents, share, fold_distance)).encode(), digest_size=32)
        for array in (vertices, faces, groups, joints, shape_basis):
            digest.update(repr(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        self._digest = digest.digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rest) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)


@functools.lru_cache(maxsize=8)
def fit_spheres(rest: Rest) -> Fitted:
    """Spheres that cover the given share of each part, or less where more would be many."""
    surface = sample_surface(rest.vertices, rest.faces)
    found = []
    for joint in np.unique(rest.groups[surface.face]).tolist():
        samples = _sample_part(surface, rest, joint)
        if samples is not None:
            chosen = _cover(samples, rest.share, _LEAST_OF_BODY * surface.volume)
            found += [(joint, *sphere) for sphere in chosen]
    part = np.array([sphere[0] for sphere in found], np.int64)
    centers = np.reshape([sphere[1] for sphere in found], (-1, 3)).astype(np.float64)
    radii = np.array([sphere[2] for sphere in found], np.float64)
    moves = [_follow(surface, rest, *sphere) for sphere in found]
    basis = np.reshape(moves, (-1, 4, rest.shape_basis.shape[-1])).astype(np.float64)
    counts = _may_collide(rest, part, centers, radii)
    return Fitted(part, centers, radii, basis[:, :3], basis[:, 3], counts)


class _Samples(NamedTuple):
    """A part's grid: its points, what covering each is worth, and the candidate centers."""

    points: Float[np.ndarray, "N 3"]
    worth: Float[np.ndarray, "N"]
    centers: Float[np.ndarray, "C 3"]
    limit: Float[np.ndarray, "C"]
    cell: float


def _sample_part(surface: Surface, rest: Rest, joint: int) -> _Samples | None:
    owner = rest.groups[surface.face]
    own_surface = surface.points[owner == joint]
    low, high = own_surface.min(axis=0), own_surface.max(axis=0)
    longest = (high - low).max()
    if longest == 0:
        return None
    size = np.maximum(high - low, 0.2 * longest)
    step = (size.prod() / _CELLS) ** (1 / 3)
    counts = np.ceil((size / 2 + _PADDING * longest) / step)
    axes = [step * np.arange(-count, count + 1) for count in counts]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points = (low + high) / 2 + offsets
    inside, nearest = surface.inside(points)
    part = owner[nearest]
    own = inside & (part == joint)
    if not own.any():
        return None
    above = np.array(rest.parents)
    near = (above == joint) | (np.arange(len(above)) == above[joint])
    distance = np.linalg.norm(points - surface.points[nearest], axis=1)
    beyond = _OUTSIDE - _FAR_OUTSIDE * distance / distance[own].max()
    worth = np.where(own, 1.0, np.where(inside, np.where(near[part], _NEIGHBOUR, _OUTSIDE), beyond))
    # Centers near the surface never win: the deepest seven tenths, evenly.
    deepest = np.argsort(-distance[own], kind="stable")
    last = np.ceil(_DEEPEST * len(deepest))
    chosen = np.unique(np.linspace(0, last - 1, _MOST_CENTRES).astype(np.int64))
    # Those in the middle make limbs, those left where they were fill what is flat.
    centers = points[own][deepest[chosen]]
    centers = np.concatenate([_deepened(surface, centers[::2], step), centers[1::2]])
    # A sphere that leaves the grid would cover unseen what lies outside of it.
    limit = (counts * step - np.abs(centers - (low + high) / 2)).min(axis=1)
    return _Samples(points, worth, centers, limit, step**3)


def _deepened(surface: Surface, centers, step: float) -> Float[np.ndarray, "C 3"]:
    """Points moved from the grid towards the middle of the body, by less than two cells."""
    for halvings in range(_DEEPENINGS):
        nearest = surface.tree.query(centers)[1]
        away = centers - surface.points[nearest]
        depth = np.linalg.norm(away, axis=1)
        ahead = away / np.maximum(depth, np.finfo(float).tiny)[:, None]
        tried = centers + step * 0.5**halvings * ahead
        deeper = surface.tree.query(tried)[0] > depth
        centers = np.where(deeper[:, None], tried, centers)
    return centers


def _cover(samples: _Samples, share: float, least: float) -> list[tuple[np.ndarray, float]]:
    """Center and radius of each sphere of a part."""
    square = (samples.points**2).sum(axis=1) - 2 * samples.centers @ samples.points.T
    square += (samples.centers**2).sum(axis=1)[:, None]
    apart = np.sqrt(np.maximum(square, 0.0))
    # The worth of every radius, of _RADII for each center, is one running sum of a histogram;
    # sorting the samples by their distance took twice as long.
    step = samples.limit / _RADII
    center, point = np.nonzero(apart < samples.limit[:, None])
    ring = np.minimum((apart[center, point] / step[center]).astype(np.int64), _RADII - 1)
    bin_of_pair = center * _RADII + ring
    own = samples.worth > 0
    chosen: list[tuple[int, int]] = []

    def covered(spheres) -> Bool[np.ndarray, "N"]:
        mask = np.zeros(len(own), bool)
        for center, ring in spheres:
            mask |= apart[center] < (ring + 1) * step[center]
        return mask

    def best(mask) -> tuple[tuple[int, int], float]:
        worth = np.where(mask, 0.0, samples.worth)
        rings = np.bincount(bin_of_pair, worth[point], minlength=len(step) * _RADII)
        run = rings.reshape(-1, _RADII).cumsum(axis=1)
        center, ring = divmod(int(run.argmax()), _RADII)
        return (center, ring), float(run[center, ring])

    while len(chosen) < _MOST_SPHERES:
        mask = covered(chosen)
        sphere, gain = best(mask)
        enough = (mask & own).sum() >= share * own.sum()
        small = gain < _LEAST_OF_PART * own.sum() or gain * samples.cell < least
        if gain <= 0 or (chosen and (enough or small)):
            break
        chosen.append(sphere)
    for _ in range(_SWEEPS if len(chosen) > 1 else 0):
        for index in range(len(chosen)):
            chosen[index] = best(covered(chosen[:index] + chosen[index + 1 :]))[0]
    return [(samples.centers[center], (ring + 1) * step[center]) for center, ring in chosen]


def _follow(surface: Surface, rest: Rest, joint, center, radius):
    """Displacement of the center and change of the radius, (4, B), for each shape coefficient.

    To first order a point of the sphere in direction u moves along u by u . dc + dr: least squares
    over the samples of the surface that lie on it, weighed by area.
    """
    own = np.flatnonzero(rest.groups[surface.face] == joint)
    offset = surface.points[own] - center
    length = np.linalg.norm(offset, axis=1)
    gap = np.abs(length - radius)
    fewest = np.sort(gap)[:_FEWEST][-1]
    support = (gap <= max(_SUPPORT * radius, fewest)) & (length > 0)
    rows = own[support]
    u = offset[support] / length[support, None]
    weight = surface.area[rows] / surface.area[rows].sum()
    corners = rest.shape_basis[rest.faces[surface.face[rows]]]
    moved = np.einsum("nk,nkcb->ncb", surface.corner[rows], corners)
    mean = np.einsum("n,ncb->cb", weight, moved)
    along = np.einsum("nc,ncb->nb", u, moved - mean)
    system = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    normal = np.einsum("n,ni,nj->ij", weight, system, system) + np.diag([_RIDGE] * 3 + [0.0])
    solved = np.linalg.solve(normal, np.einsum("n,ni,nb->ib", weight, system, along))
    solved[:3] += mean
    return solved


def _may_collide(rest: Rest, part, centers, radii) -> Bool[np.ndarray, "S S"]:
    """Above the diagonal: the pairs that are far along the limbs, and apart at rest.

    Along the limbs is from center to center over the joints between, less the radii.
    """
    counts = np.linalg.norm(centers[:, None] - centers, axis=-1) > radii[:, None] + radii
    steps = [_way(rest, joint) for joint in range(len(rest.parents))]
    spheres = {joint: np.flatnonzero(part == joint) for joint in np.unique(part).tolist()}
    for p, first in spheres.items():
        for q, second in spheres.items():
            up = [joint for joint in steps[p] if joint not in steps[q]]
            down = [joint for joint in steps[q] if joint not in steps[p]]
            over = rest.joints[up + down[::-1]]
            if not len(over):  # one part
                counts[np.ix_(first, second)] = False
                continue
            ends = [
                np.linalg.norm(centers[i] - k, axis=1) - radii[i]
                for i, k in ((first, over[0]), (second, over[-1]))
            ]
            between = np.linalg.norm(np.diff(over, axis=0), axis=1).sum()
            far = ends[0][:, None] + between + ends[1] > rest.fold_distance
            kin = rest.parents[p] == q or rest.parents[q] == p
            counts[np.ix_(first, second)] &= far & (not kin)
    return np.triu(counts)


def _way(rest: Rest, joint: int) -> list[int]:
    """A joint and those above it."""
    way = [joint]
    while rest.parents[way[-1]] >= 0:
        way.append(rest.parents[way[-1]])
    return way
