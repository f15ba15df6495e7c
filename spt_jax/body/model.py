"""The body model: shape and pose in, vertices and joints out."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, DTypeLike, Float, Int

from spt_jax.body.base import AbstractBody, PosedBody, broadcast_batches, floating
from spt_jax.body.fold_distances import fold_distances
from spt_jax.body.hands import Hand, posed_hands
from spt_jax.body.model_check import check_model, checked_rows
from spt_jax.body.posing import PoseFeatures, pose_body
from spt_jax.body.skinning import blend_shapes
from spt_jax.rest.surface import RestSurface


class BodyModel(AbstractBody):
    """A statistical body of the SMPL family: blend shapes, a tree of joints, linear blend skinning.

    With shape b, joint rotations R_j relative to the parents and the tree's world motions G_j
    (Loper et al. 2015, equations 2 to 10):

        rest(b, R) = template + shape_basis b + pose_basis vec(R_1 - I, ..., R_J-1 - I)
        J(b) = joint_template + joint_shape_basis b
        vertices = sum over j of weights_j G_j(R, J(b)) rest(b, R)

    Get one from `load_body`. It is a pytree: pass it through `jit`, `vmap` or `grad` like an array.
    It holds arrays, so it has no hash: write `jax.jit(lambda p: body(p))`, not `jax.jit(body)`.

    Attributes:
        template: rest vertices of the mean shape, in metres.
        shape_basis: displacement of each vertex for one unit of each shape coefficient, in metres.
        joint_template: joints of the mean shape at rest, in metres.
        joint_shape_basis: displacement of each joint for one unit of each coefficient, in metres.
        weights: skinning weights; rows sum to 1.
        faces: vertex indices of each triangle, counter-clockwise seen from outside.
        parents: the parent of each joint; -1 for joint 0, the root.
        joint_names: one name for each joint.
        pose_basis: pose blend shapes, the coefficients row by row through R_1 - I to R_J-1 - I; or
            None.
        expression_basis: displacement of each vertex for one unit of each expression coefficient
            (SMPL-X, FLAME), added as the shape's is; or None.
        joint_expression_basis: the same of the joints.
        hands: the hand components of the model (MANO, SMPL-H, SMPL-X), for `with_hands`.
        pose_features: what `pose_basis` goes by: "matrices", as above; "quaternions", (x, y, z,
            w - 1) of every joint (SUPR); "star", those of all joints but the root and then the
            second shape coefficient (STAR).

    Raises:
        TypeError: an array has the wrong kind of dtype.
        ValueError: shapes disagree, `parents` is not a tree in order, or `faces` has an index
            outside the vertices.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.body import load_body
        >>> body = load_body()
        >>> posed = body(jnp.zeros((body.num_joints, 3)))
        >>> posed.vertices.shape, posed.joints.shape
        ((12272, 3), (52, 3))
    """

    template: Float[Array, "V 3"]
    shape_basis: Float[Array, "V 3 B"]
    joint_template: Float[Array, "J 3"]
    joint_shape_basis: Float[Array, "J 3 B"]
    weights: Float[Array, "V J"]
    faces: Int[Array, "F 3"]
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    pose_basis: Float[Array, "V 3 P"] | None = None
    expression_basis: Float[Array, "V 3 E"] | None = None
    joint_expression_basis: Float[Array, "J 3 E"] | None = None
    hands: tuple[Hand, ...] = ()
    pose_features: PoseFeatures = eqx.field(static=True, default="matrices")

    def __check_init__(self):
        check_model(self)

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.template.shape[0]

    @property
    def num_joints(self) -> int:
        """Number of joints, the root included."""
        return self.joint_template.shape[0]

    @property
    def num_shape(self) -> int:
        """Number of shape coefficients."""
        return self.shape_basis.shape[-1]

    @property
    def num_expression(self) -> int:
        """Number of expression coefficients."""
        return 0 if self.expression_basis is None else self.expression_basis.shape[-1]

    @property
    def rest_surface(self) -> RestSurface:
        """The body's surface at rest, in the mean shape, by which the penalty recognizes folds.

        Triangles that intersect nearer to each other along it than what lies there allows fold:
        0.3 m on trunk and limbs, 4 to 5 cm on fingers, from the girth of what each joint moves
        (`spt_jax.body.fold_distances`). `body.rest_surface.within(0.2)` is for one distance
        everywhere, and `within(array)` for one a face.

        Raises:
            TypeError: inside jit, grad or vmap of a function that the body is an argument of. Take
                it outside.

        Example:
            >>> from spt_jax.body import load_body
            >>> load_body().rest_surface
            RestSurface(24540 faces, distance=0.0395 to 0.3)
        """
        traced = (self.template, self.faces, self.weights, self.joint_template)
        if any(isinstance(array, Tracer) for array in traced):
            return RestSurface(self.template, self.faces)  # which says what to do
        template, faces = np.asarray(self.template, np.float64), np.asarray(self.faces, np.int64)
        weights, joints = np.asarray(self.weights), np.asarray(self.joint_template, np.float64)
        allowed = fold_distances(template, faces, weights, joints, self.parents)
        return RestSurface(self.template, self.faces, allowed)

    def __call__(
        self,
        pose: Float[Array | np.ndarray, "*#batch J 3"],
        shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
        *,
        expression: Float[Array | np.ndarray, "*#batch E"] | None = None,
    ) -> PosedBody:
        """The body's vertices and joints in a pose.

        The class says the equations. Everything is computed in the dtype of `pose`.

        Args:
            pose: axis-angle of each joint relative to its parent, in radians; row 0 is the global
                orientation, about the pelvis. `pose_from_smpl` makes one from an SMPL pose.
            shape: coefficients of the first components of the shape basis; fewer than the body
                has leave the rest at zero, and None means the mean shape.
            translation: added to vertices and joints, in metres; None means zero.
            expression: coefficients of the first components of the expression basis; None means
                a face at rest.

        Any number of leading batch axes, which broadcast against each other.

        Returns:
            PosedBody(vertices, joints).

        Raises:
            TypeError: an argument is not floating-point.
            ValueError: a shape does not fit the body, or batch axes do not broadcast.

        Differentiation: every mode and order, with respect to the arguments and to the model's
            arrays; finite at the zero pose and at an angle of pi.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax.body import load_body
            >>> body = load_body()
            >>> two_shapes = jnp.array([[1.0], [-1.0]])
            >>> body(jnp.zeros((52, 3)), two_shapes).vertices.shape
            (2, 12272, 3)
        """
        angles = floating("pose", pose)
        if angles.ndim < 2 or angles.shape[-2:] != (self.num_joints, 3):
            raise ValueError(
                f"pose must be (..., {self.num_joints}, 3), one axis-angle row a joint: got shape "
                f"{tuple(angles.shape)}; for SMPL's layouts use body.pose_from_smpl(pose)."
            )
        dtype = angles.dtype
        betas = None if shape is None else self._coefficients("shape", shape, dtype)
        face = None if expression is None else self._coefficients("expression", expression, dtype)
        shift = None if translation is None else floating("translation", translation).astype(dtype)
        if shift is not None and (shift.ndim < 1 or shift.shape[-1] != 3):
            raise ValueError(f"translation must be (..., 3): got shape {tuple(shift.shape)}.")
        batch = broadcast_batches(
            pose=angles.shape[:-2],
            shape=() if betas is None else betas.shape[:-1],
            translation=() if shift is None else shift.shape[:-1],
            expression=() if face is None else face.shape[:-1],
        )
        return PosedBody(*pose_body(self, angles, betas, face, shift, batch_rank=len(batch)))

    def rest(
        self, shape: Float[Array | np.ndarray, "*batch B"] | None = None
    ) -> Float[Array, "*batch V 3"]:
        """The vertices of the zero pose, in metres.

        Args:
            shape: coefficients of the first components of the shape basis; None means the mean.

        Returns:
            template + shape_basis b, in the dtype of `shape`, or of the model where it is None.

        Raises:
            TypeError, ValueError: `shape` is not floating-point, or has too many coefficients.
        Differentiation: every mode; the map is affine.

        Example:
            >>> from spt_jax.body import load_body
            >>> float(load_body().rest().max(axis=0)[1] - load_body().rest().min(axis=0)[1]) > 1.6
            True
        """
        if shape is None:
            return self.template
        betas = self._coefficients("shape", shape, None)
        return blend_shapes(self.template, self.shape_basis, betas, betas.dtype)

    def at_vertices(self, indices: Any) -> "BodyModel":
        """The same body with some of its vertices only, and no faces.

        A few landmarks are then posed at the cost of a few vertices: joints, shape and pose mean
        what they did, and vertex k of the result is vertex `indices[k]` of this body.

        Args:
            indices: of the vertices to keep, in any order; they may repeat, and may be none.

        Returns:
            A BodyModel with `len(indices)` vertices.

        Raises:
            TypeError: indices that are not whole numbers, or are traced.
            ValueError: indices that are no list, or out of range.
        Differentiation: every mode, with respect to the model's arrays.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax.body import load_body
            >>> tip = load_body().at_vertices([7])
            >>> tip(jnp.zeros((52, 3))).vertices.shape
            (1, 3)
        """
        rows = checked_rows(indices, self.num_vertices)
        own = {
            name: None if array is None else array[rows]
            for name in ("template", "shape_basis", "weights", "pose_basis", "expression_basis")
            for array in [getattr(self, name)]
        }
        return self.replaced({**own, "faces": jnp.zeros((0, 3), jnp.int32)})

    def replaced(self, values: Mapping[str, Any]) -> "BodyModel":
        """The same body with other values of some attributes, by name; checked as a new one is."""
        return dataclasses.replace(self, **values)

    def with_hands(
        self,
        pose: Float[Array | np.ndarray, "*#batch J 3"],
        left: Float[Array | np.ndarray, "*#batch K"] | None = None,
        right: Float[Array | np.ndarray, "*#batch L"] | None = None,
        *,
        flat: bool = False,
    ) -> Float[Array, "..."]:
        """A pose with its fingers as hand components say, in place of their rows in `pose`.

        A hand's 15 rotations are its mean plus coefficients times components (Romero et al. 2017,
        "Embodied Hands"), as the package smplx has it with `use_pca`. Pose files hold 6 to 45 of
        them (`load_poses` gives them as `left_hand` and `right_hand`).

        Args:
            pose: axis-angle, (..., J, 3).
            left, right: coefficients of the first components; None leaves that hand as it is. A
                MANO file has one hand.
            flat: leave the mean out, as smplx does with `flat_hand_mean=True`.

        Returns:
            The pose, in its dtype; batch axes broadcast.

        Raises:
            TypeError: an argument is not floating-point.
            ValueError: the body has no components of that hand, or fewer.

        Differentiation: every mode; the map is affine.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax.body import BodyModel, Hand, load_body
            >>> body = load_body()  # which has none of its own
            >>> joints = tuple(range(22, 37))
            >>> curl = jnp.zeros((1, 15, 3)).at[..., 2].set(-0.5).reshape(1, 45)
            >>> hand = Hand("left", joints, curl, jnp.zeros(45))
            >>> pose = body.replaced({"hands": (hand,)}).with_hands(
            ...     jnp.zeros((52, 3)), left=jnp.array([2.0])
            ... )
            >>> pose[22].tolist(), pose[37].tolist()
            ([0.0, 0.0, -1.0], [0.0, 0.0, 0.0])
        """
        return posed_hands(self.hands, floating("pose", pose), left, right, flat)

    def _coefficients(self, name: str, given, dtype: DTypeLike | None) -> Float[Array, "*batch B"]:
        betas = floating(name, given)
        most = self.num_shape if name == "shape" else self.num_expression
        if betas.ndim < 1 or betas.shape[-1] > most:
            raise ValueError(
                f"{name} must have at most {most} coefficients in its last axis: got "
                f"shape {tuple(betas.shape)}; drop the last ones, or load the body with a larger "
                f"num_{name} where its file has them."
            )
        return betas if dtype is None else betas.astype(dtype)
