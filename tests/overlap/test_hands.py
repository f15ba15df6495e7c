"""Thresholds by place: fingers collide with fingers, palm and thumb; bent fingers are folds."""

import functools

import numpy as np
import pytest
from helpers import body_faces, embedded_body
from helpers_collisions import (
    HANDS,
    body_exclusions,
    both_hands,
    intersecting_pairs,
    overlap_of,
    posed_by,
    rest_distances,
)

from spt_jax import RestSurface
from spt_jax.body.fold_distances import BODY_DISTANCE, fold_distances

# Of the rest surface: what intersects farther apart than this is no crease, and no crease of the
# library reaches so far; the girth of the embedded body's fingers is 6 to 8 cm.
THICKNESS = 0.05


@functools.cache
def posed_hands(name):
    (rows,) = (library[name] for library in HANDS.values() if name in library)
    return posed_by(both_hands(rows))


def intersecting_hands(vertices):
    """ipctk's pairs among the triangles of hands, as the body's; nothing else is posed."""
    body = embedded_body()
    moving = [
        joint
        for joint, name in enumerate(body.joint_names)
        if joint >= 22 or name.endswith(("wrist", "elbow"))
    ]
    own = np.flatnonzero(np.isin(body.part_groups, moving))
    return own[intersecting_pairs(vertices, body_faces()[own])]


@pytest.mark.parametrize("name", HANDS["free"])
def test_hands_that_do_not_collide(name):
    """Creases and contact are none, whatever the volume of the creases."""
    vertices = posed_hands(name)
    pairs = intersecting_hands(vertices)
    assert (rest_distances(pairs, 2 * THICKNESS) < THICKNESS).all()
    found = overlap_of(vertices)
    assert found.sound and found.volume == 0 and found.intersecting_pairs == 0
    assert not found.winding.any() and not found.gradient().any()


@pytest.mark.parametrize("name", HANDS["colliding"])
def test_hands_that_collide(name):
    """Both do, at the triangles that ipctk finds."""
    vertices = posed_hands(name)
    pairs = intersecting_hands(vertices)
    far = {tuple(pair) for pair in pairs[rest_distances(pairs, 2 * THICKNESS) > THICKNESS].tolist()}
    found = overlap_of(vertices)
    assert found.sound and found.volume > 1e-7
    counted = {tuple(pair) for pair in found.surface.pairs[found.pair_weights > 0].tolist()}
    assert far and far <= counted
    side = np.array([vertices[body_faces()[f, 0], 0] > 0 for f, _ in far])
    assert side.any() and not side.all()
    assert found.gradient().any() and found.winding.any()


def test_one_distance_for_all_leaves_hands_out():
    """0.3 m everywhere makes one fold of a hand: what thresholds by place are for."""
    vertices = posed_hands("fist through the palm")
    rest = embedded_body().rest_surface.within(BODY_DISTANCE)
    assert overlap_of(vertices, exclusions=body_exclusions()._replace(rest=rest)).volume == 0


def test_the_library_is_large_enough():
    assert len(HANDS["free"]) >= 15 and len(HANDS["colliding"]) >= 15
    assert embedded_body().rest_surface.near(np.array([0]), np.array([0])).all()


def distances_by_joint(body):
    groups, distance = body.part_groups, body.rest_surface.distances
    return {
        name: distance[groups == joint]
        for joint, name in enumerate(body.joint_names)
        if (groups == joint).any()
    }


def test_trunk_and_limbs_have_the_distance_of_a_body():
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    for name, distance in distances_by_joint(embedded_body()).items():
        if any(finger in name for finger in fingers):
            assert 0.03 < distance.min() <= distance.max() <= 0.0501, name
        else:
            assert (distance == BODY_DISTANCE).all(), name


def hand_alone():
    """The left hand's faces, their vertices, and the joints that move them, cut at the wrist."""
    body = embedded_body()
    names = body.joint_names
    kept = [j for j, name in enumerate(names) if name.startswith("left_") and j >= 22]
    kept = [names.index("left_wrist"), *kept]
    faces = body_faces()[np.isin(body.part_groups, kept)]
    used, faces = np.unique(faces, return_inverse=True)
    weights = np.asarray(body.weights)[np.ix_(used, kept)]
    joints = np.asarray(body.joint_template, np.float64)[kept]
    parents = [kept.index(body.parents[j]) if j != kept[0] else -1 for j in kept]
    vertices = np.asarray(body.template, np.float64)[used]
    return vertices, faces.reshape(-1, 3), weights, joints, parents


def test_a_hand_without_a_body_has_the_same_distances():
    hand = hand_alone()
    alone = fold_distances(*hand)
    groups = hand[2][hand[1]].sum(axis=1).argmax(axis=1)
    by_joint = distances_by_joint(embedded_body())
    names = [name for name in embedded_body().joint_names[22:] if name.startswith("left_")]
    for joint, name in enumerate(["left_wrist", *names]):
        assert np.allclose(alone[groups == joint], by_joint[name][0], rtol=0.02), name


def test_distances_grow_with_the_body():
    vertices, faces, weights, joints, parents = hand_alone()
    once = fold_distances(vertices, faces, weights, joints, parents)
    twice = fold_distances(2 * vertices, faces, weights, 2 * joints, parents, 2 * BODY_DISTANCE)
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-12)


def test_a_pair_goes_by_the_smaller_of_its_distances():
    """A finger against the palm by the finger's, though the palm's own is the body's."""
    rest = embedded_body().rest_surface
    groups, names = embedded_body().part_groups, embedded_body().joint_names
    palm = np.flatnonzero(groups == names.index("left_wrist"))
    tip = np.flatnonzero(groups == names.index("left_index3"))
    f, g = (x.ravel() for x in np.meshgrid(palm[::7], tip[::7]))
    assert rest.distances[f].min() == BODY_DISTANCE and not rest.near(f, g, exact=True).any()
    wide = RestSurface(embedded_body().template, body_faces(), BODY_DISTANCE)
    assert wide.near(f, g, exact=True).all()
