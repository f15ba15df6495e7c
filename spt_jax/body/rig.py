"""The rig of a character: joints that turn, stretch and shift, and the skin that follows them."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax.body.base import AbstractBody, PosedBody, broadcast_batches, floating
from spt_jax.body.fold_distances import BODY_DISTANCE, fold_distances
from spt_jax.body.model_check import check_rig, checked_rows
from spt_jax.body.rotations import matrix_from_axis_angle
from spt_jax.body.skinning import blend_shapes, blended, down_the_tree, lift
from spt_jax.rest.surface import RestSurface

# A body of this height or span, in metres, has the distances of a human body; others have them in
# proportion.
_HUMAN = (1.2, 2.5)
_SPAN = 1.8


class RigModel(AbstractBody):
    """A rigged character, as glTF has them: a body of its own joints, weights and morph targets.

    Joint j stands in its parent's space by a fixed map C_j (nodes between that nothing moves), then
    by its own translation T_j, rotation R_j and stretch S_j (glTF 2.0, sections 3.5.3 and 3.7.3.1):

        G_j = G_parent C_j [R_j S_j | T_j]
        vertices = sum over bones k of weights_k G_joint(k) inverse_bind_k (template + targets b)

    A pose turns joints away from how they stood when the skin was bound:
    R_j = Q_j^T exp(pose_j) Q_j R_bind_j, Q_j the turn from the joint's space to the world (it
    mirrors where the character is mirrored), so that the zero pose is the bind pose and axes are
    the world's, as in `BodyModel`.

    Get one from `load_rig`. It goes where bodies go: `untangle_pose`, `untangle_motion`, the
    penalty with its `rest_surface`.

    Attributes:
        template: vertices in the space in which the skin was bound, in metres.
        shape_basis: what each morph target adds, for a coefficient of 1.
        bone_weights: skinning weights; rows sum to 1.
        inverse_bind: of each bone, what takes vertices into its joint's own space.
        before: C_j.
        joint_translation, joint_stretch: T_j and S_j as the file has them.
        bind_rotation, bind_frame: R_bind_j and Q_j.
        faces: vertex indices of each triangle, counter-clockwise seen from outside.
        bones: of each column of weights, its joint; two bones of one joint were bound differently.
        parents: the parent of each joint; -1 for joint 0, the root.
        joint_names, shape_names: of joints and of coefficients.
        shifting, scaling: joints whose translation and scale are coefficients, too: those after the
            morph targets, three a joint, in metres and as a change of the scale.

    Raises:
        TypeError, ValueError: arrays do not fit together.

    Example:
        >>> import tempfile, pathlib
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.io import load_rig, write_rig
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder) / "body.glb"
        ...     write_rig(file, load_body(num_shape=2))
        ...     rig = load_rig(file).body
        >>> rig(jnp.zeros((52, 3))).vertices.shape, rig.shape_names
        ((12272, 3), ('shape 0', 'shape 1'))
    """

    template: Float[Array, "V 3"]
    shape_basis: Float[Array, "V 3 M"]
    bone_weights: Float[Array, "V K"]
    inverse_bind: Float[Array, "K 3 4"]
    before: Float[Array, "J 3 4"]
    joint_translation: Float[Array, "J 3"]
    joint_stretch: Float[Array, "J 3 3"]
    bind_rotation: Float[Array, "J 3 3"]
    bind_frame: Float[Array, "J 3 3"]
    faces: Int[Array, "F 3"]
    bones: tuple[int, ...] = eqx.field(static=True)
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    shape_names: tuple[str, ...] = eqx.field(static=True)
    shifting: tuple[int, ...] = eqx.field(static=True, default=())
    scaling: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        check_rig(self)

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.template.shape[0]

    @property
    def num_shape(self) -> int:
        """Number of coefficients: morph targets, and joints that shift or scale."""
        return self.shape_basis.shape[-1] + 3 * (len(self.shifting) + len(self.scaling))

    @property
    def weights(self) -> Float[Array, "V J"]:
        """Of each vertex, how much each joint moves it; rows sum to 1."""
        if self.bones == tuple(range(self.num_joints)):
            return self.bone_weights
        joints = jnp.zeros((self.num_vertices, self.num_joints), self.bone_weights.dtype)
        return joints.at[:, np.array(self.bones)].add(self.bone_weights)

    @property
    def rest_surface(self) -> RestSurface:
        """The surface in the bind pose, by which the penalty recognizes folds.

        As `BodyModel.rest_surface`; for a character of another size than a human one the distances
        are in proportion to the largest extent of its bind pose, 0.3 m for 1.8 m.

        Raises:
            TypeError: inside jit, grad or vmap of a function that the rig is an argument of.
        """
        if isinstance(self.template, Tracer):
            return RestSurface(self.template, self.faces)  # which says what to do
        posed = self(jnp.zeros(self.pose_shape, self.template.dtype))
        vertices = np.asarray(posed.vertices, np.float64)
        extent = float(np.ptp(vertices, axis=0).max())
        human = _HUMAN[0] <= extent <= _HUMAN[1]
        distance = BODY_DISTANCE if human else BODY_DISTANCE * extent / _SPAN
        allowed = fold_distances(
            vertices,
            np.asarray(self.faces, np.int64),
            np.asarray(self.weights),
            np.asarray(posed.joints, np.float64),
            self.parents,
            distance,
        )
        return RestSurface(posed.vertices, self.faces, allowed)

    def __call__(
        self,
        pose: Float[Array | np.ndarray, "*#batch J 3"],
        shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
    ) -> PosedBody:
        """The character's vertices and joints in a pose.

        The class says the equations. Everything is computed in the dtype of `pose`.

        Args:
            pose: axis-angle of each joint relative to its parent, in radians, away from the bind
                pose and about the world's axes there; row 0 turns the whole character about its
                root.
            shape: coefficients in the order of `shape_names`; fewer leave the rest at zero, and
                None means none at all.
            translation: added to vertices and joints, in metres.

        Any number of leading batch axes, which broadcast against each other.

        Raises:
            TypeError: an argument is not floating-point.
            ValueError: a shape does not fit the rig, or batch axes do not broadcast.

        Differentiation: every mode and order, finite at the zero pose and at an angle of pi.
        """
        angles = floating("pose", pose)
        if angles.ndim < 2 or angles.shape[-2:] != self.pose_shape:
            raise ValueError(
                f"pose must be (..., {self.num_joints}, 3), one axis-angle row a joint: got shape "
                f"{tuple(angles.shape)}."
            )
        dtype = angles.dtype
        given = jnp.zeros((0,), dtype) if shape is None else floating("shape", shape).astype(dtype)
        if given.ndim < 1 or given.shape[-1] > self.num_shape:
            raise ValueError(
                f"shape must have at most {self.num_shape} coefficients in its last axis, those of "
                f"shape_names: got shape {tuple(given.shape)}; drop the last ones."
            )
        shift = jnp.zeros((3,), dtype)
        if translation is not None:
            shift = floating("translation", translation).astype(dtype)
        if shift.ndim < 1 or shift.shape[-1] != 3:
            raise ValueError(f"translation must be (..., 3): got shape {tuple(shift.shape)}.")
        batch = broadcast_batches(
            pose=angles.shape[:-2], shape=given.shape[:-1], translation=shift.shape[:-1]
        )
        return _pose(self, angles, given, shift, batch_rank=len(batch))

    def at_vertices(self, indices: Any) -> "RigModel":
        """The same rig with some of its vertices only, and no faces.

        Args:
            indices: of the vertices to keep, in any order; they may repeat.

        Raises:
            TypeError, ValueError: as `BodyModel.at_vertices`.
        """
        rows = checked_rows(indices, self.num_vertices)
        return eqx.tree_at(
            lambda rig: (rig.template, rig.shape_basis, rig.bone_weights, rig.faces),
            self,
            (
                self.template[rows],
                self.shape_basis[rows],
                self.bone_weights[rows],
                jnp.zeros((0, 3), jnp.int32),
            ),
        )


@partial(jax.jit, static_argnames="batch_rank")
def _pose(rig: RigModel, angles, shape, shift, batch_rank: int) -> PosedBody:
    dtype = angles.dtype
    targets = rig.shape_basis.shape[-1]

    def fit(array, rank: int):
        return lift(array.astype(dtype), batch_rank, rank)

    vertices = fit(blend_shapes(rig.template, rig.shape_basis, shape[..., :targets], dtype), 2)
    # Q^T exp(pose) Q R_bind is what turns each joint.
    frame, before = fit(rig.bind_frame, 3), fit(rig.before, 3)
    bind = fit(rig.bind_rotation, 3)
    turn = _product(jnp.swapaxes(frame, -1, -2), fit(matrix_from_axis_angle(angles), 3))
    turn = _product(turn, _product(frame, bind))
    place, stretch = fit(rig.joint_translation, 2), fit(rig.joint_stretch, 3)
    if shape.shape[-1] > targets:
        moved, scaled = _changes(rig, fit(shape[..., targets:], 1))
        place, stretch = place + moved, stretch + scaled
    linear = _product(before[..., :3], _product(turn, stretch))
    offset = before[..., 3] + jnp.sum(before[..., :3] * place[..., None, :], axis=-1)
    world, position = down_the_tree(linear, offset, rig.parents)
    bones, bound = np.array(rig.bones), fit(rig.inverse_bind, 3)
    of_bone, at_bone = world[..., bones, :, :], position[..., bones, :]
    motion = _product(of_bone, bound[..., :3])
    away = at_bone + jnp.sum(of_bone * bound[..., None, :, 3], axis=-1)
    skin = blended(vertices, rig.bone_weights.astype(dtype), motion, away)
    shift = lift(shift, batch_rank, 1)[..., None, :]
    return PosedBody(skin + shift, position + shift)


def _product(left, right):
    return jnp.sum(left[..., :, :, None] * right[..., None, :, :], axis=-2)


def _changes(rig: RigModel, given):
    """What the coefficients after the morph targets add to translations and stretches."""
    wanted = 3 * (len(rig.shifting) + len(rig.scaling))
    missing = jnp.zeros((*given.shape[:-1], wanted - given.shape[-1]), given.dtype)
    rows = jnp.concatenate([given, missing], axis=-1).reshape(*given.shape[:-1], wanted // 3, 3)
    count, joints = len(rig.shifting), rig.num_joints
    empty = jnp.zeros((*given.shape[:-1], joints, 3), given.dtype)
    moved = empty.at[..., np.array(rig.shifting, int), :].set(rows[..., :count, :])
    scaled = empty.at[..., np.array(rig.scaling, int), :].set(rows[..., count:, :])
    return moved, _diagonal(scaled)


def _diagonal(values):
    eye = lift(jnp.eye(values.shape[-1], dtype=values.dtype), values.ndim - 1, 2)
    return values[..., None] * eye
