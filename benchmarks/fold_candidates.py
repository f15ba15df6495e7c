"""Ways to say how much of an overlap is a collision, for `benchmarks.folds` to compare.

All but the rays of an earlier tree start from the same regions, contours and triangles' shares.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from spt_jax import RestSurface
from spt_jax._exclusions import as_exclusions
from spt_jax.overlap.exact import ExactOverlap, Judged
from spt_jax.overlap.surface import ExactSurface

_ROUNDING = float(np.finfo(np.float64).eps)
# The ramp ends at so many times the distance at which it begins.
_RAMP = 1.5
# Of the inverse distance, and what softens it.
_POWER, _SOFTNESS = 4.0, 0.01


class Pieces(NamedTuple):
    """What the candidates are made of; lengths in the mesh's unit.

    Attributes:
        overlap: the measure as built.
        volume: of each region of overlap.
        middle: of each piece of the contour.
        length: of these pieces.
        of_piece: the region of each.
        pair: the faces that intersect there.
        place: of each triangle that bounds an overlap, the middle of what lies in it.
        part: the volume of the cone over that, with its tip in the region's middle.
        of_part: the region of each.
    """

    overlap: ExactOverlap
    volume: Float[np.ndarray, "R"]
    middle: Float[np.ndarray, "P 3"]
    length: Float[np.ndarray, "P"]
    of_piece: Int[np.ndarray, "P"]
    pair: Int[np.ndarray, "P 2"]
    place: Float[np.ndarray, "H 3"]
    part: Float[np.ndarray, "H"]
    of_part: Int[np.ndarray, "H"]


def judged_of(overlap: ExactOverlap) -> Judged:
    """The regions that contours decide; there are some wherever folds are excluded."""
    judged = overlap.judged
    if judged is None:
        raise ValueError("the overlap must be judged by a rest surface: got one of whole parts.")
    return judged


def pieces_of(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rest: RestSurface
) -> Pieces:
    """The regions, contours and boundaries of one connected surface."""
    surface = ExactSurface(vertices, faces, _ROUNDING)
    overlap = ExactOverlap(surface, as_exclusions(None, (), rest, faces))
    judged = judged_of(overlap)
    layer, region, count = judged.layer, judged.region, len(judged.volume)
    scale = surface.scale
    corners = surface.points[surface.manifold.faces[layer.shares.faces]] / scale
    share = layer.shares.share
    whole = share.sum(axis=1)
    place = np.einsum("hc,hci->hi", share, corners) / np.where(whole, whole, 1.0)[:, None]
    place = np.where(whole[:, None] != 0, place, corners.mean(axis=1))
    size = np.maximum(np.bincount(region, minlength=count), 1)
    center = np.stack([np.bincount(region, x, count) for x in corners.mean(axis=1).T], 1)
    arm = place - (center / size[:, None])[region]
    part = np.einsum("hi,hi->h", arm, layer.shares.normals) * whole / (3 * scale**2)
    return Pieces(
        overlap,
        judged.volume / scale**3,
        layer.contours.point.mean(axis=1) / scale,
        layer.contours.length / scale,
        judged.at,
        surface.pairs[layer.segments],
        place,
        part,
        region,
    )


def as_built(pieces: Pieces) -> float:
    """(a): each region counts with the share of its contour's length that is far."""
    return pieces.overlap.volume


def _by_shares(pieces: Pieces, weight) -> float:
    count = len(pieces.volume)
    total = np.bincount(pieces.of_piece, pieces.length, count)
    far = np.bincount(pieces.of_piece, weight * pieces.length, count)
    share = np.where(total > 0, far / np.where(total > 0, total, 1.0), 1.0)
    return float(pieces.volume @ share)


class Ramp:
    """(a) with a weight that grows from 0 to 1 between one and 1.5 times the distance."""

    def __init__(self, rest: RestSurface):
        self.allowed = rest.distances
        self.paths = rest._paths
        self.limit = _RAMP * float(self.allowed.max())
        self.row = functools.lru_cache(maxsize=4096)(self._row)

    def _row(self, face: int):
        return self.paths._from_faces(np.array([face]), self.limit)[0].astype(np.float32)

    def __call__(self, pieces: Pieces) -> float:
        f, g = pieces.pair.T
        along = np.array([self.row(int(a))[b] for a, b in zip(f, g, strict=True)])
        allowed = np.minimum(self.allowed[f], self.allowed[g])
        return _by_shares(pieces, np.clip((along / allowed - 1) / (_RAMP - 1), 0.0, 1.0))


def by_field(pieces: Pieces, everywhere: bool = False) -> float:
    """(b): a weight field, the inverse-distance mean of the contour's pieces, over the overlap.

    Sampled once a triangle: each counts with the weight in the middle of what lies in the overlap.

    Args:
        pieces: of a mesh.
        everywhere: whether all contours weigh, and not only the region's own.
    """
    weight = pieces.overlap.pair_weights[judged_of(pieces.overlap).layer.segments]
    total = 0.0
    for start in range(0, len(pieces.place), 256):
        rows = slice(start, start + 256)
        away = ((pieces.place[rows, None] - pieces.middle) ** 2).sum(axis=2)
        near = pieces.length * (away + _SOFTNESS**2) ** (-_POWER / 2)
        if not everywhere:
            near *= pieces.of_part[rows, None] == pieces.of_piece
        sums = near.sum(axis=1)
        field = np.where(sums > 0, near @ weight / np.where(sums > 0, sums, 1.0), 1.0)
        total += float(field @ pieces.part[rows])
    return total


def slope_with_shares_held(pieces: Pieces) -> Float[np.ndarray, "V 3"]:
    """(a)'s gradient as it would be if the shares did not change."""
    overlap = pieces.overlap
    held = ExactOverlap(overlap.surface, overlap._exclusions)
    judged = judged_of(overlap)
    held.__dict__["judged"] = judged._replace(volume=0 * judged.volume)
    return held.gradient()
