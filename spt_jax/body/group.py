"""Several people, or two hands, as one body, so that they are freed together."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax._groups import Pairs, between_groups, within_groups
from spt_jax.body.base import AbstractBody, PosedBody, floating
from spt_jax.body.model_check import checked_rows
from spt_jax.rest.surface import RestSurface


class BodyGroup(AbstractBody):
    """`count` people of one body model, or bodies of one family, as one body with one surface.

    `BodyGroup(body, 2)` is two people of one model, `BodyGroup([left, right])` a left and a right
    hand, or a man and a woman: models with the same numbers of joints, vertices and shape
    coefficients.

    A pose is (count * (J + 1), 3): of each person first the J rows of its own pose, then a row that
    says where the person is, in metres. Freed together (`untangle_pose`), people turn all joints
    but their roots, and move. Shapes follow each other, too: (count * B).

    Attributes:
        bodies: the different models.
        which: of each person, which of these.

    Raises:
        TypeError: a count with a list of bodies, or none with one body.
        ValueError: no people; a body whose poses are not rotations of joints; bodies that differ in
            their numbers of joints, vertices or shape coefficients.

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

    bodies: tuple[AbstractBody, ...]
    which: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, body: AbstractBody | Sequence[AbstractBody], count: int | None = None):
        alone = isinstance(body, AbstractBody)
        if alone != (count is not None):
            raise TypeError(
                "body must be one body with a count, or a list of bodies without: got "
                f"{'one body' if alone else 'a list'} and count {count!r}."
            )
        if isinstance(body, AbstractBody):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
                raise ValueError(f"count must be a positive whole number: got {count!r}.")
            everyone = [body] * int(count)
        else:
            everyone = list(body)
        if not everyone:
            raise ValueError("body must be a body, or a list of at least one: got an empty list.")
        kinds = {id(one): one for one in everyone}
        places = {key: k for k, key in enumerate(kinds)}
        self.bodies = tuple(kinds.values())
        self.which = tuple(places[id(one)] for one in everyone)

    def __check_init__(self):
        sizes = {(one.pose_shape, one.num_vertices, one.num_shape) for one in self.bodies}
        if len(sizes) > 1:
            raise ValueError(
                "bodies must have the same numbers of joints, vertices and shape coefficients: got "
                f"{', '.join(f'{p[0]}, {v:,} and {s}' for p, v, s in sorted(sizes))}."
            )
        if not all(one.pose_is_rotations for one in self.bodies):
            raise ValueError("body must have a pose that is rotations of joints, (J, 3).")

    @property
    def count(self) -> int:
        """How many people."""
        return len(self.which)

    @property
    def body(self) -> AbstractBody:
        """The first person's model."""
        return self.bodies[self.which[0]]

    @property
    def everyone(self) -> list[AbstractBody]:
        """Each person's model."""
        return [self.bodies[k] for k in self.which]

    @property
    def faces(self) -> Int[Array, "F 3"]:
        """Triangles of all people, one after the other."""
        step = self.body.num_vertices
        own = [jnp.asarray(one.faces) + k * step for k, one in enumerate(self.everyone)]
        return jnp.concatenate(own)

    @property
    def face_groups(self) -> Int[np.ndarray, "F"]:
        """Of each face, whose it is."""
        numbers = [len(one.faces) for one in self.everyone]
        return np.repeat(np.arange(self.count, dtype=np.int32), numbers)

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
        return jax.scipy.linalg.block_diag(*(one.weights for one in self.everyone))

    @property
    def parents(self) -> tuple[int, ...]:
        """The parents of all people's joints; each has a root."""
        joints = self.body.num_joints
        return tuple(
            p + k * joints if p >= 0 else -1
            for k, one in enumerate(self.everyone)
            for p in one.parents
        )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The names of all people's joints, each with its person's number."""
        return tuple(
            f"{k} {name}" for k, one in enumerate(self.everyone) for name in one.joint_names
        )

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
        if len(self.bodies) == 1:
            return self.body.rest_surface.copies(self.count)
        surfaces = [one.rest_surface for one in self.everyone]
        vertices, start = [], 0.0
        for one in self.everyone:  # side by side, so that nothing lies in another at rest
            rest = np.asarray(one(jnp.zeros(one.pose_shape)).vertices, np.float64)
            vertices.append(rest + np.array([start - rest[:, 0].min(), 0.0, 0.0]))
            start = vertices[-1][:, 0].max() + np.ptp(rest)
        distances = np.concatenate([surface.distances for surface in surfaces])
        return RestSurface(np.concatenate(vertices), self.faces, distances)

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
        people = [BodyGroup(one, 1) for one in self.everyone]
        return list(zip(people, rows, shapes, strict=True))

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
        if len(self.bodies) == 1:
            found = self.body(poses, shapes, places)
            return PosedBody(*(x.reshape(*x.shape[:-3], -1, 3) for x in found))
        each = [
            one(
                poses[..., k, :, :],
                None if shapes is None else shapes[..., k, :],
                places[..., k, :],
            )
            for k, one in enumerate(self.everyone)
        ]
        return PosedBody(*(jnp.concatenate(x, axis=-2) for x in zip(*each, strict=True)))

    def at_vertices(self, indices: Any) -> "BodyGroup":
        """The same people with some of their vertices only: those of the first, in each of them.

        Raises:
            TypeError, ValueError: as `BodyModel.at_vertices`, for the first person's.
        """
        rows = checked_rows(indices, self.body.num_vertices)
        kept = [one.at_vertices(rows) for one in self.bodies]
        return BodyGroup([kept[k] for k in self.which])
