"""V_0, V_out and V_in: Algorithm 1's triangle rule, and both rules as users call them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    body_faces,
    box,
    cast_rays,
    inverted,
    join,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
    winding_number,
)

from spt_jax import VertexLabels, classify_vertices
from spt_jax.overlap.labels import triangle_labels
from spt_jax.overlap.measure import measure
from spt_jax.overlap.rays.levels import Overlaps


def labels(mesh, rays=256, directions=3):
    return measure(*mesh, sampling(rays, directions)).labels("triangle")


def algorithm_1(mesh, direction, rays):
    """The paper's listing, line by line: sets of vertices, counters up to depth two."""
    _, _, found = cast_rays(mesh, direction, rays)
    clear, out, inside = set(), set(), set()
    for ray in np.unique(found.ray):
        counter = 0
        for k in np.flatnonzero(found.ray == ray):
            facing = found.sign[k] > 0
            counter += 1 if facing else -1
            corners = map(int, mesh[1][found.face[k]])
            if facing:
                target = {1: clear, 2: out, 0: inside}.get(counter)
            else:
                target = {0: clear, 1: out, -1: inside}.get(counter)
            if target is not None:
                target.update(corners)
    return clear, out, inside


@pytest.mark.parametrize("direction", [(0, 0, -1), (0.3, 1.0, 0.2)])
def test_equals_the_paper_s_listing(direction, rng):
    mesh = join(
        moved(sphere(subdivisions=2), random_rotation(rng)),
        moved(box((1, 1.5, 0.7)), random_rotation(rng), (0.9, 0.2, 0)),
        inverted(moved(sphere(0.4, subdivisions=1), translation=(3, 0, 0))),
    )
    clear, out, inside = algorithm_1(mesh, direction, 40)
    label = labels(mesh, 40, [direction])
    assert set(np.flatnonzero(label == 1)) == out
    assert set(np.flatnonzero(label == -1)) == inside - out
    assert len(out) > 10 and len(inside) > 10 and clear & out  # triangles do disagree


def test_precedence_is_out_then_in_then_clear():
    faces = np.array([[0, 1, 2], [2, 3, 4], [4, 5, 6], [7, 8, 9]])

    def overlaps(face, outer):
        ends = np.stack([face, face], axis=1)
        count = len(ends)
        nothing = np.zeros((count, 2, 3)), np.array(outer), np.zeros(count)
        return Overlaps(np.arange(count), ends, np.full((count, 2), -1), *nothing)

    # 2 is a corner of an out and of an in triangle, 4 of an in and of a clear one; nothing
    # reaches 7, 8 and 9.
    expected = [1, 1, 1, -1, -1, 0, 0, 0, 0, 0]
    together = overlaps([0, 1, 2, 0], [1, -1, 0, 0])
    np.testing.assert_array_equal(triangle_labels(faces, [together], 10), expected)
    apart = [overlaps([1, 2], [-1, 0]), overlaps([0, 0], [0, 1])]  # two beams
    np.testing.assert_array_equal(triangle_labels(faces, apart, 10), expected)
    np.testing.assert_array_equal(triangle_labels(faces[::-1].copy(), [], 10), 0)


def test_depth_and_orientation():
    nested = join(*(sphere(r, subdivisions=2) for r in (1.0, 0.8, 0.6, 0.4)))
    count = len(nested[0]) // 4
    expected = np.repeat([0, 1, 1, 1], count)  # any depth is V_out
    np.testing.assert_array_equal(labels(nested), expected)
    deep = join(*(inverted(sphere(r, subdivisions=2)) for r in (1.0, 0.8)))
    np.testing.assert_array_equal(labels(deep), -1)  # w = -1 and -2
    cavity = join(sphere(subdivisions=2), inverted(sphere(0.5, subdivisions=2)))
    np.testing.assert_array_equal(labels(cavity), 0)


def test_body_against_the_exact_winding_number():
    """Vertices well inside another part are V_out, vertices far from any are V_0.

    The triangle rule is not exact at the rim of an overlap (the paper says so): there, every
    corner of a triangle that is partly immersed is V_out.
    """
    (vertices,) = posed_bodies(["getup_facedown/0132"])
    faces = body_faces()
    label = labels((vertices, faces), 512)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    vertex_normal = np.zeros(vertices.shape)
    np.add.at(vertex_normal, faces.ravel(), np.repeat(normal, 3, axis=0))
    vertex_normal /= np.linalg.norm(vertex_normal, axis=1, keepdims=True)
    outside = winding_number((vertices, faces), vertices + 1e-5 * vertex_normal)
    immersed = np.rint(outside) > 0
    assert immersed.sum() > 300
    one_ring = np.zeros(len(vertices), bool)
    one_ring[faces[immersed[faces].any(axis=1)]] = True
    assert np.mean(label[immersed] == 1) > 0.97  # a few small triangles lie between the rays
    assert np.mean(label[~one_ring] == 0) > 0.99


@pytest.mark.parametrize("rule", ["vertex", "triangle"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_batches_and_masks(dtype, shape, rule):
    vertices, faces = join(box(), box((0.5, 0.5, 0.5)))
    batch = jnp.broadcast_to(jnp.asarray(vertices, dtype), (*shape, *vertices.shape))
    for found in (
        classify_vertices(batch, faces, rays=64, rule=rule),
        jax.jit(lambda v: classify_vertices(v, faces, rays=64, rule=rule))(batch),
    ):
        assert isinstance(found, VertexLabels)
        assert found.labels.dtype == jnp.int8 and found.labels.shape == batch.shape[:-1]
        assert found.ratio.shape == shape
        np.testing.assert_array_equal(found.ratio, 0.5)
        np.testing.assert_array_equal(found.penetrating, found.labels == 1)
        assert not found.inverted.any()
        np.testing.assert_array_equal(found.clear, ~found.penetrating)


def test_the_vertex_rule_is_the_default_and_is_exact_at_the_rim():
    """A box half immersed: by the vertex rule its far corners are clear, by the other no longer."""
    vertices, faces = join(box(), box((0.5, 0.5, 0.5), (0.5, 0.01, 0.02)))
    vertices = jnp.asarray(vertices, "float32")
    inner = np.arange(8, 16)[np.asarray(vertices[8:, 0]) < 0.5]
    label = classify_vertices(vertices, faces).labels
    np.testing.assert_array_equal(np.flatnonzero(label), inner)
    np.testing.assert_array_equal(label[inner], 1)
    np.testing.assert_array_equal(classify_vertices(vertices, faces, rays=1).labels, label)
    whole = classify_vertices(vertices, faces, rule="triangle").penetrating
    assert whole[inner].all() and whole.sum() > len(inner)


@pytest.mark.parametrize("rule", ["vertex", "triangle"])
def test_w_out_below_zero_is_inside(rule):
    vertices, faces = join(inverted(box()), box(center=(3, 0, 0)))
    found = classify_vertices(jnp.asarray(vertices, "float32"), faces, rays=64, rule=rule)
    np.testing.assert_array_equal(found.labels, [-1] * 8 + [0] * 8)
    np.testing.assert_array_equal(found.inverted, found.labels == -1)


@pytest.mark.parametrize("rule", ["vertex", "triangle"])
def test_classes_of_unusable_vertices_are_clear(rule):
    vertices, faces = join(box(), box((0.5, 0.5, 0.5)))
    vertices[3, 1] = np.nan
    label = classify_vertices(jnp.asarray(vertices, "float32"), faces, rule=rule).labels
    np.testing.assert_array_equal(label, 0)


def test_unknown_rules_are_refused(untyped):
    with pytest.raises(ValueError, match="rule must be one of 'vertex', 'triangle': got 'edge'"):
        classify_vertices(jnp.zeros((3, 3)), np.array([[0, 1, 2]]), rule="edge")
