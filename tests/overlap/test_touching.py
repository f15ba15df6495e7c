"""Solids that touch: what makes contact cheap decides nothing, and signs are those of fractions."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from helpers import box, join, random_rotation

from spt_jax.overlap.arrays.ranges import unique
from spt_jax.overlap.exact import ExactOverlap
from spt_jax.overlap.surface import ExactSurface
from spt_jax.overlap.triangles import near_triangles, pair_layout
from spt_jax.overlap.triangles.determinants import (
    derivative,
    determinant,
    doubled_determinants,
    units,
)
from spt_jax.overlap.triangles.predicates import Predicates

_FINE = trimesh.creation.box().subdivide().subdivide()
_CAN = trimesh.creation.cylinder(1.0, 1.0, sections=24)


def _beside(mesh, place):
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.int64)
    return join((vertices, faces), (vertices + np.array(place), faces))


def _soup():
    """Triangles between places of a grid, which meet in every way there is."""
    rng = np.random.default_rng(0)
    places = rng.integers(-2, 3, (30, 3)).astype(float)
    return places, np.array([rng.permutation(30)[:3] for _ in range(40)])


CONTACT = {
    "a side in common": _beside(_FINE, (1.0, 0.0, 0.0)),
    "four sides in one plane": _beside(_FINE, (0.5, 0.0, 0.0)),
    "an edge": _beside(_FINE, (1.0, 1.0, 0.0)),
    "a corner": _beside(_FINE, (1.0, 1.0, 1.0)),
    "cans": _beside(_CAN, (0.0, 0.0, 1.0)),
    "lattice": join(*(box(center=place) for place in itertools.product((0.0, 1.0, 2.0), repeat=3))),
    "soup": _soup(),
}


def _told(mesh):
    """All that is told of a surface."""
    surface = ExactSurface(*mesh, 2.0**-52)
    overlap, crossings = ExactOverlap(surface), surface.intersections
    found = [crossings.edge, crossings.face, crossings.part, crossings.jump, surface.proper]
    found += [surface.contacts.vertex, surface.contacts.face, overlap.winding, overlap.gradient()]
    return found, overlap.volume


@pytest.mark.parametrize("name", CONTACT)
def test_ranks_find_what_places_find(name, monkeypatch, rng):
    """To the bit: crossings, contacts, labels and derivatives, whether boxes are ranks or not."""
    vertices, faces = CONTACT[name]
    monkeypatch.setattr(near_triangles, "_MANY", 1)
    for mesh in ((vertices, faces), (vertices @ random_rotation(rng).T, faces)):
        told = []
        for touching in (-1.0, 1.0):  # always by rank, and never
            monkeypatch.setattr(near_triangles, "_TOUCHING", touching)
            told.append(_told(mesh))
        (by_rank, volume), (by_place, same) = told
        assert volume == same
        for one, other in zip(by_rank, by_place, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", CONTACT)
def test_planes_through_common_corners_find_what_signs_find(name, monkeypatch, rng):
    """To the bit, of solids turned in float32: pairs that a plane keeps apart do not intersect."""
    vertices, faces = CONTACT[name]
    pair_layout._meshes.clear()  # which pairs come first depends on the shapes seen before
    monkeypatch.setattr(near_triangles, "_MANY", 1)
    mesh = (vertices @ random_rotation(rng).T).astype(np.float32).astype(np.float64), faces
    found, parted = _told(mesh), []
    own = near_triangles.apart

    def by_signs(predicates, first, second):
        parted.append(own(predicates, first, second))
        return np.zeros(first.shape[1], bool)

    monkeypatch.setattr(near_triangles, "apart", by_signs)
    told, volume = _told(mesh)
    assert found[1] == volume
    for one, other in zip(found[0], told, strict=True):
        np.testing.assert_array_equal(one, other)
    if name in ("a side in common", "four sides in one plane"):
        assert np.concatenate(parted).mean() > 0.5


def test_solids_that_touch_are_told_apart_before_any_sign_is_asked_for(monkeypatch):
    """The price of contact: pairs across the lattice's boxes are left to nobody."""
    asked = []
    own = near_triangles.NearTriangles._straddling

    def counted(self, t, u):
        asked.append(len(t))
        return own(self, t, u)

    monkeypatch.setattr(near_triangles.NearTriangles, "_straddling", counted)
    places = itertools.product((0.0, 1.0, 2.0, 3.0), repeat=3)
    vertices, faces = join(*(box(center=place) for place in places))
    surface = ExactSurface(vertices, faces, 2.0**-52)
    assert not len(surface.intersections.face)
    assert len(surface.contacts.vertex) > 1000
    assert 0 < sum(asked) < len(faces)


def test_ranks_follow_places_and_then_pushes():
    vertices, faces = CONTACT["a side in common"]
    signs = Predicates(vertices, faces, np.repeat([0, 1], len(vertices) // 2))
    for place, push, rank in zip(signs.points, signs.push, signs.ranks, strict=True):
        order = np.lexsort((push, place))
        assert (np.diff(rank[order]) >= 0).all()
        alike = (place[:, None] == place) & (push[:, None] == push)
        np.testing.assert_array_equal(rank[:, None] == rank, alike)


def _exact(columns):
    """The determinant in fractions."""
    rows = [[Fraction(float(x)) for x in column] for column in columns]
    if len(rows) == 2:
        return rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
    return sum(
        rows[0][i] * (rows[1][j] * rows[2][k] - rows[1][k] * rows[2][j])
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    )


@pytest.mark.parametrize("size", [2, 3])
def test_with_twice_the_digits_float32_is_exact(size, rng):
    """Also where the determinant is exactly zero, which no bound on rounding can decide."""
    points = rng.uniform(-1, 1, (size + 1, size, 200)).astype(np.float32).astype(np.float64)
    points[-1, :, ::2] = points[1, :, ::2] + points[2, :, ::2] - points[0, :, ::2]
    points[-1] = points[-1].astype(np.float32)
    unit = np.minimum.reduce([units(x) for x in points])
    for value in np.ldexp(points, -unit).ravel():
        assert value == int(value)
    value, known = doubled_determinants(list(points), unit)
    assert known.all() and (size == 2 or (value == 0).any())
    for k in range(200):
        columns = [points[i, :, k] for i in range(size + 1)]
        difference = [
            [Fraction(float(a)) - Fraction(float(b)) for a, b in zip(x, columns[0], strict=True)]
            for x in columns[1:]
        ]
        exact = _exact(difference)
        assert (value[k] > 0, value[k] < 0) == (exact > 0, exact < 0)


def test_what_has_too_many_digits_is_not_said_to_be_known():
    """A determinant below what twice the digits can resolve."""
    least = 2.0**-120
    points = [np.array([[x], [y], [z]]) for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0))]
    points.append(np.array([[1.0], [1.0], [least]]))
    unit = np.minimum.reduce([units(np.float64(x)) for x in points])
    assert unit[0] == -120
    steep = [np.float64(x) for x in points]
    steep[1] = steep[1] + np.array([[0.0], [0.0], [1.0]])
    steep[2] = steep[2] - np.array([[0.0], [0.0], [1.0]])
    value, known = doubled_determinants(steep, unit)
    assert not known[0] or value[0] > 0


@pytest.mark.parametrize("size", [2, 3])
def test_derivatives_of_determinants_are_those_of_fractions(size, rng):
    edges, turns = (list(rng.uniform(-1, 1, (size, size, 50)) * scale) for scale in (1.0, 2.0**40))
    value, bound = derivative(edges, turns)
    for k in range(50):
        exact = sum(
            _exact([(turns if i == moved else edges)[i][:, k] for i in range(size)])
            for moved in range(size)
        )
        assert abs(Fraction(float(value[k])) - exact) <= Fraction(float(bound[k]))
    still = [np.zeros((size, 50)) for _ in range(size)]
    assert not np.any(derivative(edges, still)[0])
    assert determinant(*edges).shape == (50,)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_unique_numbers(count, rng):
    numbers = rng.integers(0, 300, count)
    np.testing.assert_array_equal(unique(numbers), np.unique(numbers))
