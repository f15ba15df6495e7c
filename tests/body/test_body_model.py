"""BodyModel against SMPL's formulas written out, and the laws that a body obeys."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers_body import slow_body, slow_rotation, smpl_pose, synthetic_smpl, with_parents

from spt_jax.body import BodyModel, load_body
from spt_jax.body.poses import SMPL_LAYOUTS


def _model(smpl, dtype="float32"):
    smpl = with_parents(smpl)
    regressor = smpl["J_regressor"]
    return BodyModel(
        template=jnp.asarray(smpl["v_template"], dtype),
        shape_basis=jnp.asarray(smpl["shapedirs"], dtype),
        joint_template=jnp.asarray(regressor @ smpl["v_template"], dtype),
        joint_shape_basis=jnp.asarray(
            np.einsum("jv,vcb->jcb", regressor, smpl["shapedirs"]), dtype
        ),
        weights=jnp.asarray(smpl["weights"], dtype),
        faces=jnp.asarray(smpl["f"].astype(np.int32)),
        parents=tuple(smpl["parents"]),
        joint_names=SMPL_LAYOUTS[len(smpl["parents"])],
        pose_basis=jnp.asarray(smpl["posedirs"], dtype),
    )


@eqx.filter_jit
def _posed(body, *arguments):
    return body(*arguments)


def _unhooked(method):
    """The method without the suite's own type checks, which would speak first."""
    return inspect.unwrap(method)


@pytest.mark.parametrize("joints", [24, 55])
def test_equals_the_slow_reference(dtype, rng, joints):
    smpl = synthetic_smpl(rng, joints)
    body = _model(smpl, dtype)
    pose, _ = smpl_pose(rng, joints)
    pose[3], pose[4] = 0, [0, np.pi, 0]
    shape, translation = rng.normal(size=10), rng.normal(size=3)
    got = _posed(
        body, jnp.asarray(pose, dtype), jnp.asarray(shape, dtype), jnp.asarray(translation, dtype)
    )
    vertices, joints = slow_body(with_parents(smpl), pose, shape, translation)
    scale = np.abs(vertices).max()  # float32 has 7 digits of whatever the random model's size is
    limit = 1e-12 if dtype == np.float64 else 1e-6 * max(scale, 1.0)
    assert got.vertices.dtype == got.joints.dtype == dtype
    np.testing.assert_allclose(got.vertices, vertices, rtol=0, atol=limit)
    np.testing.assert_allclose(got.joints, joints, rtol=0, atol=limit)


def test_embedded_body_equals_the_slow_reference(rng):
    body = load_body()
    smpl = {
        "v_template": np.asarray(body.template, np.float64),
        "shapedirs": body.shape_basis,
        "J": np.asarray(body.joint_template, np.float64),
        "J_shapedirs": body.joint_shape_basis,
        "weights": np.asarray(body.weights, np.float64),
        "parents": body.parents,
    }
    pose, _ = smpl_pose(rng, 52)
    shape, translation = rng.normal(size=10), rng.normal(size=3)
    keep = rng.choice(body.num_vertices, 300, replace=False)
    got = _posed(body, *(jnp.asarray(x, jnp.float32) for x in (pose, shape, translation)))
    vertices, joints = slow_body(smpl, pose, shape, translation, keep)
    np.testing.assert_allclose(got.vertices[keep], vertices, rtol=0, atol=2e-6)
    np.testing.assert_allclose(got.joints, joints, rtol=0, atol=2e-6)


def test_zero_pose_is_rest(rng, dtype):
    body = _model(synthetic_smpl(rng))
    shape = jnp.asarray(rng.normal(size=10), dtype)
    posed = _posed(body, jnp.zeros((24, 3), dtype), shape)
    np.testing.assert_allclose(posed.vertices, body.rest(shape), atol=2e-6)
    assert body.rest(shape).dtype == dtype
    assert body.rest() is body.template


def test_root_turns_and_translation_moves_the_whole_body(rng, x64):
    body = _model(synthetic_smpl(rng), "float64")
    pose, _ = smpl_pose(rng, 24)
    pose[0] = 0
    still = _posed(body, jnp.asarray(pose), None, jnp.zeros(3))
    pose[0] = [0.5, 2.0, -1.0]
    shift = np.array([3.0, -1.0, 2.0])
    moved = _posed(body, jnp.asarray(pose), None, jnp.asarray(shift))
    turn, pelvis = slow_rotation(pose[0]), np.asarray(still.joints[0])
    for before, after in ((still.vertices, moved.vertices), (still.joints, moved.joints)):
        expected = (np.asarray(before) - pelvis) @ turn.T + pelvis + shift
        np.testing.assert_allclose(after, expected, atol=1e-12)


def test_bones_keep_their_length(rng, x64):
    body = _model(synthetic_smpl(rng), "float64")
    pose, _ = smpl_pose(rng, 24)
    posed = np.asarray(_posed(body, jnp.asarray(pose), None, jnp.zeros(3)).joints)
    rest = np.asarray(body.joint_template)
    up = list(body.parents[1:])
    lengths = [np.linalg.norm(j[1:] - j[up], axis=-1) for j in (posed, rest)]
    np.testing.assert_allclose(*lengths, atol=1e-12)


def test_fewer_coefficients_mean_zeros_for_the_rest(rng):
    body = _model(synthetic_smpl(rng))
    pose = jnp.asarray(smpl_pose(rng, 24)[0], jnp.float32)
    some = jnp.asarray(rng.normal(size=4), jnp.float32)
    whole = jnp.concatenate([some, jnp.zeros(6, jnp.float32)])
    fewer, padded = _posed(body, pose, some), _posed(body, pose, whole)
    np.testing.assert_allclose(fewer.vertices, padded.vertices, atol=1e-6)


def test_batches_broadcast_and_equal_single_calls(rng, x64):
    body = _model(synthetic_smpl(rng), "float64")
    pose = jnp.asarray(smpl_pose(rng, 24, 2, 1)[0])
    shape = jnp.asarray(rng.normal(size=(3, 10)))
    shift = jnp.asarray(rng.normal(size=(4, 1, 1, 3)))
    posed = _posed(body, pose, shape, shift)
    assert posed.vertices.shape == (4, 2, 3, 60, 3)
    assert posed.joints.shape == (4, 2, 3, 24, 3)
    single = _posed(body, pose[1, 0], shape[2], shift[3, 0, 0])
    np.testing.assert_allclose(posed.vertices[3, 1, 2], single.vertices, atol=1e-12)
    mapped = jax.jit(jax.vmap(jax.vmap(lambda p, s: body(p, s), (0, None)), (None, 0)))(
        pose[:, 0], shape
    )
    straight = _posed(body, pose[:, 0], shape[:, None])
    np.testing.assert_allclose(mapped.vertices, straight.vertices, atol=1e-12)


def test_numpy_arguments_and_jit_give_the_same(rng):
    body = _model(synthetic_smpl(rng))
    pose = smpl_pose(rng, 24)[0].astype(np.float32)
    jitted = _posed(body, jnp.asarray(pose))
    np.testing.assert_allclose(body(pose).vertices, jitted.vertices, atol=2e-6)


def test_derivatives_are_finite_and_right_at_zero_and_pi(rng, x64):
    body = _model(synthetic_smpl(rng, vertices=20), "float64")
    shape = jnp.asarray(rng.normal(size=10))
    pull = jnp.asarray(rng.normal(size=(20, 3)))
    along = jnp.asarray(rng.normal(size=(24, 3)))
    bend = jnp.asarray(rng.normal(size=10))

    def energy(p, s):
        return jnp.sum((body(p, s).vertices - pull) ** 2)

    @jax.jit
    def slopes_and_curvatures(p, s):
        return jax.jvp(jax.value_and_grad(energy, (0, 1)), (p, s), (along, bend))

    h = 1e-5
    for row in ([0, 0, 0], [0, np.pi, 0], [1e-12, 0, 0]):
        pose = jnp.asarray(np.tile(np.array(row, float), (24, 1)))
        (_, slopes), (slope, curvatures) = slopes_and_curvatures(pose, shape)
        ahead, _ = slopes_and_curvatures(pose + h * along, shape + h * bend)
        behind, _ = slopes_and_curvatures(pose - h * along, shape - h * bend)
        np.testing.assert_allclose(slope, (ahead[0] - behind[0]) / (2 * h), rtol=1e-6)
        inner = jnp.sum(slopes[0] * along) + jnp.sum(slopes[1] * bend)
        np.testing.assert_allclose(inner, slope, rtol=1e-10)
        for got, more, less in zip(curvatures, ahead[1], behind[1], strict=True):
            np.testing.assert_allclose(got, (more - less) / (2 * h), rtol=1e-5, atol=1e-4)


def test_float32_derivatives_of_the_embedded_body_are_finite_at_the_zero_pose():
    body = load_body()

    def height(pose):
        return jnp.sum(body(pose).vertices[:, 1] ** 2)

    slope = jax.jit(jax.grad(height))(jnp.zeros((52, 3)))
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_wrong_arguments_are_named(rng):
    body = _model(synthetic_smpl(rng))
    call = _unhooked(type(body).__call__)
    zero = jnp.zeros((24, 3))
    with pytest.raises(ValueError, match=r"pose must be \(\.\.\., 24, 3\).*got shape \(22, 3\)"):
        call(body, jnp.zeros((22, 3)))
    with pytest.raises(ValueError, match=r"got shape \(72,\)"):
        call(body, jnp.zeros(72))
    with pytest.raises(TypeError, match=r"pose must be floating-point: got dtype int32"):
        call(body, jnp.zeros((24, 3), jnp.int32))
    with pytest.raises(ValueError, match=r"at most 10 coefficients.*got shape \(11,\)"):
        call(body, zero, jnp.zeros(11))
    with pytest.raises(ValueError, match=r"translation must be \(\.\.\., 3\): got shape \(2,\)"):
        call(body, zero, None, jnp.zeros(2))
    with pytest.raises(ValueError, match=r"batch axes must broadcast.*pose \(2,\), shape \(3,\)"):
        call(body, jnp.zeros((2, 24, 3)), jnp.zeros((3, 10)))
    with pytest.raises(ValueError, match="got shape"):
        jax.jit(lambda p: call(body, p))(jnp.zeros((23, 3)))


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("shape_basis", np.zeros((5, 3, 10), np.float32), ValueError, "shape_basis must have"),
        ("weights", np.zeros((60, 23), np.float32), ValueError, "weights must have shape"),
        ("pose_basis", np.zeros((60, 3, 9), np.float32), ValueError, "pose_basis must have"),
        ("template", np.zeros((60, 3), np.int32), TypeError, "template must be floating-point"),
        ("faces", np.zeros((4, 4), np.int32), ValueError, "faces must be triangles"),
        ("faces", np.zeros((4, 3), np.int16), TypeError, "faces must be int32"),
        ("faces", np.full((4, 3), 60, np.int32), ValueError, "got indices 60 to 60 for 60"),
        ("parents", (-1,), ValueError, "one entry for each of 24 joints"),
        ("parents", (-1, 2, *[0] * 22), ValueError, r"got 2 for joint 1 \(left_hip\)"),
        ("parents", (0, *[0] * 23), ValueError, r"got 0 for joint 0 \(pelvis\)"),
    ],
)
def test_a_model_that_contradicts_itself_is_refused(rng, field, value, error, message):
    body = _model(synthetic_smpl(rng))
    object.__setattr__(body, field, jnp.asarray(value) if field != "parents" else value)
    with pytest.raises(error, match=message):
        body.__check_init__()


@pytest.mark.parametrize("joints", [22, 24, 52, 55])
@pytest.mark.parametrize("target", [24, 52, 55])
def test_smpl_poses_are_carried_by_joint_name(rng, joints, target):
    body = _model(synthetic_smpl(rng, target, vertices=8))
    pose, names = smpl_pose(rng, joints, 2)
    pose = pose.astype(np.float32)
    got = np.asarray(body.pose_from_smpl(pose))
    assert got.shape == (2, target, 3)
    for k, name in enumerate(body.joint_names):
        expected = pose[:, names.index(name)] if name in names else np.zeros((2, 3))
        np.testing.assert_array_equal(got[:, k], expected)
    np.testing.assert_array_equal(body.pose_from_smpl(pose.reshape(2, -1)), got)


def test_poses_of_no_known_layout_are_refused(rng, untyped):
    body = _model(synthetic_smpl(rng))
    with pytest.raises(ValueError, match=r"22, 24, 52 or 55 joints.*got shape \(21, 3\)"):
        body.pose_from_smpl(jnp.zeros((21, 3)))
    with pytest.raises(TypeError, match="floating-point"):
        body.pose_from_smpl(jnp.zeros((22, 3), jnp.int32))


@pytest.mark.parametrize("indices", [[41, 0, 0, 7], []])
def test_a_few_vertices_are_those_of_the_whole_body(rng, indices):
    body = _model(synthetic_smpl(rng))
    pose = jnp.asarray(smpl_pose(rng, 24)[0], "float32")
    shape = jnp.asarray(rng.normal(size=10), "float32")
    few = body.at_vertices(indices)
    assert few.num_vertices == len(indices) and few.faces.shape == (0, 3)
    whole, part = _posed(body, pose, shape), _posed(few, pose, shape)
    rows = np.array(indices, int)
    np.testing.assert_allclose(part.vertices, whole.vertices[rows], atol=1e-5)
    np.testing.assert_allclose(part.joints, whole.joints, atol=1e-5)


def test_a_few_vertices_of_a_traced_body_pass_on_its_gradient(rng):
    body = _model(synthetic_smpl(rng))
    slope = eqx.filter_grad(lambda b: jnp.sum(b.at_vertices([5, 9]).template[1]))(body)
    np.testing.assert_array_equal(slope.template, np.eye(60)[9][:, None] * np.ones(3))


@pytest.mark.parametrize(
    ("indices", "error", "message"),
    [
        ([60], ValueError, "from 0 to 59, one for each vertex: got 60"),
        ([2, -1], ValueError, "got -1"),
        ([1.0], TypeError, "whole numbers"),
        ([[1, 2]], ValueError, r"shape \(1, 2\)"),
        (3, ValueError, r"shape \(\)"),
    ],
)
def test_impossible_vertices_are_named(rng, indices, error, message):
    body = _model(synthetic_smpl(rng))
    with pytest.raises(error, match=message):
        body.at_vertices(indices)
