"""The closed form: exact on solids and bodies at any depth and in contact, and smooth."""

import dataclasses
import itertools

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

from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.measure import measure
from spt_jax.overlap.surface import regions_of
from spt_jax.overlap.triangles.closed_form import shares_of


def solved(mesh):
    """The measurement of a mesh, which is always exact."""
    found = measure(*mesh, sampling(None))
    assert found.exact and not found.beams
    return found


def by_pairs(*solids):
    """What every two of some solids share, by manifold3d, added up."""
    return sum(boolean_overlap(a, b) for a, b in itertools.combinations(solids, 2))


def num_regions(found):
    (layer,) = found.surface.layers(NOTHING)
    return regions_of(found.surface, layer)[1]


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
    elif kind == "can":  # flat ends of many triangles
        can = trimesh.creation.cylinder(0.4, 1.2, sections=16)
        vertices, faces = np.array(can.vertices), np.array(can.faces, np.int64)
    else:
        vertices, faces = box(rng.uniform(0.3, 1.5, 3))
    return moved((vertices, faces), random_rotation(rng), rng.uniform(-0.3, 0.3, 3))


KINDS = ["ball", "star", "ring", "box", "can"]


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
    "a plate stacked on a plate": (join(box((1, 1, 0.2)), box((1, 1, 0.2), (0, 0, 0.2))), 0.0),
    "boxes with common planes across": (join(box(), box((3, 1, 0.5))), 0.5),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTACT)
def test_exact_contact_is_never_wrong(name):
    """Along the axes, where rounding is nil, and turned, where it decides."""
    mesh, expected = CONTACT[name]
    for placed in (mesh, _turned(mesh)):
        found = solved(placed)
        assert found.volume == pytest.approx(expected, rel=1e-12)
        pull = found.gradient("boundary", "vertex")
        assert np.isfinite(pull).all() and (expected > 0 or not pull.any())


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
        found = measure(*mesh, sampling(None))
        assert found.volume == 0 and not found.gradient("boundary", "vertex").any(), k


def test_pairs_apart_add_up():
    far = moved(PAIR, random_rotation(np.random.default_rng(2)), (4, 0, 0), 0.8)
    both = solved(join(PAIR, far))
    assert num_regions(both) == 2
    assert both.volume == pytest.approx(sum(solved(m).volume for m in (PAIR, far)), rel=1e-12)


def test_regions_are_connected_overlaps():
    """Parts that meet in two places overlap in two regions; one crease of a body is one."""
    turn = trimesh.transformations.rotation_matrix(0.7, (0.01, 0.02, 1))[:3, :3]
    bar = moved((sphere(1.0)[0] * (1.5, 0.1, 0.1), sphere(1.0)[1]), turn, (0, 0, 0.01))
    yoke = bent_tube(-2.0, 0.3, 0.3, sides=16, steps=60)  # a "C" that the bar goes through twice
    found = solved(_turned(join(bar, yoke)))
    assert num_regions(found) == 2
    assert found.volume == pytest.approx(boolean_overlap(bar, yoke), rel=1e-9)
    folded = solved((posed_bodies(["cartwheel/0151"])[0], body_faces()))
    assert num_regions(folded) == 1 and folded.total_intersecting_pairs > 10


@pytest.mark.parametrize("seed", range(30))
def test_every_pair_of_three_and_four_solids_counts_once(seed):
    rng = np.random.default_rng(seed)
    solids = [solid(rng, KINDS[rng.integers(len(KINDS))]) for _ in range(3 + seed % 2)]
    mesh = join(*solids)
    expected = by_pairs(*solids)
    assert solved(mesh).volume == pytest.approx(expected, rel=1e-9) and expected > 0
    motion = rng.normal(size=mesh[0].shape)
    step = 1e-6
    ends = [solved((mesh[0] + side * step * motion, mesh[1])).volume for side in (1, -1)]
    pull = slope(mesh)
    size = np.abs(pull * motion).sum()
    assert np.sum(pull * motion) == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-6 * size)


def test_shells_in_each_other_count_by_pairs():
    """k nested solids have k (k - 1) / 2 pairs, inside out or not they add the other's volume."""
    sizes = np.array([0.5, 0.7, 0.9, 1.1, 1.3])
    balls = [sphere(size, subdivisions=1) for size in sizes]
    whole = np.array([signed_volume(*ball) for ball in balls])
    assert solved(_turned(join(*balls))).volume == pytest.approx(
        sum(whole[k] * (len(sizes) - 1 - k) for k in range(len(sizes))), rel=1e-12
    )
    # Inside out, w is -1 in one, -2 in two: w (w - 1) / 2 is 1, 3.
    inside_out = join(*map(inverted, balls[:2]))
    assert solved(_turned(inside_out)).volume == pytest.approx(whole[1] + 2 * whole[0], rel=1e-12)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("count", [2, 3, 80])
def test_copies_in_one_place(count, turned):
    """Every two of them share the whole; and all feel the same force."""
    mesh = join(*[BALL] * count)
    mesh = _turned(mesh) if turned else mesh
    found = solved(mesh)
    pairs = count * (count - 1) / 2
    assert found.volume == pytest.approx(pairs * signed_volume(*BALL), rel=1e-12)
    pull = found.gradient("boundary", "vertex").reshape(count, -1, 3)
    np.testing.assert_array_equal(pull, np.broadcast_to(pull[0], pull.shape))
    # Growing all of them grows each pair's volume, which is homogeneous of degree three.
    center = mesh[0].mean(axis=0)
    growth = np.sum(pull.reshape(-1, 3) * (mesh[0] - center))
    assert growth == pytest.approx(3 * found.volume, rel=1e-10)


@pytest.mark.parametrize(
    ("upright", "turned_over"), [(1, 1), (2, 1), (3, 1), (1, 2), (0, 2), (2, 2)]
)
@pytest.mark.parametrize("other", [None, box((0.3, 2, 0.3), (0.1, 0, 0.2))])
def test_copies_inside_out_take_one_away(upright, turned_over, other):
    """In a ball that is there a times, and b times inside out, w is a - b; a place is a kink."""
    balls = [BALL] * upright + [inverted(BALL)] * turned_over
    mesh = _turned(join(*balls, *([] if other is None else [other])))
    found, net = solved(mesh), upright - turned_over
    expected = net * (net - 1) / 2 * signed_volume(*BALL)
    if other is not None:  # one more in both
        expected += net * boolean_overlap(BALL, other)
    assert found.exact and found.volume == pytest.approx(expected, rel=1e-9, abs=1e-12)
    pull, size = found.gradient("boundary", "vertex"), np.abs(mesh[0]).max()
    assert np.abs(pull.sum(axis=0)).max() < 1e-12 * size**2
    growth = np.sum(pull * (mesh[0] - mesh[0].mean(axis=0)))
    assert growth == pytest.approx(3 * found.volume, rel=1e-9, abs=1e-12)
    assert (found.volume != 0) == pull.any()


def test_what_copies_share_stays_where_they_touch_another():
    mesh = _turned(join(box(), box(), box(center=(1, 0, 0))))
    found = solved(mesh)
    assert found.volume == pytest.approx(1, rel=1e-12)
    pull = found.gradient("boundary", "vertex")
    assert np.sum(pull * mesh[0]) == pytest.approx(3, rel=1e-12)
    assert not pull[16:].any()


def test_copies_among_others_and_listed_in_another_order():
    """A copy counts for every pair it is in, also where its faces come in another order."""
    rng = np.random.default_rng(4)
    outer, inner = box((3, 3, 4)), box((0.5, 1, 0.5))
    across = box((1, 1, 1), (1.5, 0.2, 0.1))
    for again in (outer, (outer[0], outer[1][rng.permutation(len(outer[1]))])):
        mesh = _turned(join(outer, inner, again, across))
        expected = 36 + 2 * 0.25 + 2 * 0.5
        assert solved(mesh).volume == pytest.approx(expected, rel=1e-12)


def test_lattices_of_boxes_that_touch_are_free():
    places = np.stack(np.meshgrid(*[np.arange(10.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    for mesh in (lattice := join(*(box(center=place) for place in places)), _turned(lattice)):
        found = solved(mesh)
        assert found.volume == 0 and found.total_intersecting_pairs == 0
        assert not found.gradient("boundary", "vertex").any()
        assert not found.labels("vertex").any()


def test_lattices_of_boxes_that_overlap_flush():
    places = 0.1 * np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)
    mesh = join(*(box(center=place) for place in places))
    shared = [np.prod(1 - np.abs(a - b)) for a, b in itertools.combinations(places, 2)]
    for placed in (mesh, _turned(mesh)):
        assert solved(placed).volume == pytest.approx(sum(shared), rel=1e-12)


FLAT = {
    "48": trimesh.creation.box().subdivide(),
    "300": trimesh.creation.box().subdivide().subdivide(),
    "1,200": trimesh.creation.box().subdivide().subdivide().subdivide(),
    "annulus": trimesh.creation.annulus(0.5, 1.0, 0.3, sections=16),
}


@pytest.mark.parametrize("name", FLAT)
def test_flat_sides_of_clean_solids_intersect_nowhere(name):
    """Turned at random: coplanar triangles that lie apart were said to cross once."""
    rng = np.random.default_rng(0)
    mesh = np.array(FLAT[name].vertices), np.array(FLAT[name].faces, np.int64)
    for _ in range(40):
        found = solved(moved(mesh, random_rotation(rng), rng.normal(size=3)))
        assert not len(found.surface.intersections.face)
        assert found.volume == 0 and not found.labels("vertex").any()


def _summed_otherwise(vertices, rotation, order):
    """Turned with the products added in another order, as another processor may do."""
    i, j, k = order
    x = vertices.T
    return np.stack([(row[i] * x[i] + row[j] * x[j]) + row[k] * x[k] for row in rotation], axis=1)


LAW_P = {
    **{name: CONTACT[name][0] for name in CONTACT},
    "a torus through a torus": join(
        *(
            (np.array(ring.vertices) + shift, np.array(ring.faces, np.int64))
            for shift in ((0, 0, 0), (0.6, 0, 0.05))
            for ring in [trimesh.creation.torus(0.6, 0.2, major_sections=24, minor_sections=10)]
        )
    ),
    "cans on a lid": join(
        box((4, 4, 1)),
        *(
            moved((np.array(can.vertices), np.array(can.faces, np.int64)), None, (x, 0, 1.1))
            for x in (-1, 1)
            for can in [trimesh.creation.cylinder(0.4, 1.2, sections=16)]
        ),
    ),
    "a ball on a plane": join(box((4, 4, 1)), moved(BALL, None, (0, 0, 0.5 - BALL[0][:, 2].min()))),
}


@pytest.mark.parametrize("name", LAW_P)
def test_one_unit_in_the_last_place_changes_nothing(name):
    """Nor does the order in which a rotation is summed up, or that of faces and vertices."""
    rng = np.random.default_rng(1)
    vertices, faces = LAW_P[name]
    turn = random_rotation(rng)
    expected = solved(moved((vertices, faces), turn)).volume
    order = rng.permutation(len(vertices))
    variants = [_summed_otherwise(vertices, turn, o) for o in itertools.permutations(range(3))]
    meshes = [(v, faces) for v in variants]
    meshes += [(v[order], np.argsort(order)[rng.permutation(faces)]) for v in variants]
    for _ in range(20):
        toward = rng.choice([-np.inf, 0.0, np.inf], size=vertices.shape)
        start = variants[0]
        meshes.append((np.where(toward == 0, start, np.nextafter(start, toward)), faces))
    for mesh in meshes:
        found = solved(mesh)
        assert found.volume == pytest.approx(expected, rel=1e-12, abs=0)
        if expected == 0:
            assert not found.gradient("boundary", "vertex").any()
            assert found.total_intersecting_pairs == 0 and not found.labels("vertex").any()


def test_slabs_that_meet_in_points_without_edges():
    """Every edge of each slab lies outside the others, yet all three share a piece."""
    bounds = [
        ((-0.2, -1.1, -2), (0.2, 2.9, 2)),
        ((-2.2, -0.2, -1), (1.8, 0.2, 3)),
        ((-1.1, -2.1, -0.2), (2.9, 1.9, 0.2)),
    ]
    low, high = np.array(bounds).transpose(1, 0, 2)
    slabs = [box(h - l, (h + l) / 2) for l, h in zip(low, high, strict=True)]  # noqa: E741
    pairs = [(0, 1), (0, 2), (1, 2)]
    common = [np.minimum(high[i], high[j]) - np.maximum(low[i], low[j]) for i, j in pairs]
    expected = sum(np.prod(size) for size in common)
    assert solved(join(*slabs)).volume == pytest.approx(expected, rel=1e-12)


def test_cavities_in_deep_overlaps():
    hole = inverted(box((0.2, 0.3, 0.25), (0.1, 0.05, 0.0)))
    outer = [box(), box((1.2, 1.1, 0.9), (0.15, 0.2, 0.3)), box((0.8, 0.7, 1.3), (-0.4, 0.1, 0.1))]
    inside = [
        np.prod(np.minimum(hole[0].max(0), b[0].max(0)) - np.maximum(hole[0].min(0), b[0].min(0)))
        for b in outer
    ]
    # Of a hole in k solids each pair with a solid goes; the hole's own w is -1, and (-1)(-2)/2 = 1.
    own = -signed_volume(*hole)
    expected = by_pairs(*outer) - sum(inside) + own
    assert solved(_turned(join(*outer, hole))).volume == pytest.approx(expected, rel=1e-12)


def test_holes_are_closed_by_fans():
    """A flat hole is closed as it was; its rim's vertices share what the fan's center feels."""
    vertices, faces = _turned(join(box((2, 2, 2)), box((1, 1, 1), (0.1, 0.2, 0.9))))
    top = np.flatnonzero(np.abs(box((2, 2, 2))[0][box((2, 2, 2))[1]][:, :, 2] - 1).max(axis=1) == 0)
    assert len(top) == 2
    cut = np.delete(faces, top, axis=0)
    whole, closed = solved((vertices, faces)), solved((vertices, cut))
    assert len(closed.surface.manifold.loops) == 1
    assert closed.volume == pytest.approx(whole.volume, rel=1e-12)
    rng = np.random.default_rng(0)
    motion, step = rng.normal(size=vertices.shape), 1e-6
    ends = [solved((vertices + side * step * motion, cut)).volume for side in (1, -1)]
    pull = slope((vertices, cut))
    assert np.sum(pull * motion) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


def test_solids_that_share_an_edge_by_both_ends():
    """Merged at an edge of theirs, two sheets cross along it: one counted as four triangles'."""
    one, other = (
        box(),
        moved(box(), trimesh.transformations.rotation_matrix(0.6, (0, 0, 1))[:3, :3]),
    )
    other = moved(other, None, one[0][0] - other[0][0])  # turned about the edge of corners 0 and 1
    vertices, faces = _turned(join(one, other))
    expected = solved((vertices, faces)).volume
    assert expected > 0.05
    merged = np.where(faces == 8, 0, np.where(faces == 9, 1, faces))
    assert solved((vertices, merged)).volume == pytest.approx(expected, rel=1e-12)
    # Hanging together elsewhere too, they have one sheet at both of its ends.
    row = np.arange(len(merged))
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(row)
        found = solved((vertices, merged[order]))
        assert found.volume == pytest.approx(expected, rel=1e-12)


def test_sums_that_do_not_close_are_noticed():
    """If a crossing went missing the sums of constants would not vanish, and rays be cast."""
    found = solved(_turned(PAIR))
    surface = found.surface
    (layer,) = surface.layers(NOTHING)

    def shares(crossings):
        return shares_of(
            surface.points, surface.topology, crossings, surface.contours, layer.ends, 0
        )

    assert shares(surface.intersections).sound.all()
    jump = surface.intersections.jump.copy()
    jump[3] = 0
    assert not shares(dataclasses.replace(surface.intersections, jump=jump)).sound.all()


def test_what_does_not_close_is_measured_by_rays(monkeypatch):
    mesh = _turned(PAIR)
    volume, pull = solved(mesh).volume, slope(mesh)
    found = measure(*mesh, sampling(None))
    monkeypatch.setattr(type(found.overlap), "sound", False)
    assert not found.exact and len(found.beams) == 3
    assert found.volume == pytest.approx(volume, rel=1e-3)
    np.testing.assert_allclose(found.gradient("boundary", "vertex"), pull, atol=2e-3)
