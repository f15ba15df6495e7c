"""What every body has: vertices of a pose, faces, joints, and the surface at rest."""

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax._groups import Pairs, neighbor_pairs, part_groups
from spt_jax.body import poses
from spt_jax.rest.surface import RestSurface


class PosedBody(NamedTuple):
    """A body in a pose: `vertices` (..., V, 3) and `joints` (..., J, 3), in metres."""

    vertices: Float[Array, "*batch V 3"]
    joints: Float[Array, "*batch J 3"]


class AbstractBody(eqx.Module):
    """What `untangle_pose` and the live view take: a surface that a pose moves.

    `BodyModel`, `RigModel` and what `adapt` returns are such bodies. A subclass has the attributes
    `faces`, `parents`, `joint_names` and `weights`, and what is abstract here.
    """

    if TYPE_CHECKING:  # which takes what is to be overridden for fields of every subclass

        @property
        def faces(self) -> Any:  # noqa: D102
            ...

        @property
        def parents(self) -> tuple[int, ...]:  # noqa: D102
            ...

        @property
        def joint_names(self) -> tuple[str, ...]:  # noqa: D102
            ...

        @property
        def weights(self) -> Any:  # noqa: D102
            ...
    else:
        faces: eqx.AbstractVar[Int[Array, "F 3"]]
        parents: eqx.AbstractVar[tuple[int, ...]]
        joint_names: eqx.AbstractVar[tuple[str, ...]]
        weights: eqx.AbstractVar[Any]

    @abstractmethod
    def __call__(self, pose, shape=None, translation=None) -> PosedBody:
        """Vertices and joints of a pose, (..., J, 3); any number of leading batch axes."""

    @abstractmethod
    def at_vertices(self, indices: Any) -> "AbstractBody":
        """The same body with some of its vertices only, and no faces."""

    @property
    @abstractmethod
    def num_vertices(self) -> int:
        """Number of vertices."""

    @property
    @abstractmethod
    def num_shape(self) -> int:
        """Number of shape coefficients."""

    @property
    @abstractmethod
    def rest_surface(self) -> RestSurface:
        """The body's surface at rest, by which the penalty recognizes folds."""

    @property
    def num_joints(self) -> int:
        """Number of joints, the root included."""
        return len(self.parents)

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """The shape of one pose."""
        return (self.num_joints, 3)

    @property
    def pose_is_rotations(self) -> bool:
        """Whether each row of a pose is the axis-angle of a joint, row 0 of the root."""
        return True

    @property
    def free_rows(self) -> Int[np.ndarray, "R"]:
        """Rows of a pose that untangling moves: all joints but the root."""
        return np.arange(1, self.num_joints)

    @property
    def part_groups(self) -> Int[np.ndarray, "F"]:
        """Of each face, the joint that moves it most (`joint_names` says which).

        By the mean skinning weight over its corners. With `ignore_groups=body.neighbor_pairs`,
        overlaps of parts that meet at a joint are excluded.

        Raises:
            TypeError: as `rest_surface`.

        Example:
            >>> from spt_jax.body import load_body
            >>> body = load_body()
            >>> body.joint_names[body.part_groups[body.template[body.faces[:, 0], 1].argmax()]]
            'head'
        """
        return part_groups(self.weights, self.faces)

    @property
    def neighbor_pairs(self) -> Pairs:
        """Each part with itself and with its parent's, as pairs of joints for `ignore_groups`.

        Example:
            >>> from spt_jax.body import load_body
            >>> (4, 7) in load_body().neighbor_pairs  # left knee, left ankle
            True
        """
        return neighbor_pairs(self.parents)

    def pose_from_smpl(self, pose: Float[Array | np.ndarray, "..."]) -> Float[Array, "*batch J 3"]:
        """This body's pose from a pose of 22, 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints.

        Rotations are copied by joint name. Joints that the pose lacks stay at rest; joints that
        this body lacks are dropped: on the embedded body SMPL-X's jaw and eyes and SMPL's two
        lumped hand joints.

        Args:
            pose: axis-angle, in radians, as (..., joints, 3) or flat as (..., 3 * joints).

        Returns:
            A pose for this body, in the dtype of `pose`.

        Raises:
            TypeError, ValueError: `pose` is not floating-point, or has none of those shapes.
        Differentiation: every mode; the map is linear.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax.body import load_body
            >>> body = load_body()
            >>> body.pose_from_smpl(jnp.zeros((8, 72))).shape
            (8, 52, 3)
        """
        return poses.pose_from_smpl(pose, self.joint_names)


def floating(name: str, value: Any) -> Float[Array, "..."]:
    """An argument as an array, once it is floating-point.

    Raises:
        TypeError: it is not.
    """
    array = jnp.asarray(value)
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError(
            f"{name} must be floating-point: got dtype {array.dtype}; "
            f"convert it with {name}.astype('float32')."
        )
    return array


def broadcast_batches(**batches: tuple[int, ...]) -> tuple[int, ...]:
    """The batch axes of all arguments together.

    Raises:
        ValueError: they do not broadcast.
    """
    try:
        return jnp.broadcast_shapes(*batches.values())
    except ValueError as error:
        seen = ", ".join(f"{name} {batch}" for name, batch in batches.items())
        raise ValueError(
            f"batch axes must broadcast against each other: got {seen}; make them equal or 1."
        ) from error
