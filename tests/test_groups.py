"""Groups of faces: parts of a body, persons of a scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import box, embedded_body, lens_volume, sphere

from spt_jax import self_intersection_penalty
from spt_jax._groups import (
    between_groups,
    join_bodies,
    neighbor_pairs,
    part_groups,
    within_groups,
)


def test_parts_are_where_their_joints_are():
    body = embedded_body()
    groups = body.part_groups
    assert groups.shape == (len(body.faces),) and groups.dtype == np.int32
    weights, faces = np.asarray(body.weights), np.asarray(body.faces)
    for face in range(0, len(faces), 501):
        mean = weights[faces[face]].mean(axis=0)
        assert mean[groups[face]] == pytest.approx(mean.max())
    center = np.asarray(body.template)[faces].mean(axis=1)
    for name in ("head", "left_wrist", "right_wrist", "left_foot", "right_knee", "left_elbow"):
        joint = body.joint_names.index(name)
        mine = center[groups == joint]
        assert len(mine) > 50
        # Its own joint or a child's is the nearest to most of a part.
        nearest = np.linalg.norm(mine[:, None] - np.asarray(body.joint_template), axis=2).argmin(1)
        family = [joint] + [j for j, p in enumerate(body.parents) if p == joint]
        assert np.isin(nearest, family).mean() > 0.9


def test_ties_take_the_first_joint():
    weights = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5]])
    np.testing.assert_array_equal(part_groups(weights, np.array([[0, 1, 2]])), [0])


def test_neighbors_are_every_parent_and_child():
    body = embedded_body()
    pairs = body.neighbor_pairs
    assert len(pairs) == len(set(pairs)) == 52 + 51
    assert all(a == b or body.parents[b] == a for a, b in pairs)
    assert neighbor_pairs((-1,)) == ((0, 0),)


def test_pairs_split_into_within_and_between():
    for count in range(4):
        within, between = within_groups(count), between_groups(count)
        assert len(within) == count and not set(within) & set(between)
        assert set(within) | set(between) == {(a, b) for a in range(count) for b in range(a, count)}


def test_a_traced_body_says_what_to_do(untyped):
    body = embedded_body()
    with pytest.raises(TypeError, match=r"take body\.part_groups outside jit"):
        jax.jit(lambda b: jnp.asarray(b.part_groups))(body)


BALL, FACES = sphere(subdivisions=3)
CROWD = BALL + np.array([[0.0, 0, 0], [1, 0, 0], [9, 0, 0]])[:, None]


def test_a_scene_is_its_bodies_one_after_the_other(dtype):
    batch = jnp.asarray(np.stack([CROWD, 2 * CROWD]), dtype)
    scene = join_bodies(batch, FACES)
    assert scene.vertices.shape == (2, 3 * len(BALL), 3) and scene.vertices.dtype == dtype
    triangles = np.asarray(scene.vertices)[:, scene.faces]
    expected = np.asarray(batch)[:, :, FACES].reshape(triangles.shape)
    np.testing.assert_array_equal(triangles, expected)
    np.testing.assert_array_equal(scene.face_groups, np.repeat([0, 1, 2], len(FACES)))


def test_a_scene_is_traced_as_its_vertices_are(dtype):
    def loss(vertices, faces):
        scene = join_bodies(vertices, faces)
        assert isinstance(scene.face_groups, np.ndarray)  # a static option
        return self_intersection_penalty(scene.vertices, scene.faces, rays=128)

    crowd = jnp.asarray(CROWD, dtype)
    value, gradient = jax.value_and_grad(loss)(crowd, FACES)
    assert value == pytest.approx(lens_volume(1.0), rel=0.03)
    push = np.asarray(gradient).sum(axis=1)
    assert push[0, 0] > 1 and push[1, 0] < -1 and np.abs(push[2]).max() == 0
    traced = jax.jit(loss)(crowd, jnp.asarray(FACES))
    assert traced == pytest.approx(float(value), rel=1e-6)
    both = jax.vmap(loss, (0, None))(jnp.stack([crowd, crowd]), jnp.asarray(FACES))
    np.testing.assert_allclose(both, value, rtol=1e-6)


def test_indices_that_fit_one_body_only():
    vertices, faces = box()
    scene = join_bodies(np.tile(vertices.astype("f4"), (40, 1, 1)), faces.astype(np.int8))
    assert scene.faces.max() == 40 * 8 - 1 and scene.faces.min() == 0


def test_scenes_of_none_and_one():
    vertices, faces = box()
    one = join_bodies(vertices[None].astype("f4"), faces)
    np.testing.assert_array_equal(one.faces, faces)
    none = join_bodies(np.zeros((0, 8, 3), "f4"), faces)
    assert none.vertices.shape == none.faces.shape == (0, 3) and none.face_groups.shape == (0,)


def test_a_single_body_without_its_axis_is_named(untyped):
    with pytest.raises(ValueError, match=r"\(\.\.\., N, V, 3\) for N bodies: got \(8, 3\)"):
        join_bodies(box()[0].astype("f4"), FACES[:0])
