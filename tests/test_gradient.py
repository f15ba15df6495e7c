"""The boundary gradient: against finite differences, closed forms, and finer rays."""

import igl
import numpy as np
import pytest
from helpers import (
    body_faces,
    box,
    embedded_body,
    inverted,
    join,
    mocap,
    moved,
    posed_bodies,
    random_rotation,
    sampling,
    sphere,
)

from spt_jax.overlap.boundary import vertex_gradient
from spt_jax.overlap.measure import measure


def value_and_gradient(mesh, rays, directions=3, kind="boundary"):
    found = measure(*mesh, sampling(rays, directions))
    return found.volume, found.gradient(kind, "triangle")


def on_fixed_rays(mesh, rays, direction):
    """The volume as a function of the vertices; the lattice must not change its pixel."""
    pixel = measure(*mesh, sampling(rays, [direction])).beams[0].beam.pixel

    def function(vertices):
        (found,) = measure(vertices, mesh[1], sampling(rays, [direction])).beams
        np.testing.assert_array_equal(found.beam.pixel, pixel)
        return found.volume

    return function


@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 0, 0), (0.3, -0.5, 0.8)])
def test_one_direction_is_the_derivative_of_its_volume(direction):
    """On the posed body, in float64, along random smooth and rough motions: 1e-3 relative."""
    rng = np.random.default_rng(3)
    (vertices,) = posed_bodies(["getup_facedown/0115"])
    mesh = (vertices, body_faces())
    function = on_fixed_rays(mesh, 256, direction)
    _, gradient = value_and_gradient(mesh, 256, [direction])
    matrix = rng.normal(size=(6, 3, 3))
    motions = [np.sin(3 * vertices @ m) for m in matrix]
    motions += [rng.normal(size=vertices.shape) for _ in range(2)]
    # Steps small enough that few rays change triangles: the volume is piecewise smooth.
    step = 1e-7
    for motion in motions:
        ends = [function(vertices + side * step * motion) for side in (-1, 1)]
        exact = np.sum(gradient * motion)
        assert (ends[1] - ends[0]) / (2 * step) == pytest.approx(exact, rel=1e-3)


def test_pushing_two_boxes_together_changes_the_volume_by_their_contact(rng):
    first, second = box(), box((0.5, 0.5, 0.5), (0.6, 0.1, 0.05))
    rotation = random_rotation(rng)
    mesh = moved(join(first, second), rotation)
    volume, gradient = value_and_gradient(mesh, 512)
    # [0.35, 0.5] x 0.5 x 0.5: moving the second box along x changes it by a quarter per unit.
    assert volume == pytest.approx(0.15 * 0.25, rel=2e-3)
    push = gradient[8:].sum(axis=0) @ rotation
    np.testing.assert_allclose(push, [-0.25, 0, 0], atol=2e-3)
    np.testing.assert_allclose(gradient.sum(axis=0), 0, atol=2e-3)  # no net force


def test_wholly_immersed_and_inverted_solids_have_eq_9_as_gradient(rng):
    """w_out is 1 or -1 all over the solid, so the boundary integral is (1/3) sum S_l n_l."""
    outer, inner = box((3, 3, 3)), moved(sphere(0.9, subdivisions=2), random_rotation(rng))
    for mesh, count in ((join(inner, outer), len(inner[0])), (inverted(inner), len(inner[0]))):
        volume, gradient = value_and_gradient(mesh, 400)
        normal = igl.per_vertex_normals(*inner)  # outward, whichever way the mesh is wound
        areas = np.asarray(igl.doublearea(*inner)) / 2
        per_vertex = np.bincount(inner[1].ravel(), np.repeat(areas, 3), count) / 3
        cosine = np.einsum("vi,vi->v", gradient[:count], normal) / np.linalg.norm(
            gradient[:count], axis=1
        )
        assert cosine.min() > 0.99
        np.testing.assert_allclose(np.linalg.norm(gradient[:count], axis=1), per_vertex, rtol=0.05)
        _, eq_9 = value_and_gradient(mesh, 512, kind="vertex")
        assert np.linalg.norm(gradient - eq_9) < 0.02 * np.linalg.norm(eq_9)
        # Scaling the solid changes its volume three times as fast: Euler's theorem.
        assert np.sum(gradient[:count] * inner[0]) == pytest.approx(3 * volume, rel=1e-2)


def test_eq_9_and_eq_10_literally(rng):
    """Against a loop over vertices and triangles."""
    vertices, faces = moved(sphere(subdivisions=1), random_rotation(rng))
    vertices = vertices * rng.uniform(0.8, 1.2, (len(vertices), 1))
    label = rng.integers(-1, 2, len(vertices)).astype(np.int8)
    eq_9, eq_10 = np.zeros(vertices.shape), np.zeros(vertices.shape)
    for t in np.flatnonzero(label):
        total = np.zeros(3)
        for a, b, c in faces[(faces == t).any(axis=1)]:
            cross = np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
            area, normal = np.linalg.norm(cross) / 2, cross / np.linalg.norm(cross)
            total += area * normal
        eq_9[t] = label[t] * total / 3
        eq_10[t] = label[t] * total / np.linalg.norm(total)
    np.testing.assert_allclose(vertex_gradient(vertices, faces, label, unit=False), eq_9)
    np.testing.assert_allclose(vertex_gradient(vertices, faces, label, unit=True), eq_10)


def test_eq_10_is_zero_where_the_normals_cancel():
    """A vertex in the middle of a flat double sheet has no normal: zero, not NaN."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 1]])
    gradient = vertex_gradient(vertices, faces, np.ones(3, np.int8), unit=True)
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.slow
def test_three_directions_are_close_to_2048_rays_along_pose_directions():
    """Twenty pose directions; those along which the overlap hardly changes are left out."""
    rng = np.random.default_rng(5)
    body, frames = embedded_body(), ["getup_facedown/0132", "roll/0056"]
    names = list(mocap().names)
    checked = 0
    for frame in frames:
        pose = np.asarray(body.pose_from_smpl(mocap().pose[names.index(frame)]), np.float64)
        (vertices,) = posed_bodies([frame])
        mesh = (vertices, body_faces())
        _, gradient = value_and_gradient(mesh, 512)
        _, reference = value_and_gradient(mesh, 2048)
        motions = []
        for _ in range(20):
            change = np.zeros_like(pose)
            change[1:22] = 1e-3 * rng.normal(size=(21, 3))
            ends = [np.asarray(body((pose + s * change).astype(np.float32)).vertices, float)
                    for s in (-1, 1)]  # fmt: skip
            motions.append((ends[1] - ends[0]) / 2e-3)
        expected = np.array([np.sum(reference * m) for m in motions])
        found = np.array([np.sum(gradient * m) for m in motions])
        large = np.abs(expected) > 0.1 * np.abs(expected).max()
        checked += large.sum()
        np.testing.assert_allclose(found[large], expected[large], rtol=0.05)
    assert checked >= 25


def test_several_directions_are_better_than_one_on_coarse_rays():
    (vertices,) = posed_bodies(["getup_facedown/0115"])
    mesh = (vertices, body_faces())
    _, reference = value_and_gradient(mesh, 1024)
    errors = [np.linalg.norm(value_and_gradient(mesh, 128, d)[1] - reference) for d in (3, 1)]
    assert errors[0] < 0.5 * errors[1]


def test_triangles_parallel_to_one_direction_are_seen_by_the_others():
    mesh = join(box(), box(center=(0.7, 0.2, 0.1)))
    _, one = value_and_gradient(mesh, (300, 300), [(0, 0, -1)])
    _, three = value_and_gradient(mesh, (300, 300), [(0, 0, -1), (0, -1, 0), (-1, 0, 0)])
    assert np.abs(one[:, :2]).max() < 1e-9  # only the walls facing z are seen
    np.testing.assert_allclose(
        three[8:].sum(axis=0), [-0.8 * 0.9, -0.3 * 0.9, -0.3 * 0.8], rtol=0.02
    )


def test_no_overlap_no_gradient(rng):
    for mesh in (sphere(), join(sphere(), sphere(center=(2.5, 0, 0)))):
        for kind in ("boundary", "vertex", "unit"):
            value, gradient = value_and_gradient(moved(mesh, random_rotation(rng)), 256, kind=kind)
            assert value == 0
            np.testing.assert_array_equal(gradient, 0)
