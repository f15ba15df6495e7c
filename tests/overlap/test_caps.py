"""Open meshes: holes closed by fans, whose motion is the mesh's; sheets, which have no inside."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import body_faces, box, embedded_body, join, sphere
from helpers_collisions import HANDS, both_hands, posed_by

from spt_jax import RestSurface, check_mesh, intersection_report, self_intersection_penalty
from spt_jax.overlap.caps import LARGEST, holes_of
from spt_jax.overlap.exclusions import NOTHING, Exclusions
from spt_jax.overlap.measure import Sampling, Unmeasurable, measure
from spt_jax.overlap.triangles.manifold import manifold_of

EXACT = Sampling(None, ((0.0, 0.0, -1.0),))


def solved(vertices, faces, exclusions=NOTHING):
    return measure(np.asarray(vertices, np.float64), np.asarray(faces), EXACT, exclusions)


def tube(radius=0.5, height=2.0, sections=64):
    """A prism without its ends, and its volume: a torso as a scanner leaves it."""
    made = trimesh.creation.cylinder(radius, height, sections=sections)
    side = np.abs(made.triangles_center[:, 2]) < 0.4 * height
    area = 0.5 * sections * radius**2 * np.sin(2 * np.pi / sections)
    return np.array(made.vertices), made.faces[side], area * height


@functools.cache
def on_left_hand():
    """Which faces of the embedded body are its left hand's, cut at the wrist as MANO's is."""
    body = embedded_body()
    names = body.joint_names
    wrist = names.index("left_wrist")
    kept = [k for k, n in enumerate(names) if k == wrist or (n.startswith("left_") and k >= 22)]
    return np.isin(body.part_groups, kept)


def head():
    """An egg that ends at the neck, with a mouth whose lips are curved: FLAME's holes."""
    vertices, faces = sphere(subdivisions=4)
    middle = vertices[faces].mean(axis=1)
    mouth = (middle[:, 2] > 0) & (middle[:, 0] ** 2 + (2.5 * middle[:, 1]) ** 2 < 0.25)
    neck = middle[:, 1] < -0.85
    return vertices * [1.0, 1.3, 1.1], faces[~mouth & ~neck]


@pytest.mark.parametrize("name", ["fist through the palm", "thumb through the index"])
def test_an_open_hand_is_measured_as_on_the_body(name):
    """Which ends at the wrist, and overlaps nothing there."""
    (rows,) = (library[name] for library in HANDS.values() if name in library)
    vertices = posed_by(both_hands(rows))
    own = on_left_hand()
    allowed = embedded_body().rest_surface.distances
    rest = RestSurface(embedded_body().template, body_faces()[own], allowed[own])
    alone = solved(vertices, body_faces()[own], Exclusions(rest=rest))
    whole = solved(vertices, body_faces(), Exclusions(rest=embedded_body().rest_surface)).overlap
    judged = whole.judged
    here = np.zeros(len(judged.volume), bool)
    here[judged.region[own[judged.layer.shares.faces]]] = True
    expected = judged.volume[here] @ judged.share[here] / whole.surface.scale**3
    assert alone.volume == pytest.approx(expected, rel=1e-9) and expected > 1e-6
    (hole,) = alone.holes
    assert 10 < hole.edges < 60 and hole.size < 0.15


def test_a_torso_is_as_solid_as_if_its_ends_were_there():
    vertices, faces, volume = tube()
    assert intersection_report(vertices, faces).solid_volume == pytest.approx(volume, rel=1e-12)
    # A rod through both ends: all of it that is between them lies within.
    rod = box((0.2, 0.3, 5.0), (0.1, 0.05, 0.3))
    pair = join((vertices, faces), rod)
    found = solved(*pair)
    assert found.volume == pytest.approx(0.2 * 0.3 * 2.0, rel=1e-12)
    assert not found.total_intersecting_pairs and not intersection_report(*pair).is_free
    for rays in (Sampling(256, tuple(map(tuple, np.eye(3)))),):
        seen = measure(*pair, rays)
        assert seen.volume == pytest.approx(found.volume, rel=0.02)
        pull = seen.gradient("boundary", "vertex")
        exact = found.gradient("boundary", "vertex")
        assert np.linalg.norm(pull - exact) < 0.15 * np.linalg.norm(exact)


def test_the_gradient_is_exact_through_fans(rng):
    """Of a head pierced at mouth and neck, against differences."""
    vertices, faces = head()
    rod = trimesh.creation.cylinder(0.12, 4.0, sections=12)
    rod.apply_transform(trimesh.transformations.rotation_matrix(1.1, (1, 0.2, 0.1)))
    vertices, faces = join((vertices, faces), (np.add(rod.vertices, [0.0, 0.02, 0.2]), rod.faces))
    found = solved(vertices, faces)
    assert len(found.holes) == 2 and found.volume > 0.05
    pull, step = found.gradient("boundary", "vertex"), 1e-5
    for _ in range(3):
        motion = rng.normal(size=vertices.shape)
        ends = [solved(vertices + side * step * motion, faces).volume for side in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        assert np.sum(pull * motion) == pytest.approx(slope, rel=1e-6)


def test_a_fan_that_meets_the_lips_is_a_fold():
    """The mean of a curved loop lies off the surface: what it cuts beside the hole is none."""
    vertices, faces = head()
    # Lips that are drawn over the hole, now above its plane and now below.
    x, y, z = vertices.T
    ring = np.hypot(x, 2.5 * y)
    (hole,) = (h for h in manifold_of(faces, len(vertices)).loops if vertices[h, 2].min() > 0)
    lip = (z > 0) & (ring < 0.75) & ~np.isin(np.arange(len(x)), hole)
    vertices[lip, :2] *= 0.5
    vertices[lip, 2] = z[hole].mean() + 0.1 * np.cos(6 * np.arctan2(y[lip], x[lip]))
    found = solved(vertices, faces)
    plain = found.surface.layers(None)
    assert len(plain[0].contours.pair)  # it does meet the fan
    fans = (found.surface.manifold.kept[plain[0].contours.pair] < 0).any(axis=1)
    folds = found.overlap.pair_weights[fans] == 0
    assert fans.any() and folds.all()


def test_a_tongue_through_the_mouth_counts():
    """What comes from farther away than the hole is wide, as a fist that is put into it."""
    vertices, faces = tube(0.5, 6.0)[:2]
    top = vertices[:, 2] > 0
    vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, 0.35)[:2]
    # Bent round so that one end looks into the other, whose rim it enters.
    angle = vertices[:, 2] / 6.0 * 2 * np.pi * 0.985
    reach = 1.2 + vertices[:, 0] * (1 - 0.5 * (vertices[:, 2] + 3) / 6)
    around = np.stack(
        [
            reach * np.cos(angle),
            vertices[:, 1] * (1 - 0.5 * (vertices[:, 2] + 3) / 6),
            reach * np.sin(angle),
        ],
        axis=1,
    )
    closer = solved(around, faces)
    angle = angle * 1.12
    around[:, 0], around[:, 2] = reach * np.cos(angle), reach * np.sin(angle)
    entered = solved(around, faces)
    assert top.any() and closer.volume == 0 and entered.volume > 0.01


def test_sheets_are_refused_with_a_reason(dtype):
    sheet = trimesh.creation.box((1, 1, 1))
    vertices = np.asarray(sheet.vertices, dtype)
    flat = sheet.faces[np.abs(sheet.triangles_center[:, 2] - 0.5) < 1e-9]
    with pytest.raises(Unmeasurable, match=r"a loop of 4 edges and length 4, around 1.27 of its"):
        intersection_report(vertices, flat)
    assert np.isnan(self_intersection_penalty(jnp.asarray(vertices), flat))
    assert np.isnan(self_intersection_penalty(jnp.asarray(vertices), flat, rays=16))
    assert not check_mesh(vertices, flat).ok
    both = np.concatenate([flat, flat + 8])
    with pytest.raises(Unmeasurable, match="2 parts are open sheets"):
        intersection_report(np.concatenate([vertices, vertices + 3]), both)


def test_the_size_of_a_hole_is_that_of_its_shape(rng):
    """Of a hemisphere 1/2, of any flat sheet 1 or more; turned, scaled or bent, the same."""
    arc = np.linspace(0, np.pi / 2, 33)
    bowl = trimesh.creation.revolve(np.column_stack([np.cos(arc), np.sin(arc)]), sections=64)
    vertices, half = np.array(bowl.vertices), bowl.faces
    (hole,) = holes_of(manifold_of(half, len(vertices)), vertices)
    assert hole.size == pytest.approx(0.5, abs=0.01) and hole.size < LARGEST
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    (again,) = holes_of(manifold_of(half, len(vertices)), 7 * vertices @ turn.T)
    assert again.size == pytest.approx(hole.size, rel=1e-12) and again.edges == hole.edges
    grid = trimesh.creation.box((2, 1, 0)).subdivide().subdivide()
    one = grid.faces[grid.face_normals[:, 2] > 0.5]
    sizes = []
    for bend in (1e-9, 1.0, 2.0):  # rolled to a part of a cylinder
        x, y = grid.vertices[:, 0], grid.vertices[:, 1]
        rolled = np.stack([np.sin(bend * x) / bend, y, np.cos(bend * x) / bend], axis=1)
        sizes.append(holes_of(manifold_of(one, len(rolled)), rolled)[0].size)
    assert min(sizes) > 1 and np.ptp(sizes) < 0.05
