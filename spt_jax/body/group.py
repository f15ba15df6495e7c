"""Several people of one body model as one body, so that they are freed together."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax._groups import Pairs, between_groups, within_groups
from spt_jax.body.base import AbstractBody, PosedBody, floating
from spt_jax.body.model_check import checked_rows
from spt_jax.rest.surface import RestSurface


class BodyGroup(AbstractBody):
    """`count` people of one body model, as one body with one surface.

    A pose is (count * (J + 1), 3): of each person first the J rows of its own pose, then a row that
    says where the person is, in metres. Freed together (`untangle_pose`), people turn all joints
    but their roots, and move. Shapes follow each other, too: (count * B).

    Attributes:
        body: whose people they are.
        count: how many.

    Raises:
        ValueError: no people; a body whose poses are not rotations of joints.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.body import BodyGroup
        >>> body = load_body()
        >>> pair = BodyGroup(body, 2)
        >>> pose = pair.pose_of(jnp.zeros((2, 52, 3)), jnp.array([[0.0, 0, 0], [0.5, 0, 0]]))
        >>> pose.shape, pair(pose).vertices.shape
        ((106, 3), (24544, 3))
    """

    body: AbstractBody
    count: int = eqx.field(static=True)

    def __check_init__(self):
        if self.count < 1:
            raise ValueError(f"count must be a positive whole number: got {self.count}.")
        if not self.body.pose_is_rotations:
            raise ValueError("body must have a pose that is rotations of joints, (J, 3).")

    @property
    def faces(self) -> Int[Array, "F 3"]:
        """Triangles of all people, one after the other."""
        step = jnp.arange(self.count, dtype=jnp.int32)[:, None, None] * self.body.num_vertices
        faces = jnp.broadcast_to(self.body.faces, (self.count, *self.body.faces.shape))
        return (faces + jnp.broadcast_to(step, faces.shape)).reshape(-1, 3)

    @property
    def face_groups(self) -> Int[np.ndarray, "F"]:
        """Of each face, whose it is."""
        return np.repeat(np.arange(self.count, dtype=np.int32), len(self.body.faces))

    @property
    def within(self) -> Pairs:
        """To ignore, so that only what is between people counts."""
        return within_groups(self.count)

    @property
    def between(self) -> Pairs:
        """To ignore, so that only what is within people counts."""
        return between_groups(self.count)

    @property
    def weights(self) -> Float[Array, "V J"]:
        """Skinning weights of all people."""
        return jnp.kron(jnp.eye(self.count, dtype=self.body.weights.dtype), self.body.weights)

    @property
    def parents(self) -> tuple[int, ...]:
        """The parents of all people's joints; each has a root."""
        joints, own = self.body.num_joints, self.body.parents
        return tuple(p + k * joints if p >= 0 else -1 for k in range(self.count) for p in own)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of all people's joints, each with its person's number."""
        return tuple(f"{k} {name}" for k in range(self.count) for name in self.body.joint_names)

    @property
    def num_vertices(self) -> int:
        """Number of vertices of all people."""
        return self.count * self.body.num_vertices

    @property
    def num_shape(self) -> int:
        """Number of shape coefficients of all people."""
        return self.count * self.body.num_shape

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """(count * (J + 1), 3)."""
        return (self.count * (self.body.pose_shape[0] + 1), 3)

    @property
    def pose_is_rotations(self) -> bool:
        """False: rows that say where people are stand between those that turn them."""
        return False

    @property
    def free_rows(self) -> Int[np.ndarray, "R"]:
        """What untangling moves: all joints but the roots, and where people are."""
        rows = self.body.pose_shape[0]
        own = np.append(self.body.free_rows, rows)
        return (np.arange(self.count)[:, None] * (rows + 1) + own).reshape(-1)

    @property
    def rest_surface(self) -> RestSurface:
        """That of the body, for each person: between people there are no folds."""
        return self.body.rest_surface.copies(self.count)

    def pose_of(
        self,
        poses: Float[Array | np.ndarray, "*batch N J 3"],
        translations: Float[Array | np.ndarray, "*batch N 3"],
    ) -> Float[Array, "*batch R 3"]:
        """The pose of the group from those of its people, and where they are, in metres."""
        given, places = floating("poses", poses), floating("translations", translations)
        rows = jnp.concatenate([given, places[..., None, :].astype(given.dtype)], axis=-2)
        return rows.reshape(*rows.shape[:-3], -1, 3)

    def people(
        self, pose: Float[Array | np.ndarray, "*batch R 3"]
    ) -> tuple[Float[Array, "*batch N J 3"], Float[Array, "*batch N 3"]]:
        """The poses of people, and where they are: the way back from `pose_of`."""
        rows = floating("pose", pose)
        rows = rows.reshape(*rows.shape[:-2], self.count, -1, 3)
        return rows[..., :-1, :], rows[..., -1, :]

    def alone(self, pose: Any, shape: Any) -> list[tuple["BodyGroup", Any, Any]]:
        """Each person as a group of one, with its pose and shape: what moves one moves no other."""
        rows = pose.reshape(self.count, -1, 3)
        shapes = [None] * self.count if shape is None else shape.reshape(self.count, -1)
        return [(BodyGroup(self.body, 1), rows[k], shapes[k]) for k in range(self.count)]

    def __call__(
        self,
        pose: Float[Array | np.ndarray, "..."],
        shape: Float[Array | np.ndarray, "..."] | None = None,
        translation: Float[Array | np.ndarray, "..."] | None = None,
    ) -> PosedBody:
        """All people's vertices and joints.

        Args:
            pose: (..., count * (J + 1), 3).
            shape: (..., count * B), each person's after the other.
            translation: of all together, in metres.

        Raises:
            TypeError, ValueError: as `BodyModel`.
        Differentiation: as the body's.
        """
        given = floating("pose", pose)
        if given.ndim < 2 or given.shape[-2:] != self.pose_shape:
            raise ValueError(f"pose must be (..., {self.pose_shape}): got {tuple(given.shape)}.")
        poses, places = self.people(given)
        shapes = None
        if shape is not None:
            betas = floating("shape", shape)
            if betas.shape[-1] % self.count:
                raise ValueError(
                    f"shape must have the same number of coefficients for each of {self.count} "
                    f"people: got {betas.shape[-1]} in all."
                )
            shapes = betas.reshape(*betas.shape[:-1], self.count, -1)
        if translation is not None:
            whole = floating("translation", translation).astype(given.dtype)[..., None, :]
            common = jnp.broadcast_shapes(places.shape, whole.shape)
            places = jnp.broadcast_to(places, common) + jnp.broadcast_to(whole, common)
        found = self.body(poses, shapes, places)
        return PosedBody(*(x.reshape(*x.shape[:-3], -1, 3) for x in found))

    def at_vertices(self, indices: Any) -> "BodyGroup":
        """The same people with some of their vertices only: those of the first, in each of them.

        Raises:
            TypeError, ValueError: as `BodyModel.at_vertices`, for the first person's.
        """
        rows = checked_rows(indices, self.body.num_vertices)
        return BodyGroup(self.body.at_vertices(rows), self.count)
