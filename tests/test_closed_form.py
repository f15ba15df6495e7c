"""The closed form: exact on solids and bodies, smooth, and left to rays where it does not apply."""

import dataclasses

import numpy as np
import pytest
import trimesh
from helpers import (
    bent_tube,
    body_faces,
    boolean_overlap,
    box,
    inverted,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    signed_volume,
    sphere,
)
from helpers_exact import exact_overlap

from spt_jax.overlap.measure import measure
from spt_jax.overlap.triangles import closed_form
from spt_jax.overlap.triangles.sheets import find_sheets


def solved(mesh):
    """The measurement of a mesh whose overlaps all have a closed form."""
    found = measure(*mesh, sampling("auto"))
    assert found.closed_form.solved.all() and not found.beams
    return found


def by_rays(mesh, rays=512):
    return measure(*mesh, sampling(rays)).volume


def slope(mesh):
    return solved(mesh).gradient("boundary", "vertex")


def solid(rng, kind) -> tuple[np.ndarray, np.ndarray]:
    """A closed solid without a lattice: no corner of one lies on a face of another."""
    if kind == "ball":
        vertices, faces = sphere(0.6, subdivisions=2)
        vertices = vertices * rng.uniform(0.7, 1.3, 3)
    elif kind == "star":  # not convex: overlaps in several pieces
        vertices, faces = sphere(0.7, subdivisions=2)
        vertices = vertices * rng.uniform(0.4, 1.2, (len(vertices), 1))
    elif kind == "ring":
        ring = trimesh.creation.torus(0.6, 0.2, major_sections=24, minor_sections=10)
        vertices, faces = np.array(ring.vertices), np.array(ring.faces, np.int64)
    else:
        vertices, faces = box(rng.uniform(0.3, 1.5, 3))
    return moved((vertices, faces), random_rotation(rng), rng.uniform(-0.3, 0.3, 3))


KINDS = ["ball", "star", "ring", "box"]


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_equals_the_boolean_of_two_solids(first, second):
    rng = np.random.default_rng(KINDS.index(first) + 4 * KINDS.index(second))
    for _ in range(3):
        one, other = solid(rng, first), solid(rng, second)
        expected = boolean_overlap(one, other)
        assert expected > 1e-3
        assert solved(join(one, other)).volume == pytest.approx(expected, rel=1e-9)


def test_boxes_in_closed_form():
    """Axis-aligned, so that the rims are as degenerate as they come without contact."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        size, other = rng.uniform(0.5, 2, (2, 3))
        shift = rng.uniform(-1, 1, 3) * (size + other) / 2
        low, high = (
            np.maximum(-size / 2, shift - other / 2),
            np.minimum(size / 2, shift + other / 2),
        )
        assert solved(join(box(size), box(other, shift))).volume == pytest.approx(
            np.prod(high - low), rel=1e-12
        )


@pytest.mark.parametrize("kind", [*KINDS, "body"])
def test_gradient_equals_central_differences(kind):
    """To rounding: there is no lattice, so the volume is as smooth as the surface."""
    rng = np.random.default_rng(2)
    if kind == "body":
        vertices, faces = posed_bodies(["crawl/0092"])[0], body_faces()  # 12 cusps
        scale, step = 1e-4, 1e-3
    else:
        vertices, faces = join(solid(rng, kind), solid(rng, "ball"))
        scale, step = 1.0, 1e-5
    exact = slope((vertices, faces))
    for _ in range(3):
        velocity = scale * rng.normal(size=vertices.shape)
        ends = [solved((vertices + s * velocity, faces)).volume for s in (step, -step)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        size = np.abs(exact * velocity).sum()
        assert np.sum(exact * velocity) == pytest.approx(numeric, abs=2e-7 * size)


@pytest.mark.parametrize("frame", ["crawl/0092", "crawl/0167"])
def test_bodies_equal_exact_arithmetic(frame):
    """With creases, where triangles that share a vertex pass through each other."""
    mesh = posed_bodies([frame])[0], body_faces()
    volume, gradient = exact_overlap(mesh)
    found = solved(mesh)
    assert found.volume == pytest.approx(volume, rel=1e-11)
    np.testing.assert_allclose(
        found.gradient("boundary", "vertex"), gradient, atol=1e-7 * np.abs(gradient).max()
    )


PAIR = join(sphere(0.6, subdivisions=2), moved(box((0.5, 0.8, 1.0)), None, (0.31, 0.17, 0.33)))


def test_rigid_motion_and_scale():
    rng = np.random.default_rng(0)
    volume, pull = solved(PAIR).volume, slope(PAIR)
    for scale in (1e-3, 1.0, 250.0):
        turn = random_rotation(rng)
        mesh = moved(PAIR, turn, rng.normal(size=3) * scale, scale)
        assert solved(mesh).volume == pytest.approx(scale**3 * volume, rel=1e-11)
        expected = scale**2 * pull @ turn.T
        np.testing.assert_allclose(slope(mesh), expected, atol=1e-10 * scale**2)


def test_the_order_of_faces_corners_and_vertices_does_not_matter():
    rng = np.random.default_rng(1)
    vertices, faces = posed_bodies(["crawl/0092"])[0], body_faces()
    volume, pull = solved((vertices, faces)).volume, slope((vertices, faces))
    place = rng.permutation(len(vertices))
    mixed = place[rng.permutation(faces)]
    turns = rng.integers(0, 3, len(faces))[:, None]
    mixed = np.take_along_axis(mixed, (np.arange(3) + turns) % 3, axis=1)
    shuffled = np.empty_like(vertices)
    shuffled[place] = vertices
    assert solved((shuffled, mixed)).volume == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(slope((shuffled, mixed))[place], pull, atol=1e-15)


def test_pairs_apart_add_up():
    far = moved(PAIR, random_rotation(np.random.default_rng(2)), (4, 0, 0), 0.8)
    both = solved(join(PAIR, far))
    assert both.sheets.num_regions == 2
    parts = [solved(mesh).volume for mesh in (PAIR, far)]
    np.testing.assert_allclose(np.sort(both.closed_form.volume), np.sort(parts), rtol=1e-12)
    assert both.volume == pytest.approx(sum(parts), rel=1e-12)


def test_force_and_torque_are_in_balance():
    """The volume does not change when everything moves: what one part feels the other one feels
    the opposite way, and neither is zero."""
    vertices, _ = PAIR
    pull = slope(PAIR)
    first = np.arange(len(vertices)) < len(sphere(subdivisions=2)[0])
    turning = np.cross(vertices, pull)
    for force in (pull, turning):
        one, other = force[first].sum(0), force[~first].sum(0)
        assert np.linalg.norm(one) > 1e-4
        np.testing.assert_allclose(one, -other, atol=1e-13)


def test_nested_solids_and_inverted_shells():
    inner, outer = (
        moved(box((0.5, 0.6, 0.7)), random_rotation(np.random.default_rng(3))),
        box((2,) * 3),
    )
    inside, outside = signed_volume(*inner), signed_volume(*outer)
    assert solved(join(inner, outer)).volume == pytest.approx(inside, rel=1e-12)
    # A shell that faces inwards around nothing is a cavity where it lies in a solid, and counts
    # as inverted where it does not.
    assert solved(join(inverted(inner), outer)).volume == 0
    assert solved(inverted(inner)).volume == pytest.approx(inside, rel=1e-12)
    assert solved(join(inner, inverted(outer))).volume == pytest.approx(outside - inside, rel=1e-12)
    # Half in and half out of the solid: the inverted part that sticks out counts.
    across = moved(inverted(inner), None, (1.0, 0.1, 0.2))
    out = inside - boolean_overlap(inverted(across), outer)
    assert 0.1 * inside < out < 0.9 * inside
    assert solved(join(across, outer)).volume == pytest.approx(out, rel=1e-11)


def test_deeper_overlaps_go_to_rays():
    """Three solids in one place count twice; a double overlap elsewhere keeps its closed form."""
    three = [box((1, 1, 1), shift) for shift in ((0, 0, 0), (0.3, 0.1, 0.2), (0.1, 0.35, -0.15))]
    mesh = moved(
        join(*three, moved(PAIR, None, (5, 0, 0))), random_rotation(np.random.default_rng(4))
    )
    found = measure(*mesh, sampling("auto"))
    assert np.count_nonzero(found.closed_form.solved) == 1 and len(found.beams) == 3
    pairs = sum(boolean_overlap(three[i], three[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    low = np.max([m[0].min(0) for m in three], axis=0)
    high = np.min([m[0].max(0) for m in three], axis=0)
    shared = np.prod(high - low)
    # max(w - 1, 0): the union of the pairs once, and what all three share once more.
    expected = pairs - 2 * shared + shared + solved(PAIR).volume
    assert found.volume == pytest.approx(expected, rel=3e-3)


def _turned(mesh):
    return moved(mesh, random_rotation(np.random.default_rng(6)), (0.1, 0.2, 0.3))


BALL = sphere(subdivisions=2)
CONTACT = {
    "boxes that share a face": (join(box(), box(center=(0, 0, 1))), 0.0),
    "boxes that share a part of a face": (join(box(), box((0.5, 2, 1), (0.2, 0.1, 1))), 0.0),
    "boxes that share an edge": (join(box(), box(center=(0, 1, 1))), 0.0),
    "boxes that share a corner": (join(box(), box(center=(1, 1, 1))), 0.0),
    "an edge on a face": (
        join(box((4, 4, 1)), moved(box(), trimesh.transformations.rotation_matrix(
            np.pi / 4, (1, 0, 0))[:3, :3], (0, 0, 0.5 + np.sqrt(0.5)))), 0.0),
    "two spheres in one place": (join(BALL, BALL), signed_volume(*BALL)),
    "two boxes in one place": (join(box(), box()), 1.0),
    "a slab flush with a box": (join(box((2, 2, 2)), box((1, 2, 2), (-0.5, 0, 0))), 4.0),
    "a box in the corner of a box": (join(box((2, 2, 2)), box((1,) * 3, (0.5,) * 3)), 1.0),
    "boxes with common face planes": (join(box(), box((1, 1, 1), (0.5, 0, 0))), 0.5),
    "boxes with common planes across": (join(box(), box((3, 1, 0.5))), 0.5),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTACT)
def test_exact_contact_is_never_wrong(name):
    """Along the axes, where rounding is nil, and turned, where it decides."""
    mesh, expected = CONTACT[name]
    for placed in (mesh, _turned(mesh)):
        found = measure(*placed, sampling("auto"))
        assert found.volume == pytest.approx(expected, rel=3e-3)
        pull = found.gradient("boundary", "vertex")
        assert np.isfinite(pull).all() and (expected > 0 or not pull.any())


def test_coinciding_solids_are_seen_whole():
    """A box twice in one place: each sheet is as good a boundary as the other, and whichever is
    taken has all of its tiles cast. For this rotation 1.2 % were missed once."""
    rng = np.random.default_rng(4)
    outer = moved(box((3, 3, 4)), random_rotation(rng))
    inner = moved(box((0.5, 1, 0.5)), random_rotation(rng))
    found = measure(*join(outer, inner, outer), sampling("auto"))
    assert found.volume == pytest.approx(36 + 0.25, rel=1e-4)


def test_a_cavity_goes_the_way_of_the_overlap_around_it():
    """Three boxes in one place have no closed form, and the hole in two of them none either."""
    hole = inverted(box((0.2, 0.3, 0.25), (0.1, 0.05, 0.0)))
    outer = [box(), box((1.2, 1.1, 0.9), (0.15, 0.2, 0.3)), box((0.8, 0.7, 1.3), (-0.4, 0.1, 0.1))]
    mesh = _turned(join(*outer, hole))
    found = measure(*mesh, sampling("auto"))
    assert not found.closed_form.solved.any()
    assert found.volume == pytest.approx(by_rays(mesh, 700), rel=3e-3)
    assert solved(_turned(join(*outer[:2], hole))).volume == pytest.approx(
        boolean_overlap(*outer[:2]) - signed_volume(*inverted(hole)), rel=1e-12
    )


def test_regions_are_connected_overlaps():
    """Parts that meet in two places overlap in two regions; one crease of a body is one."""
    turn = trimesh.transformations.rotation_matrix(0.7, (0.01, 0.02, 1))[:3, :3]
    bar = moved((sphere(1.0)[0] * (1.5, 0.1, 0.1), sphere(1.0)[1]), turn, (0, 0, 0.01))
    yoke = bent_tube(-2.0, 0.3, 0.3, sides=16, steps=60)  # a "C" that the bar goes through twice
    found = solved(_turned(join(bar, yoke)))
    assert found.sheets.num_regions == 2
    assert found.volume == pytest.approx(boolean_overlap(bar, yoke), rel=1e-9)
    folded = solved((posed_bodies(["cartwheel/0151"])[0], body_faces()))
    assert folded.sheets.num_regions == 1 and len(folded.sheets.pairs) > 10


def test_open_meshes_go_to_rays():
    """A hole in the overlap cannot be solved; one elsewhere does not matter."""
    vertices, faces = _turned(PAIR)
    center = vertices[faces].mean(axis=1)
    overlapped = center[find_sheets(vertices, faces, np.eye(3)).faces].mean(axis=0)
    away = np.linalg.norm(center - overlapped, axis=1)
    cut = np.delete(faces, away.argmin(), axis=0)
    found = measure(vertices, cut, sampling("auto"))
    assert not found.closed_form.solved.all() and sum(p.open_rays for p in found.beams) > 0
    assert found.volume == pytest.approx(by_rays((vertices, cut)), rel=0.05)
    cut = np.delete(faces, away.argmax(), axis=0)
    assert solved((vertices, cut)).volume == pytest.approx(solved(PAIR).volume, rel=1e-10)


def test_convex_solids_apart_or_touching_are_exactly_free():
    rng = np.random.default_rng(7)
    for k in range(40):
        first = box(rng.integers(1, 4, 3) / 2)
        second = box(rng.integers(1, 4, 3) / 2)
        # Along one axis they touch or are apart; along the others anything goes.
        axis = rng.integers(3)
        shift = rng.integers(-3, 4, 3) / 2
        gap = rng.choice([0.0, 1e-4, 0.5])
        shift[axis] = 0
        second = moved(second, None, shift)
        second[0][:, axis] += first[0][:, axis].max() - second[0][:, axis].min() + gap
        mesh = join(first, second) if k % 2 else _turned(join(first, second))
        found = measure(*mesh, sampling("auto"))
        assert found.volume == 0 and not found.gradient("boundary", "vertex").any(), k


def test_a_region_that_does_not_close_is_refused():
    """If a segment went missing, the sums of constants would not vanish, and rays be cast."""
    mesh = _turned(PAIR)
    sheets = find_sheets(*mesh, np.eye(3))
    assert closed_form.solve(*mesh, sheets).solved.all()
    kept = np.arange(len(sheets.crossings.face)) != 3
    less = dataclasses.replace(
        sheets.crossings,
        **{
            name: array[kept]
            for name, array in vars(sheets.crossings).items()
            if len(array) == len(kept)
        },
    )
    broken = dataclasses.replace(sheets, crossings=less)
    assert not closed_form.solve(*mesh, broken).solved.any()


def test_three_slabs_that_meet_in_points_without_edges_go_to_rays():
    """Every edge of each slab lies outside the others, yet all three share a piece."""
    bounds = [
        ((-0.2, -1.1, -2), (0.2, 2.9, 2)),
        ((-2.2, -0.2, -1), (1.8, 0.2, 3)),
        ((-1.1, -2.1, -0.2), (2.9, 1.9, 0.2)),
    ]
    low, high = np.array(bounds).transpose(1, 0, 2)
    slabs = join(*(box(h - l, (h + l) / 2) for l, h in zip(low, high, strict=True)))  # noqa: E741
    found = measure(*slabs, sampling("auto"))
    assert not found.closed_form.solved.any()
    pairs = [(0, 1), (0, 2), (1, 2)]
    common = [np.minimum(high[i], high[j]) - np.maximum(low[i], low[j]) for i, j in pairs]
    triple = np.prod(high.min(axis=0) - low.max(axis=0))
    expected = sum(np.prod(size) for size in common) - triple  # what three cover counts twice
    assert found.volume == pytest.approx(expected, rel=2e-3)
