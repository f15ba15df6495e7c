"""The laws of a collision's volume, folds left out: L1 to L6, and what is enclosed at rest."""

import functools

import jax.numpy as jnp
import manifold3d
import numpy as np
import pytest
import trimesh
from helpers import (
    body_faces,
    boolean_overlap,
    box,
    embedded_body,
    inverted,
    join,
    mocap,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    signed_volume,
    sphere,
)
from helpers_collisions import (
    body_exclusions,
    intersecting_pairs,
    overlap_of,
    posed_by,
    rest_distances,
    with_joints,
)
from helpers_depth import DEEP, as_mesh

from spt_jax import RestSurface
from spt_jax._exclusions import as_exclusions
from spt_jax.overlap.measure import measure

# Folds alone, collisions alone, and both in one region.
FOLDED, MIXED = ("run/0005", "crawl/0092"), ("spinkick/0058", "crawl/0012", "roll/0056")
ARMS = {
    "left_shoulder": (0, -1.4, 0),
    "right_shoulder": (0, 1.4, 0),
    "left_elbow": (0, -1.2, 0),
    "right_elbow": (0.1, 1.2, 0),
}


@functools.cache
def body_in(name):
    return posed_bodies([name])[0]


@functools.cache
def crossed_arms():
    return posed_by(with_joints(ARMS))


def shares_of_contours(overlap):
    """Of each region that the contour judges, the share of its length that is far."""
    return overlap.judged.share


# L1


@pytest.mark.parametrize("name", MIXED)
def test_turning_and_scaling_change_nothing(name, rng):
    vertices = body_in(name)
    volume = overlap_of(vertices).volume
    assert volume > 1e-7
    for scale in (1.0, 0.37, 1e3):
        turned, _ = moved((vertices, None), random_rotation(rng), rng.normal(size=3), scale)
        assert overlap_of(turned).volume == pytest.approx(scale**3 * volume, rel=1e-9)


def test_the_order_of_faces_and_vertices_changes_nothing(rng):
    vertices, faces, body = body_in("spinkick/0058"), body_faces(), embedded_body()
    found = overlap_of(vertices)
    order, corner = rng.permutation(len(faces)), rng.integers(0, 3, len(faces))
    place = rng.permutation(len(vertices))  # of each vertex
    turned = np.take_along_axis(faces, (corner[:, None] + np.arange(3)) % 3, axis=1)
    shuffled = place[turned[order]]
    rest, posed = (np.empty(vertices.shape) for _ in range(2))
    rest[place], posed[place] = np.asarray(body.template, np.float64), vertices
    surface = RestSurface(rest, shuffled, body.rest_surface.distances[order])
    other = overlap_of(posed, shuffled, as_exclusions(None, (), surface, shuffled))
    assert other.volume == pytest.approx(found.volume, rel=1e-9)
    assert other.intersecting_pairs == found.intersecting_pairs
    gradient = found.gradient()
    np.testing.assert_allclose(
        other.gradient()[place], gradient, rtol=0, atol=1e-9 * np.abs(gradient).max()
    )


# L2


@pytest.mark.parametrize("name", FOLDED + MIXED)
def test_no_rays_are_cast(name):
    found = measure(body_in(name), body_faces(), sampling(None), body_exclusions())
    assert found.exact and found.beams == []
    assert found.volumes == [found.volume] * 3
    assert found.total_volume >= found.volume


# L3


@pytest.mark.parametrize("name", FOLDED + MIXED + ("walk/0010", "punch/0013", "cartwheel/0103"))
def test_zero_without_far_intersections(name):
    """Exactly, and positive with one: ipctk's pairs, and paths and thresholds by place."""
    vertices, allowed = body_in(name), embedded_body().rest_surface.distances
    pairs = intersecting_pairs(vertices, body_faces())
    far = rest_distances(pairs, 2 * allowed.max()) > allowed[pairs].min(axis=1)
    found = overlap_of(vertices)
    counted = found.surface.pairs[(found.pair_weights > 0) & (found.surface.contours.cusp < 0)]
    assert set(map(tuple, counted.tolist())) == set(map(tuple, pairs[far].tolist()))
    assert (found.volume > 0) == far.any() == bool(found.winding.any())
    assert found.volume == 0 or found.gradient().any()


def test_what_is_enclosed_without_intersecting_counts():
    """Unless it was so at rest: a ball in a ball, and a ball that went in."""
    apart = join(sphere(subdivisions=2), sphere(0.3, (3.0, 0.1, 0.2), 2))
    inside = join(sphere(subdivisions=2), sphere(0.3, (0.1, 0.1, 0.2), 2))
    small = signed_volume(*sphere(0.3, subdivisions=2))
    for rest, expected in ((apart, small), (inside, 0.0)):
        surface = RestSurface(*rest, distance=100.0)
        exclusions = as_exclusions(None, (), surface, rest[1])
        found = overlap_of(*inside, exclusions)
        assert found.volume == pytest.approx(expected, rel=1e-12, abs=0)
        assert found.winding.any() == (expected > 0)


def test_what_is_inside_out_has_no_contour_and_counts():
    ball = inverted(sphere(subdivisions=2))
    surface = RestSurface(*ball, distance=100.0)
    found = overlap_of(*ball, as_exclusions(None, (), surface, ball[1]))
    assert found.volume == pytest.approx(-signed_volume(*ball), rel=1e-12)


# L4


def arm(side):
    """The faces of a forearm and a hand, and the fan that closes them at the elbow."""
    body = embedded_body()
    names = [f"{side}_elbow", f"{side}_wrist"]
    names += [n for n in body.joint_names[22:] if n.startswith(side)]
    own = np.isin(body.part_groups, [body.joint_names.index(n) for n in names])
    mesh = trimesh.Trimesh(np.asarray(body.template), body_faces()[own], process=False)
    pieces = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(own.sum()))
    faces = body_faces()[own][max(pieces, key=len)]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    back = {(b, a) for a, b in edges.tolist()}
    rim = [(a, b) for a, b in edges.tolist() if (a, b) not in back]
    return faces, np.array(rim)


def capped(vertices, side):
    faces, rim = arm(side)
    center = vertices[np.unique(rim)].mean(axis=0)
    cap = np.stack([rim[:, 1], rim[:, 0], np.full(len(rim), len(vertices))], axis=1)
    used, faces = np.unique(np.concatenate([faces, cap]), return_inverse=True)
    return np.concatenate([vertices, center[None]])[used], faces.reshape(-1, 3)


def test_the_whole_volume_where_only_far_parts_meet():
    """Two forearms in each other, against a boolean of the two, cut off and closed."""
    vertices = crossed_arms()
    found = overlap_of(vertices)
    assert (shares_of_contours(found) == 1).all()
    expected = boolean_overlap(capped(vertices, "left"), capped(vertices, "right"))
    assert expected > 1e-4
    assert found.volume == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", MIXED)
def test_regions_count_whole_or_in_part_or_not(name):
    """By their contours: as much of each as is far, and the rest is what is left out."""
    found = overlap_of(body_in(name))
    volumes, shares = found.judged.volume, found.judged.share
    scale = found.surface.scale**3
    assert (volumes > -1e-12 * scale).all() and ((shares >= 0) & (shares <= 1)).all()
    assert found.volume == pytest.approx(float(volumes @ shares) / scale, rel=1e-12)
    whole = measure(body_in(name), body_faces(), sampling(None)).volume
    assert volumes.sum() / scale == pytest.approx(whole, rel=1e-9)
    assert 0 < found.volume < whole


# L5

PATHS = {
    "spinkick/0058": "spinkick/0040",
    "roll/0052": "roll/0040",
    "punch/0013": "punch/0020",
}


@pytest.mark.parametrize("start", PATHS)
def test_continuous_along_a_straight_motion(start):
    """Steps of half a millimetre; benchmarks/folds.py takes 200 of them on more motions."""
    names, body = list(mocap().names), embedded_body()
    p, q = (
        np.asarray(body.pose_from_smpl(mocap().pose[names.index(name)]), np.float64)
        for name in (start, PATHS[start])
    )
    speed = np.linalg.norm(posed_by(p + 0.01 * (q - p)) - posed_by(p), axis=1).mean() / 0.01
    volume = [overlap_of(posed_by(p + k * 0.0005 / speed * (q - p))).volume for k in range(25)]
    steps = np.abs(np.diff(volume))
    assert np.median(steps) > 1e-9
    assert steps.max() < 10 * np.median(steps)


# L6


def slope_error(vertices, rng, step=1e-7):
    """The largest error of the slope, of what single vertices add to it, in two motions."""
    gradient = overlap_of(vertices).gradient()
    errors = []
    for _ in range(2):
        velocity = np.sin(vertices @ rng.normal(size=(3, 3)) * 5 + rng.normal(size=3))
        ends = [overlap_of(vertices + s * velocity).volume for s in (step, -step)]
        numeric = (ends[0] - ends[1]) / (2 * step)
        errors.append(
            abs(numeric - np.sum(gradient * velocity)) / np.abs(gradient * velocity).sum()
        )
    return max(errors)


def test_gradient_where_regions_are_pure(rng):
    vertices = crossed_arms()
    assert (shares_of_contours(overlap_of(vertices)) == 1).all()
    assert slope_error(vertices, rng) < 1e-6


@pytest.mark.parametrize("name", MIXED)
def test_gradient_where_regions_are_mixed(name, rng):
    """With the derivative of the share itself: held fixed, slopes are far off."""
    vertices = body_in(name)
    shares = shares_of_contours(overlap_of(vertices))
    assert ((shares > 0) & (shares < 1)).any()
    assert slope_error(vertices, rng) < 1e-3


def test_the_gradient_neither_pushes_nor_turns_the_body():
    """And stretching it changes the volume three times as fast as the size (Euler)."""
    for name in MIXED:
        vertices = body_in(name)
        found = overlap_of(vertices)
        gradient = found.gradient()
        size = np.abs(gradient).sum()
        assert np.abs(gradient.sum(axis=0)).max() < 1e-9 * size
        assert np.abs(np.cross(vertices, gradient).sum(axis=0)).max() < 1e-9 * size
        assert np.sum(vertices * gradient) == pytest.approx(3 * found.volume, rel=1e-6)


# Groups

BALLS = [sphere(0.8, c, 2) for c in ((0, 0, 0), (0.3, 0.1, 0), (0.1, 0.5, 0.1), (0.2, 0.2, 0.6))]


def groups_cases():
    for name, parts in DEEP.items():
        yield name, as_mesh(parts), np.repeat(np.arange(len(parts)), 12)
    turned = [moved(b, random_rotation(np.random.default_rng(k))) for k, b in enumerate(BALLS)]
    yield "four balls", join(*turned), np.repeat(np.arange(4), len(BALLS[0][1]))


GROUPS = {name: (mesh, part) for name, mesh, part in groups_cases()}


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.parametrize("pairing", ["each", "two and two", "one and the rest"])
def test_within_and_between_groups_are_the_whole(name, pairing, rng):
    """At any depth, where groups are made of closed solids."""
    mesh, part = GROUPS[name]
    mesh = moved(mesh, random_rotation(rng))
    group = {"each": part, "two and two": part % 2, "one and the rest": np.minimum(part, 1)}[
        pairing
    ]
    names = np.unique(group).tolist()
    within = tuple((g, g) for g in names)
    between = tuple((g, h) for g in names for h in names if g < h)
    whole = overlap_of(*mesh, as_exclusions(None, (), None, mesh[1]))
    found = [
        overlap_of(*mesh, as_exclusions(group, ignored, None, mesh[1]))
        for ignored in (within, between)
    ]
    # Where something is inside out, one of the two would be negative, and is said to be 0.
    if not any(sense in name for sense in ("inverted", "cavity")):
        total = sum(x.volume for x in found)
        assert total == pytest.approx(whole.volume, rel=1e-12)
    gradient = whole.gradient()
    both = sum(x.gradient() for x in found)
    np.testing.assert_allclose(both, gradient, rtol=0, atol=1e-12 * np.abs(gradient).sum())


def test_groups_of_balls_by_booleans():
    """Between two groups of two, the four overlaps of one from each."""
    mesh, part = GROUPS["four balls"]
    balls = [(mesh[0].reshape(4, -1, 3)[k], BALLS[0][1]) for k in range(4)]
    exclusions = as_exclusions(part // 2, ((0, 0), (1, 1)), None, mesh[1])
    expected = sum(boolean_overlap(balls[i], balls[j]) for i in (0, 1) for j in (2, 3))
    assert overlap_of(*mesh, exclusions).volume == pytest.approx(expected, rel=1e-9)


# Enclosed at rest


@functools.cache
def with_eyes():
    """The embedded body at rest and two spheres in its head, as SMPL-X has them."""
    body = embedded_body()
    head = body.joint_names.index("head")
    vertices, faces = np.asarray(body.template, np.float64), body_faces()
    front = vertices[np.asarray(body.weights).argmax(axis=1) == head, 2].max()
    height = float(body.joint_template[head, 1]) + 0.06
    eyes = [sphere(0.012, (x, height, front - 0.035), 3) for x in (0.03, -0.03)]
    return join((vertices, faces), *eyes)


def posed_with_eyes(pose):
    """The eyes move with what the head alone moves, which is rigid."""
    rest, _ = with_eyes()
    body = embedded_body()
    head = body.joint_names.index("head")
    vertices = posed_by(pose)
    rigid = np.asarray(body.weights)[:, head] == 1
    still = np.asarray(body.template, np.float64)[rigid]
    center, to = still.mean(axis=0), vertices[rigid].mean(axis=0)
    u, _, vt = np.linalg.svd((still - center).T @ (vertices[rigid] - to))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.concatenate([vertices, (rest[len(vertices) :] - center) @ turn + to])


@pytest.mark.parametrize("name", [None, "run/0005", "spinkick/0058", "crawl/0012"])
def test_eyeballs_do_not_collide_with_the_head(name):
    rest, faces = with_eyes()
    body = embedded_body()
    allowed = np.append(body.rest_surface.distances, np.full(len(faces) - len(body_faces()), 0.3))
    surface = RestSurface(rest, faces, allowed)
    exclusions = as_exclusions(None, (), surface, faces)
    pose = np.zeros((body.num_joints, 3), np.float32)
    if name is not None:
        pose = np.asarray(body.pose_from_smpl(mocap().pose[list(mocap().names).index(name)]))
    vertices = posed_with_eyes(pose)
    eyes = overlap_of(vertices, faces, as_exclusions(None, (), None, faces)).volume
    alone = overlap_of(vertices[: len(body.template)])
    assert eyes > 1e-5
    found = overlap_of(vertices, faces, exclusions)
    assert found.volume == pytest.approx(alone.volume, rel=1e-9, abs=0)
    assert not found.winding[len(body.template) :].any()


def test_an_eyeball_in_another_head_collides():
    """Of two people in one place: what lies in each other at rest is each one's own matter."""
    rest = join(box(), box((0.2, 0.2, 0.2), (0.05, 0.02, 0.01)))
    surface, shift = RestSurface(*rest, distance=10.0), (0.31, 0.22, 0.13)
    assert overlap_of(*rest, as_exclusions(None, (), surface, rest[1])).volume == 0
    scene = join(rest, moved(rest, translation=shift))
    found = overlap_of(*scene, as_exclusions(None, (), surface.copies(2), scene[1]))
    heads = 0.69 * 0.78 * 0.87
    assert found.volume == pytest.approx(between(rest, shift), rel=1e-12) and found.volume > heads


def between(solids, shift):
    """The overlaps of axis-parallel boxes with the same ones shifted, by arithmetic."""
    corners = solids[0].reshape(2, 8, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    common = np.minimum(high[:, None], high + shift) - np.maximum(low[:, None], low + shift)
    return float(np.prod(np.maximum(common, 0.0), axis=2).sum())


# Heavy and slight bodies


@pytest.mark.parametrize("component", range(10))
def test_arms_pressed_into_the_trunk_count_on_every_body(component):
    """Though arms and trunk of the heaviest touch nearly at rest, and the slightest have room."""
    body = embedded_body()
    pose = with_joints({"left_shoulder": (0, 0, -1.6), "right_shoulder": (0, 0, 1.6)})
    groups = body.part_groups
    arms = [body.joint_names.index(f"{side}_{n}") for side in ("left", "right") for n in ("elbow",)]
    for amount in (3.0, -3.0):
        shape = np.zeros(body.num_shape, np.float32)
        shape[component] = amount
        vertices = np.asarray(body(jnp.asarray(pose), jnp.asarray(shape)).vertices, np.float64)
        found = overlap_of(vertices)
        assert found.volume > 1e-4
        counted = groups[found.surface.pairs[found.pair_weights > 0]]
        assert np.isin(counted, arms).any(axis=1).sum() > 20


def test_manifold3d_takes_the_arms():
    """The oracle itself: the capped arms are solids."""
    for side in ("left", "right"):
        vertices, faces = capped(crossed_arms(), side)
        mesh = manifold3d.Mesh64(vert_properties=vertices, tri_verts=faces.astype(np.uint64))
        solid = manifold3d.Manifold(mesh)
        assert solid.status() == manifold3d.Error.NoError
        assert solid.volume() == pytest.approx(signed_volume(vertices, faces), rel=1e-12)
