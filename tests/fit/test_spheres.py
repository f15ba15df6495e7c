"""Spheres in place of a body: analytic pairs, laws, and how well they fill bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import embedded_body, mocap
from helpers_body import PARENTS, slow_body, synthetic_smpl

from spt_jax.body import BodyModel
from spt_jax.fit.spheres.model import BodySpheres
from spt_jax.fit.spheres.penalty import sphere_depths, sphere_penalty


def body_of(vertices, faces, weights, joints, parents, shape_basis=None):
    basis = np.zeros((*np.shape(vertices), 1)) if shape_basis is None else shape_basis
    along = np.zeros((*np.shape(joints), basis.shape[-1]))
    return BodyModel(
        template=jnp.asarray(vertices, float),
        shape_basis=jnp.asarray(basis, float),
        joint_template=jnp.asarray(joints, float),
        joint_shape_basis=jnp.asarray(along, float),
        weights=jnp.asarray(weights, float),
        faces=jnp.asarray(faces, jnp.int32),
        parents=tuple(parents),
        joint_names=tuple(f"j{k}" for k in range(len(parents))),
    )


def arm():
    """Three joints in a row, one metre apart along x, and a sphere at the ends of the row."""
    joints = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    body = body_of(np.eye(3), [[0, 1, 2]], np.eye(3), joints, (-1, 0, 1))
    spheres = BodySpheres(
        centers=jnp.array([[0.0, 0, 0], [2.5, 0, 0]]),
        center_shape_basis=jnp.zeros((2, 3, 1)),
        radii=jnp.array([0.5, 0.75]),
        radius_shape_basis=jnp.array([[0.25], [0.0]]),
        counts=jnp.array([[False, True], [False, False]]),
        part=(0, 2),
    )
    return body, spheres


def bent(dtype, elbow, wrist=0.0):
    return jnp.asarray([[0, 0, 0], [0, 0, elbow], [0, 0, wrist]], dtype)


def capsule(shape_basis=None):
    """A capsule along z, of radius 0.1 m and from -0.1 to 0.5 m."""
    mesh = trimesh.creation.capsule(height=0.4, radius=0.1, count=[24, 24])
    vertices = np.array(mesh.vertices)
    vertices[:, 2] += 0.2 - vertices[:, 2].mean()
    basis = None if shape_basis is None else shape_basis(vertices)
    return body_of(
        vertices, mesh.faces, np.ones((len(vertices), 1)), np.zeros((1, 3)), (-1,), basis
    )


def through_the_chest(body, dtype=np.float32):
    """The left forearm turned back into the chest."""
    pose = jnp.zeros((body.num_joints, 3), dtype)
    names = body.joint_names
    pose = pose.at[names.index("left_shoulder"), 1].set(-1.2)
    return pose.at[names.index("left_elbow"), 1].set(-2.5)


@pytest.fixture(scope="module")
def spheres():
    return BodySpheres.fit(embedded_body())


@pytest.mark.parametrize("elbow", [0.0, 1.0, 2.0, 2.9])
def test_two_spheres_collide_by_their_squared_depth(elbow, dtype):
    body, spheres = arm()
    distance = np.hypot(1 + 1.5 * np.cos(elbow), 1.5 * np.sin(elbow))
    for shape, radius in ((None, 0.5), (jnp.ones(1, dtype), 0.75)):
        got = sphere_penalty(spheres, body, bent(dtype, elbow), shape)
        assert got.dtype == dtype
        depth = max(0.0, radius + 0.75 - distance)
        np.testing.assert_allclose(got, depth**2, rtol=2e-5, atol=1e-12)
    posed = spheres.posed(body, bent(dtype, elbow), translation=jnp.asarray([0, 0, 3], dtype))
    expected = [[0, 0, 3], [1 + 1.5 * np.cos(elbow), 1.5 * np.sin(elbow), 3]]
    np.testing.assert_allclose(posed.centers, expected, atol=1e-6)
    np.testing.assert_allclose(posed.radii, [0.5, 0.75])


def test_derivative_of_two_spheres_in_closed_form(x64):
    body, spheres = arm()
    elbow = 2.6
    distance = np.hypot(1 + 1.5 * np.cos(elbow), 1.5 * np.sin(elbow))
    slope = jax.grad(lambda t: sphere_penalty(spheres, body, bent(float, t)))(elbow)
    # distance^2 = 3.25 + 3 cos(elbow)
    expected = 2 * (1.25 - distance) * 1.5 * np.sin(elbow) / distance
    np.testing.assert_allclose(slope, expected, rtol=1e-12)


def test_spheres_that_share_their_center_have_a_finite_derivative(dtype):
    body, spheres = arm()
    there = jnp.asarray([[0.0, 0, 0], [0.0, 0, 0]], dtype)
    same = BodySpheres(
        there, spheres.center_shape_basis, spheres.radii, spheres.radius_shape_basis,
        spheres.counts, (0, 0),
    )  # fmt: skip
    loss = lambda pose, at: sphere_penalty(  # noqa: E731
        BodySpheres(at, same.center_shape_basis, same.radii, same.radius_shape_basis, same.counts,
                    same.part), body, pose
    )  # fmt: skip
    for slope in jax.grad(loss, (0, 1))(bent(dtype, 1.0), there):
        assert jnp.isfinite(slope).all()
    assert loss(bent(dtype, 1.0), there) == 0  # as near at rest: the shape's own affair


def test_what_the_shape_alone_brings_together_costs_nothing_at_rest(dtype):
    body, spheres = arm()
    fat = jnp.asarray([9.0], dtype)  # radius 2.75: the spheres meet in the zero pose
    assert sphere_penalty(spheres, body, bent(dtype, 0.0), fat) == 0
    assert sphere_penalty(spheres, body, bent(dtype, 0.5), fat) > 1e-3


@pytest.mark.slow
def test_a_capsule_is_filled_as_its_formula_says(x64):
    body = capsule()
    spheres = BodySpheres.fit(body)
    covered, outside = spheres.coverage(body)
    assert covered > 0.88 and outside < 0.12
    assert 3 <= len(spheres.part) <= 10 and not len(spheres.pairs)
    points = np.random.default_rng(1).uniform([-0.2, -0.2, -0.2], [0.2, 0.2, 0.6], (40_000, 3))
    ends = np.asarray(body.template)[:, 2]
    axis = np.clip(points[:, 2], ends.min() + 0.1, ends.max() - 0.1)
    inside = np.hypot(np.hypot(*points[:, :2].T), points[:, 2] - axis) < 0.1
    centers, radii = np.asarray(spheres.centers), np.asarray(spheres.radii)
    held = (np.linalg.norm(points[:, None] - centers, axis=2) < radii).any(axis=1)
    np.testing.assert_allclose(covered, (held & inside).sum() / inside.sum(), atol=0.025)
    np.testing.assert_allclose(outside, (held & ~inside).sum() / inside.sum(), atol=0.025)


def test_spheres_follow_the_shape(x64):
    def basis(vertices):
        shift = np.broadcast_to([0.25, 0.0, -0.5], vertices.shape)
        thicker = vertices * [1.0, 1.0, 0.0]
        return np.stack([shift, vertices, thicker], axis=-1)

    body = capsule(basis)
    spheres = BodySpheres.fit(body)
    move, grow = np.asarray(spheres.center_shape_basis), np.asarray(spheres.radius_shape_basis)
    centers, radii = np.asarray(spheres.centers), np.asarray(spheres.radii)
    np.testing.assert_allclose(move[..., 0], np.tile([0.25, 0, -0.5], (len(radii), 1)), atol=1e-9)
    np.testing.assert_allclose(grow[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(move[..., 1], centers, atol=0.012)
    np.testing.assert_allclose(grow[:, 1], radii, rtol=0.12)
    middle = (centers[:, 2] > 0.1) & (centers[:, 2] < 0.3)
    np.testing.assert_allclose(move[middle, :, 2], centers[middle] * [1, 1, 0], atol=0.01)
    assert (grow[:, 2] > 0.4 * radii).all()


@pytest.mark.slow
def test_the_embedded_body_is_filled(spheres):
    body = embedded_body()
    covered, outside = spheres.coverage(body)
    assert covered > 0.88 and outside < 0.07 and len(spheres.part) <= 120
    assert set(spheres.part) == set(np.unique(body.part_groups).tolist())
    fat = spheres.coverage(body, jnp.zeros(10).at[2].set(2.0))
    assert fat.covered > 0.85 and fat.outside < 0.1
    again = BodySpheres.fit(body)
    assert jnp.array_equal(again.centers, spheres.centers)
    assert len(BodySpheres.fit(body, share=0.5).part) < 0.8 * len(spheres.part)


def test_neighbors_and_folds_do_not_count(spheres):
    body = embedded_body()
    part = np.array(spheres.part)
    pairs = {tuple(sorted(pair)) for pair in part[spheres.pairs].tolist()}
    assert not pairs & set(body.neighbor_pairs)
    names = [body.joint_names.index(n) for n in ("left_hip", "spine1", "left_wrist", "right_knee")]
    thigh, belly, hand, shin = names
    assert {tuple(sorted(p)) for p in ((belly, hand), (thigh, shin), (hand, shin))} <= pairs
    everything = BodySpheres.fit(body, fold_distance=0.0)
    assert (spheres.counts <= everything.counts).all()
    left_out = everything.counts & ~spheres.counts
    nearest = np.ix_(part == thigh, part == belly)
    assert left_out[nearest].sum() >= 2
    assert not left_out[np.ix_(part == belly, part == hand)].any()


def test_an_arm_through_the_chest_costs_and_the_zero_pose_does_not(spheres):
    body = embedded_body()
    pose = through_the_chest(body)
    value, slope = jax.value_and_grad(lambda p: sphere_penalty(spheres, body, p))(pose)
    assert value > 1e-3
    assert sphere_penalty(spheres, body, pose - 1e-3 * slope / jnp.linalg.norm(slope)) < value
    shapes = 2 * np.concatenate([np.eye(10), -np.eye(10), np.ones((1, 10)), -np.ones((1, 10))])
    at_rest = sphere_penalty(spheres, body, 0 * pose, jnp.asarray(shapes, jnp.float32))
    assert at_rest.shape == (22,) and not at_rest.any()
    touching = np.asarray(sphere_depths(spheres, body, pose)) > 0
    names = {body.joint_names[spheres.part[k]] for k in np.argwhere(touching).ravel()}
    assert names & {"left_elbow", "left_wrist"} and names & {"spine2", "spine3"}


def test_walking_costs_nothing_but_where_spheres_stand_out_of_the_skin(spheres):
    body = embedded_body()
    recorded = mocap()
    walks = [k for k, name in enumerate(recorded.names) if name.startswith("walk")][::4]
    poses = body.pose_from_smpl(jnp.asarray(recorded.pose[walks]))
    penalty = np.asarray(sphere_penalty(spheres, body, poses))
    assert len(walks) > 5 and np.mean(penalty == 0) >= 0.7 and penalty.max() < 1e-3


def test_rigid_motion_moves_the_spheres_and_changes_no_penalty(spheres, rng, dtype):
    body = embedded_body()
    pose = through_the_chest(body, dtype)
    turned = pose.at[0].set(jnp.asarray([0.3, -1.1, 0.7], dtype))
    shift = jnp.asarray([1.0, -2.0, 0.5], dtype)
    before, after = spheres.posed(body, pose), spheres.posed(body, turned, translation=shift)
    tolerance = 2e-6 if dtype == np.float32 else 1e-6
    apart = [np.linalg.norm(c[:, None] - c, axis=-1) for c in np.asarray([before[0], after[0]])]
    np.testing.assert_allclose(*apart, atol=tolerance)
    np.testing.assert_allclose(after.radii, before.radii)
    penalty = [sphere_penalty(spheres, body, p) for p in (pose, turned)]
    np.testing.assert_allclose(*penalty, rtol=1e-4)
    with_shift = sphere_penalty(spheres, body, turned, None, shift)
    assert with_shift == penalty[1]


def test_spheres_are_carried_as_the_slow_body_carries_its_skin(x64, rng):
    """A sphere's center moves as a vertex there that follows its joint alone."""
    body = embedded_body()
    spheres = BodySpheres.fit(body)
    pose, shape = 0.4 * rng.normal(size=(52, 3)), rng.normal(size=10)
    posed = spheres.posed(body, jnp.asarray(pose), jnp.asarray(shape))
    part = np.array(spheres.part)
    arrays = {
        "v_template": np.asarray(spheres.centers, float),
        "shapedirs": np.asarray(spheres.center_shape_basis, float),
        "weights": np.eye(52)[part],
        "J": np.asarray(body.joint_template, float),
        "J_shapedirs": np.asarray(body.joint_shape_basis, float),
        "parents": body.parents,
    }
    expected, _ = slow_body(arrays, pose, shape, np.zeros(3))
    np.testing.assert_allclose(posed.centers, expected, atol=1e-9)


def test_derivative_equals_finite_differences(x64, rng):
    body = embedded_body()
    spheres = BodySpheres.fit(body)
    pose, shape = through_the_chest(body, np.float64), jnp.asarray(0.5 * rng.normal(size=10))
    along = jnp.asarray(rng.normal(size=pose.shape)), jnp.asarray(rng.normal(size=shape.shape))
    slope = jax.grad(lambda p, b: sphere_penalty(spheres, body, p, b), (0, 1))(pose, shape)
    for k in range(2):
        loss = jax.jit(
            lambda t, k=k: sphere_penalty(
                spheres,
                body,
                pose + t * along[0] * float(k == 0),
                shape + t * along[1] * float(k == 1),
            )
        )
        expected = (loss(1e-6) - loss(-1e-6)) / 2e-6
        np.testing.assert_allclose(jnp.sum(slope[k] * along[k]), expected, rtol=1e-6)


def test_batches_equal_single_calls(spheres):
    body = embedded_body()
    pose = through_the_chest(body)
    poses = jnp.stack([pose, 0.9 * pose, 0 * pose]).reshape(3, 1, 52, 3)
    shapes = jnp.stack([jnp.zeros(10), jnp.ones(10)])
    got = sphere_penalty(spheres, body, poses, shapes)
    assert got.shape == (3, 2)
    posed = spheres.posed(body, poses, shapes)
    assert posed.centers.shape == (3, 2, len(spheres.part), 3)
    assert posed.radii.shape == (3, 2, len(spheres.part))
    one = jax.jit(lambda s, p, b: sphere_penalty(s, body, p, b))
    for i in range(3):
        single = [one(spheres, poses[i, 0], b) for b in shapes]
        np.testing.assert_allclose(got[i], single, rtol=1e-5, atol=1e-9)
    gradient = jax.jit(jax.grad(one, 1))
    slope = jax.jit(jax.vmap(gradient, (None, 0, None)))(spheres, poses[:, 0], shapes[0])
    np.testing.assert_allclose(slope[0], gradient(spheres, pose, shapes[0]), rtol=1e-4, atol=1e-7)


def test_a_body_laid_out_as_smpl_with_pose_blend_shapes(rng):
    body = embedded_body()
    weights = np.asarray(body.weights)
    left = [k for k in range(22, 52) if body.joint_names[k].startswith("left")]
    right = [k for k in range(22, 52) if body.joint_names[k].startswith("right")]
    hands = [weights[:, side].sum(axis=1) for side in (left, right)]
    joints = np.asarray(body.joint_template)[[*range(22), left[0], right[0]]]
    smpl = BodyModel(
        template=body.template,
        shape_basis=body.shape_basis,
        joint_template=jnp.asarray(joints),
        joint_shape_basis=body.joint_shape_basis[np.array([*range(22), left[0], right[0]])],
        weights=jnp.asarray(np.column_stack([weights[:, :22], *hands])),
        faces=body.faces,
        parents=tuple(PARENTS[24]),
        joint_names=(*body.joint_names[:22], "left_hand", "right_hand"),
        pose_basis=jnp.asarray(1e-3 * rng.normal(size=(body.num_vertices, 3, 207)), jnp.float32),
    )
    spheres = BodySpheres.fit(smpl)
    covered, outside = spheres.coverage(smpl)
    assert covered > 0.87 and outside < 0.07 and max(spheres.part) == 23
    penalty = [sphere_penalty(spheres, smpl, scale * through_the_chest(smpl)) for scale in (0, 1)]
    assert penalty[0] == 0 and penalty[1] > 1e-3


def test_a_surface_that_is_a_tangle_is_fitted_or_refused(rng):
    """Random triangles between random points: no body, and no accident either."""
    arrays = synthetic_smpl(rng)
    joints = arrays["J_regressor"] @ arrays["v_template"]
    body = body_of(
        arrays["v_template"], arrays["f"].astype(np.int32), arrays["weights"], joints, PARENTS[24]
    )
    spheres = BodySpheres.fit(body)
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(spheres))
    pose = jnp.asarray(rng.normal(size=(24, 3)), jnp.float32)
    assert jnp.isfinite(sphere_penalty(spheres, body, pose))


def test_errors_name_the_argument(untyped, spheres):
    body = embedded_body()
    flat = body_of(np.zeros((3, 3)), [[0, 1, 2]], np.ones((3, 1)), np.zeros((1, 3)), (-1,))
    with pytest.raises(ValueError, match="body must enclose a volume"):
        BodySpheres.fit(flat)
    for share in (0.0, 1.5, np.nan):
        with pytest.raises(ValueError, match="share must be above 0"):
            BodySpheres.fit(body, share=share)
    with pytest.raises(ValueError, match="fold_distance must be finite"):
        BodySpheres.fit(body, fold_distance=-1.0)
    with pytest.raises(TypeError, match="body must be known"):
        jax.jit(lambda b: BodySpheres.fit(b).radii)(body)
    with pytest.raises(ValueError, match=r"pose must be \(..., 52, 3\)"):
        sphere_penalty(spheres, body, jnp.zeros((24, 3)))
    with pytest.raises(TypeError, match="pose must be floating-point"):
        sphere_penalty(spheres, body, jnp.zeros((52, 3), int))
    with pytest.raises(ValueError, match="at most 10 coefficients"):
        sphere_penalty(spheres, body, jnp.zeros((52, 3)), jnp.zeros(11))
    with pytest.raises(ValueError, match="translation must be"):
        spheres.posed(body, jnp.zeros((52, 3)), translation=jnp.zeros(2))
