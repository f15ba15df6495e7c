"""Shapes that only fold are told without their contours, as measuring them tells."""

import functools

import numpy as np
import pytest
from helpers import body_faces, box, embedded_body, inverted, join, posed_bodies

from spt_jax.overlap import host_functions
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.folds import only_folds
from spt_jax.overlap.measure import Sampling, measure
from spt_jax.rest.surface import RestSurface

ROUNDING = float(np.finfo(np.float32).eps)
EXACT = Sampling(None, ((0.0, 0.0, 1.0),))


@functools.cache
def bodies():
    """Frames some of which only fold."""
    shapes = np.asarray(posed_bodies(range(0, 1080, 180)), np.float64)
    return shapes, body_faces().astype(np.int64), Exclusions(rest=embedded_body().rest_surface)


def volume(vertices, faces, exclusions):
    return measure(vertices, faces, EXACT, exclusions, ROUNDING).volume


@pytest.mark.parametrize("outwards", [0.0, 0.002])
def test_value_and_gradient_are_the_same_whether_folds_were_asked_for(outwards, monkeypatch):
    shapes, faces, exclusions = bodies()
    options = host_functions.PenaltyOptions(
        "volume", "boundary", "vertex", EXACT, exclusions, ROUNDING, outwards
    )

    def found(shape):
        return host_functions.measured(shape, faces, options, with_gradient=True)

    told, real = [], host_functions.only_folds
    monkeypatch.setattr(
        host_functions, "only_folds", lambda *a, **k: told.append(real(*a, **k)) or told[-1]
    )
    rows = np.random.default_rng(0).permutation(2 * len(shapes)) % len(shapes)
    asked = [found(shapes[k]) for k in rows]
    monkeypatch.setattr(host_functions, "only_folds", lambda *_, **__: False)
    plain = [found(shape) for shape in shapes]
    for k, (value, gradient, _) in zip(rows, asked, strict=True):
        assert value.tobytes() == plain[k][0].tobytes()
        assert np.array_equal(gradient, plain[k][1])
    assert any(told) and not all(value == 0 for value, *_ in plain)
    if not outwards:
        calm = [only_folds(shape, faces, exclusions, surely=True) for shape in shapes]
        assert calm == [value == 0 for value, *_ in plain]


def test_sets_that_are_told_to_be_near_are_near():
    rest, size = embedded_body().rest_surface.copies(2), len(body_faces())
    start = np.random.default_rng(0).integers(0, 2 * size - 8, 60)
    sets = start[:, None] + np.arange(8)
    found = rest.near_sets(sets, np.ones(sets.shape, bool))
    assert found is not None
    a, b = (x.ravel() for x in np.indices((60, 60)))
    near = found.near(a, b)
    assert 0.01 < near.mean() < 0.5
    for one, other in zip(a[near][::7], b[near][::7], strict=True):
        f, g = (x.ravel() for x in np.meshgrid(sets[one], sets[other]))
        assert rest.near(f, g, exact=True).all()
    f, g = np.random.default_rng(1).integers(0, 2 * size, (2, 4000))
    g[:2000] = (f[:2000] + g[:2000] % 100) % (2 * size)
    alone = found.near_faces(f, g)
    assert 0.01 < alone.mean() < 0.9
    assert rest.near(f[alone], g[alone], exact=True).all()
    assert np.array_equal(found.tabulated().near(a, b), near)
    fours = near.reshape(15, 4, 15, 4).all(axis=(1, 3))
    a, b = (x.ravel() for x in np.indices((15, 15)))
    assert (fours.ravel() | ~found.joined(4).near(a, b)).all()


def test_what_counts_without_a_contour_is_no_fold():
    small = box((0.2, 0.2, 0.2))
    one, faces = join(box(), (small[0] + [3.0, 0.0, 0.0], small[1]))
    within = one - np.repeat([[0.0] * 3, [3.0, 0.0, 0.0]], 8, axis=0)
    exclusions = Exclusions(rest=RestSurface(one, faces, 0.1))
    assert only_folds(one, faces, exclusions, surely=True)
    assert volume(one, faces, exclusions) == 0
    assert not only_folds(within, faces, exclusions, surely=True)
    assert np.isclose(volume(within, faces, exclusions), 0.008)
    turned = inverted(box())
    exclusions = Exclusions(rest=RestSurface(*turned, 0.1))
    assert not only_folds(*turned, exclusions, surely=True)
    assert np.isclose(volume(*turned, exclusions), 1.0)


def test_nothing_is_told_of_other_faces_or_where_nothing_is_near():
    shape, faces = box()
    for rest in (RestSurface(shape, faces[::-1], 0.5), RestSurface(shape, faces, 0.0)):
        assert not only_folds(shape, faces, Exclusions(rest=rest), surely=True)
    assert only_folds(shape, faces, Exclusions(rest=RestSurface(shape, faces, 0.5)), surely=True)
