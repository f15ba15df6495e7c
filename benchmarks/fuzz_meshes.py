"""Random solids measured, against exact arithmetic, manifold3d and laws: part of the fuzz.

With w the sum of c over the solids that a point lies in, E is the integral of w (w - 1) / 2: for
solids with volumes V and intersections V_ij that is the sum of (c^2 - c) / 2 V over the solids and
of c_i c_j V_ij over pairs. c is 1, -1 for a solid that is inside out, 2 for one whose faces are
there twice.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float, Int

from spt_jax._query import as_directions
from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.host_functions import PenaltyOptions, value_and_gradient_on_host
from spt_jax.overlap.measure import Measurement, Sampling, Unmeasurable, measure

KINDS = ("general position", "contact", "coplanar", "duplicated", "sliver", "nested", "open")
# Relative to the cube of the size, and for laws to the sum of the magnitudes that cancel.
# Overlaps thinner than a contact, eight units in the last place, may be left out.
_OFF = {"float32": 3e-5, "float64": 1e-10}
_LAW = 1e-9
_SAMPLING = Sampling(None, as_directions(3))


@dataclass(frozen=True)
class Solid:
    """One closed solid, its winding number within, and whether its sides lie along the axes."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    winding: int = 1
    aligned: bool = False

    def given(self) -> Int[np.ndarray, "F 3"]:
        """The faces as they are measured: turned over, or there several times."""
        faces = self.faces if self.winding > 0 else self.faces[:, ::-1]
        return np.tile(faces, (abs(self.winding), 1))


def check(seed: int, number: int) -> tuple[str, str, list[str]]:
    """Measure one random mesh: its kind, its dtype, and what is wrong with the result."""
    rng = np.random.default_rng([seed, number])
    kind = KINDS[number % len(KINDS)]
    dtype = ("float32", "float64")[rng.integers(2)]
    solids = _scaled(rng, dtype, _solids(rng, kind))
    vertices, faces = _joined(solids)
    if kind == "open":
        faces = _torn(rng, faces, len(vertices))
    try:
        found = _measured(vertices, faces, dtype)
        value, gradient = found.volume, found.gradient("boundary", "vertex")
    except Unmeasurable as reason:
        return kind, dtype, [] if kind == "open" else [f"refused: {reason}"]
    # In units of the mesh's size: what is compared is of the order of one.
    unit = 2.0 ** np.frexp(np.ptp(vertices, axis=0).max())[1]
    value, gradient, points = value / unit**3, gradient / unit**2, vertices / unit
    faults = _broken_laws(value, gradient, points)
    faults += _broken_as_returned(vertices, faces, dtype)
    if kind != "open":
        if not found.exact:
            faults.append("a ray was cast")
        truth = _truth([replace(s, vertices=s.vertices / unit) for s in solids])
        if truth is not None and abs(value - truth) > _OFF[dtype]:
            faults.append(f"value {value:.12g} where {truth:.12g} is right")
        faults += _changes_when_rewritten(rng, value, gradient, points, faces, dtype)
    return kind, dtype, faults


def _measured(vertices, faces, dtype: str) -> Measurement:
    return measure(vertices, faces, _SAMPLING, rounding=float(np.finfo(dtype).eps))


def _broken_laws(value, gradient, points) -> list[str]:
    """What holds of every mesh, closed or not: holes are closed by a fan."""
    if not (np.isfinite(value) and np.isfinite(gradient).all()):
        return ["a value or a gradient that is not finite"]
    faults = []
    if value < 0:
        faults.append(f"a negative value, {value:.3g}")
    # About the middle, where a mesh far from the origin loses no digits.
    arms = points - (points.max(axis=0) + points.min(axis=0)) / 2
    most = np.abs(gradient).sum() + _LAW
    total = np.abs(gradient.sum(axis=0)).max()
    torque = np.abs(np.cross(arms, gradient).sum(axis=0)).max()
    euler = abs(3 * value - (arms * gradient).sum())
    for what, off in (("sum", total), ("torque", torque), ("3 E - x . dE/dx", euler)):
        if off > _LAW * max(most, 1.0):
            faults.append(f"{what} of the gradient is {off:.3g} of {most:.3g}")
    return faults


def _broken_as_returned(vertices, faces, dtype: str) -> list[str]:
    """What the penalty makes of it: in contact the sums have a slope from one side beside a 0."""
    options = PenaltyOptions(
        "volume", "boundary", "vertex", _SAMPLING, NOTHING, float(np.finfo(dtype).eps)
    )
    value, gradient = value_and_gradient_on_host(vertices, faces, options)
    if np.isnan(value) or value == 0:
        if np.any(gradient):
            return [f"the penalty is {value} with a gradient of {np.abs(gradient).max():.3g}"]
    elif not (value >= np.finfo(dtype).tiny and np.isfinite(gradient.astype(dtype)).all()):
        return [f"the penalty is {value}, or its gradient overflows"]
    return []


def _changes_when_rewritten(rng, value, gradient, points, faces, dtype) -> list[str]:
    """The same surface with rows and corners in another order, or turned by 90 degrees."""
    if rng.integers(2):
        what, axes = "turned by 90 degrees", rng.permutation(3)
        turn = np.eye(3)[axes] * rng.choice([-1.0, 1.0], 3)[:, None]
        turn *= np.linalg.det(turn).round()
        place = np.arange(len(points))
    else:
        what, turn, place = "written in another order", np.eye(3), rng.permutation(len(points))
    moved = np.empty_like(points)
    moved[place] = points @ turn.T
    faces = place[faces]
    if what == "written in another order":
        faces = faces[rng.permutation(len(faces))]
        start = rng.integers(3, size=(len(faces), 1))
        faces = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)
    again = _measured(moved, faces, dtype)
    off = abs(again.volume - value)
    if off > _OFF[dtype]:
        return [f"{what}, the value is off by {off:.3g}"]
    return []


def _truth(solids: list[Solid]) -> float | None:
    """E, exactly for boxes along the axes and by manifold3d for others.

    None where manifold3d does not give for A and B what it gives for B and A, as it did for one of
    13,000 triples of boxes with flush sides.
    """
    if all(solid.aligned for solid in solids):
        boxes = [_box_of(solid) for solid in solids]
        return _summed(solids, lambda i, j: _shared_of_boxes(boxes[i], boxes[j]))
    others = [_manifold_of(solid) for solid in solids]

    def shared(i: int, j: int) -> Fraction:
        return Fraction((others[i] if i == j else others[i] ^ others[j]).volume())

    there, back = (_summed(solids, way) for way in (shared, lambda i, j: shared(j, i)))
    return there if abs(there - back) < _OFF["float64"] else None


def _summed(solids: list[Solid], shared: Callable[[int, int], Fraction]) -> float:
    """The sum over the solids and their pairs; `shared` is the volume that two have in common."""
    winding, total = [solid.winding for solid in solids], Fraction(0)
    for k, c in enumerate(winding):
        weight = c * (c - 1) // 2
        total += weight * shared(k, k) if weight else 0
    for i, j in itertools.combinations(range(len(solids)), 2):
        total += winding[i] * winding[j] * shared(i, j)
    return float(total)


def _box_of(solid: Solid) -> list[tuple[Fraction, Fraction]]:
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    return [(Fraction(a), Fraction(b)) for a, b in zip(low.tolist(), high.tolist(), strict=True)]


def _shared_of_boxes(one, other) -> Fraction:
    volume = Fraction(1)
    for (a, b), (c, d) in zip(one, other, strict=True):
        volume *= max(min(b, d) - max(a, c), Fraction(0))
    return volume


def _manifold_of(solid: Solid) -> manifold3d.Manifold:
    mesh = manifold3d.Mesh64(
        vert_properties=solid.vertices, tri_verts=solid.faces.astype(np.uint64)
    )
    return manifold3d.Manifold(mesh)


def _solids(rng: np.random.Generator, kind: str) -> list[Solid]:
    count = int(rng.integers(2, 5))
    if kind in ("general position", "open"):
        solids = [_moved(rng, _smooth(rng)) for _ in range(count)]
    elif kind == "sliver":
        solids = [_moved(rng, _thin(rng)) for _ in range(count)]
    elif kind == "nested":
        solids = _nested(rng, count)
    else:
        solids = [_whole_box(rng, kind == "coplanar") for _ in range(count)]
        if rng.integers(2):  # all of them as one, so that sides stay flush to rounding
            turn = _turn(rng)
            solids = [replace(s, vertices=s.vertices @ turn.T, aligned=False) for s in solids]
    if kind == "duplicated":
        solids += [solids[k] for k in rng.integers(len(solids), size=rng.integers(1, 3))]
        solids = [replace(s, winding=int(rng.choice([1, 1, 2]))) for s in solids]
    return [replace(s, winding=-s.winding if rng.random() < 0.15 else s.winding) for s in solids]


def _of(mesh: trimesh.Trimesh) -> Solid:
    return Solid(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))


def _smooth(rng) -> Solid:
    shape = rng.integers(4)
    if shape == 0:
        return _of(trimesh.creation.icosphere(subdivisions=1, radius=0.6))
    if shape == 1:
        return _of(trimesh.creation.cylinder(0.4, 1.2, sections=int(rng.integers(3, 12))))
    if shape == 2:
        return _of(trimesh.creation.torus(0.6, 0.25, major_sections=8, minor_sections=5))
    return _of(trimesh.creation.box(rng.uniform(0.3, 1.5, 3)))


def _thin(rng) -> Solid:
    solid = _smooth(rng)
    return replace(solid, vertices=solid.vertices * [1, 1, 10 ** rng.uniform(-6, -1)])


def _nested(rng, count: int) -> list[Solid]:
    solid = _of(trimesh.creation.icosphere(subdivisions=1))
    if rng.integers(2):
        solid = _of(trimesh.creation.box())
    turn, shrink = _turn(rng), rng.uniform(0.3, 0.95)
    return [replace(solid, vertices=shrink**k * solid.vertices @ turn.T) for k in range(count)]


def _whole_box(rng, fine: bool) -> Solid:
    """A box with whole coordinates, so that sides of several lie in one plane."""
    box = trimesh.creation.box([2.0, 2.0, 2.0])
    if fine and rng.integers(2):
        box = box.subdivide()
    low = rng.integers(0, 3, 3)
    high = low + rng.integers(1, 3, 3)
    if fine:
        low[2], high[2] = 0, 2
    vertices = low + (np.array(box.vertices) + 1) / 2 * (high - low)
    return Solid(vertices, np.array(box.faces, np.int64), aligned=True)


def _turn(rng) -> Float[np.ndarray, "3 3"]:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def _moved(rng, solid: Solid) -> Solid:
    return replace(solid, vertices=solid.vertices @ _turn(rng).T + rng.uniform(-0.4, 0.4, 3))


def _scaled(rng, dtype: str, solids: list[Solid]) -> list[Solid]:
    """The solids at a size of 1e-12 to 1e12, as the dtype holds them."""
    scale, away = 10 ** rng.uniform(-12, 12), rng.choice([0.0, 1.0, 10.0]) * rng.normal(size=3)
    return [
        replace(s, vertices=(scale * (s.vertices + away)).astype(dtype).astype(np.float64))
        for s in solids
    ]


def _joined(solids: list[Solid]):
    start = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.given() + k for solid, k in zip(solids, start, strict=False)]
    return np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces)


def _torn(rng, faces, count: int):
    """Faces without some, or with strangers among them, or of random corners altogether."""
    way = rng.integers(4)
    if way == 0:
        return faces[rng.random(len(faces)) < rng.uniform(0.5, 0.98)]
    if way == 1:
        strangers = rng.integers(count, size=(rng.integers(1, 8), 3))
        return np.concatenate([faces, strangers])
    if way == 2:
        return np.where(rng.random((len(faces), 1)) < 0.2, faces[:, ::-1], faces)
    return rng.integers(count, size=(rng.integers(1, 40), 3))
