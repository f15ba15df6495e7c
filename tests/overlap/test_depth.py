"""Overlaps of any depth by rays: every pair of solids counts once, whatever lies over what.

Without `overlap.measure`: beams, intervals and the boundary integral alone.
"""

import itertools

import numpy as np
import pytest
from helpers import (
    boolean_overlap,
    box,
    inverted,
    join,
    lens_volume,
    moved,
    random_rotation,
    signed_volume,
    sphere,
    winding_number,
)
from helpers_depth import DEEP, as_mesh, by_rays, from_pairs, one_beam, overlap, pushes

from spt_jax.overlap.arrays.vectors import area_normals
from spt_jax.overlap.rays.beam import orthogonal_directions

DIRECTIONS = orthogonal_directions(3)


@pytest.mark.parametrize("name", DEEP)
def test_boxes_by_arithmetic(name, rng):
    """The volume, and how it changes as each box moves."""
    parts = DEEP[name]
    rotation = random_rotation(rng)
    volume, gradient = by_rays(moved(as_mesh(parts), rotation), 256, DIRECTIONS)
    scale = sum(np.prod(part.extents) for part in parts)
    assert volume == pytest.approx(overlap(parts), rel=1e-4, abs=1e-12 * scale)
    found = gradient.reshape(len(parts), 8, 3).sum(axis=1) @ rotation
    np.testing.assert_allclose(found, pushes(parts), rtol=0, atol=1e-3 * scale)
    np.testing.assert_allclose(gradient.sum(axis=0), 0, atol=1e-3 * scale)  # no net force


def test_the_arithmetic():
    """The oracle itself, where the answer is known without it."""
    sizes = {name: [np.prod(part.extents) for part in DEEP[name]] for name in DEEP}
    assert overlap(DEEP["box in a box"]) == pytest.approx(sizes["nest"][2])
    assert overlap(DEEP["nest"]) == pytest.approx(sizes["nest"][1] + 2 * sizes["nest"][2])
    # w is -1, -2 and -3 from the outermost in, which count 1, 3 and 6 times.
    assert overlap(DEEP["inverted nest"]) == pytest.approx(np.dot([1, 2, 3], sizes["nest"]))
    assert overlap(DEEP["inverted nest in a box"]) == pytest.approx(sizes["nest"][2])
    assert overlap(DEEP["box in a cavity"]) == pytest.approx(0.0)
    assert not pushes(DEEP["nest"]).any()


def test_copies_of_one_sphere():
    """Of n spheres that are nearly one, n (n - 1) / 2 pairs; inside out, n (n + 1) / 2."""
    one = sphere(subdivisions=3)
    whole = signed_volume(*one)
    for count in (1, 2, 3, 4, 5):
        copies = [moved(one, translation=(1e-4 * k, 2e-4 * k, -1e-4 * k)) for k in range(count)]
        found, _ = by_rays(join(*copies), 128, DIRECTIONS)
        assert found == pytest.approx(count * (count - 1) / 2 * whole, rel=3e-3, abs=1e-12)
        found, _ = by_rays(join(*map(inverted, copies)), 128, DIRECTIONS)
        assert found == pytest.approx(count * (count + 1) / 2 * whole, rel=3e-3)


def test_spheres():
    """One within another counts its volume once; in a row, each lens once."""
    small = sphere(0.4, (0.2, 0.1, 0.05), subdivisions=3)
    found, _ = by_rays(join(sphere(), small), 256, DIRECTIONS)
    assert found == pytest.approx(signed_volume(*small), rel=3e-3)
    row = [sphere(center=(0.5 * k, 0.02 * k, 0.01 * k), subdivisions=5) for k in range(4)]
    expected = sum(
        lens_volume(0.5 * np.hypot(1, np.hypot(0.04, 0.02)) * (j - i))
        for i, j in itertools.combinations(range(4), 2)
    )
    assert by_rays(join(*row), 256, DIRECTIONS)[0] == pytest.approx(expected, rel=5e-3)


def solids(seed):
    """Three to five solids over one another, turned and shifted, some of them inside out."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(rng.integers(3, 6)):
        extents = rng.uniform(0.6, 1.4, 3)
        solid = box(extents) if rng.random() < 0.5 else sphere(extents[0] / 2, subdivisions=2)
        solid = moved(solid, random_rotation(rng), rng.uniform(-0.3, 0.3, 3))
        found.append(inverted(solid) if k and rng.random() < 0.3 else solid)
    return found


@pytest.mark.parametrize("seed", range(8))
def test_splits_into_pairs(seed):
    """On the same rays, so to rounding: volume and gradient, in one direction and in three."""
    parts = solids(seed)
    mesh, sizes = join(*parts), [len(part[1]) for part in parts]
    for directions in (DIRECTIONS[:1], DIRECTIONS):

        def both(mesh, directions=directions):
            volume, gradient = by_rays(mesh, 64, directions)
            return np.append(volume, gradient)

        whole = both(mesh)
        assert np.abs(whole[1:]).max() > 0.01
        expected = from_pairs(both, mesh, sizes)
        np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-12 * np.abs(whole).max())


@pytest.mark.parametrize("seed", range(4))
def test_random_solids_against_booleans(seed):
    """Three to five solids, against the volumes that manifold3d finds pair by pair."""
    parts = [(v, f if signed_volume(v, f) > 0 else f[:, ::-1]) for v, f in solids(seed)]
    expected = sum(boolean_overlap(i, j) for i, j in itertools.combinations(parts, 2))
    assert expected > 0.1
    found, _ = by_rays(join(*parts), 256, DIRECTIONS)
    assert found == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("name", ["four boxes", "inverted nest", "inverted box half in a box"])
def test_one_direction_is_the_derivative_of_its_volume(name, rng):
    """Along random motions of all vertices, which change few rays' triangles in so small a step."""
    vertices, faces = moved(as_mesh(DEEP[name]), random_rotation(rng))
    direction, step = rng.normal(size=3), 1e-7
    beam, _, _ = one_beam((vertices, faces), direction, 200)

    def volume(vertices):
        there, _, found = one_beam((vertices, faces), direction, 200)
        np.testing.assert_array_equal(there.pixel, beam.pixel)  # or the rays would change
        return found.size * there.ray_area

    _, gradient = by_rays((vertices, faces), 200, [direction])
    for _ in range(4):
        change = rng.normal(size=vertices.shape)
        ends = [volume(vertices + side * step * change) for side in (-1, 1)]
        exact = np.sum(gradient * change)
        assert (ends[1] - ends[0]) / (2 * step) == pytest.approx(exact, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_outer_is_the_winding_number_outside_both_ends(seed, rng):
    """Against libigl's exact one, just outside the surface at each end of each interval."""
    mesh = join(*solids(seed))
    vertices, faces = mesh
    _, _, found = one_beam(mesh, rng.normal(size=3), 40)
    assert len(found.ray) > 200 and len(np.unique(found.outer)) >= 2
    corners = faces[found.ends.ravel()]
    normal = area_normals(vertices, corners)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = np.einsum("kc,kcx->kx", found.barycentric.reshape(-1, 3), vertices[corners])
    outside = winding_number(mesh, point + 1e-9 * normal)
    inside = winding_number(mesh, point - 1e-9 * normal)
    told = np.abs(inside - outside - 1) < 1e-3  # all but those where another sheet is as near
    assert told.mean() > 0.99
    np.testing.assert_array_equal(np.rint(outside)[told], np.repeat(found.outer, 2)[told])


def test_no_overlap_has_no_size():
    beam, _, found = one_beam(sphere(subdivisions=2), (0.0, 0.0, -1.0), 32)
    assert found.size == 0.0 and beam.ray_area > 0
