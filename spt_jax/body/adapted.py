"""Bodies of the package body-models as bodies of this one."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax.body import poses
from spt_jax.body.base import AbstractBody, PosedBody, broadcast_batches, floating
from spt_jax.body.fold_distances import fold_distances
from spt_jax.body.model_check import checked_rows
from spt_jax.body.model_rotations import MATRICES, as_rotation, as_written, axis_of
from spt_jax.rest.surface import RestSurface

TURN, _PLACE = "global_rotation", "global_translation"


class AdaptedBody(AbstractBody):
    """A body of the package body-models, or another with its interface; `adapt` makes it.

    Where its pose is rotations, a pose is axis-angle (J, 3) as that of `BodyModel`: row 0 turns the
    whole, the others are in the order of the joints that they turn. Where its pose is numbers of
    another kind (MHR, SKEL), a pose is all of them, (P,), in the order of the model's parameters.
    `parameters` gives the model's own arguments, and `pose_of` comes back from them.

    Attributes:
        leaves, structure: the model taken apart; its own classes are no trees that transformations
            could go through.
        faces: triangles; of quads both halves.
        weights: skinning weights.
        parents, joint_names: the model's skeleton.
        rows: of each row of a pose which parameter it is, which of its rotations, and the name of
            the joint that it turns; None where the pose is no rotations.
        kind: how the model that was given writes rotations; `model` takes matrices where it can,
            whose derivatives are finite in either mode.
        only: which vertices are left; None for all.
    """

    leaves: tuple[Any, ...]
    structure: Any = eqx.field(static=True)
    faces: Int[Array, "F 3"]
    weights: Float[Array, "V J"]
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    rows: tuple[tuple[str, int, str], ...] | None = eqx.field(static=True)
    kind: str | None = eqx.field(static=True, default=None)
    only: Int[Array, "V"] | None = None

    @property
    def model(self) -> Any:
        """The model."""
        return jax.tree.unflatten(self.structure, self.leaves)

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.weights.shape[0]

    @property
    def num_shape(self) -> int:
        """Number of identity coefficients: shape, and where there are any expression and scales."""
        return sum(size for _, size in self._sizes("identity"))

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """(J, 3) where the pose is rotations, otherwise (P,)."""
        if self.rows is not None:
            return (len(self.rows), 3)
        return (sum(size for _, size in self._sizes("pose")),)

    @property
    def pose_is_rotations(self) -> bool:
        """Whether the model's pose is rotations."""
        return self.rows is not None

    @property
    def free_rows(self) -> Int[np.ndarray, "R"]:
        """Rows of a pose that untangling moves: all but the one that turns the whole."""
        return np.arange(1 if self.rows is not None else 0, self.pose_shape[0])

    @property
    def rest_pose(self) -> Float[Array, "..."]:
        """The pose at rest."""
        if self.rows is not None:
            return jnp.zeros(self.pose_shape)
        parts = [jnp.full(size, self._spec[name].default) for name, size in self._sizes("pose")]
        return jnp.concatenate(parts)

    @property
    def rest_surface(self) -> RestSurface:
        """The surface at rest, with distances by the girth of what each joint moves.

        As `BodyModel.rest_surface`; make it once, it poses the model.
        """
        posed = self(self.rest_pose)
        order = _parents_first(self.parents)
        place = {joint: k for k, joint in enumerate(order)}
        parents = [place[self.parents[j]] if self.parents[j] >= 0 else -1 for j in order]
        faces = np.asarray(self.faces, np.int64)
        vertices = np.asarray(posed.vertices, np.float64)
        weights, joints = np.asarray(self.weights)[:, order], np.asarray(posed.joints)[order]
        allowed = fold_distances(vertices, faces, weights, joints.astype(float), parents)
        return RestSurface(posed.vertices, self.faces, allowed)

    def pose_from_smpl(self, pose: Float[Array | np.ndarray, "..."]) -> Float[Array, "*batch J 3"]:
        """A pose from one of SMPL's layouts, by the names of joints, as `BodyModel` has it.

        Raises:
            ValueError: the model's pose is not rotations, or its joints have none of SMPL's names.
        """
        names = tuple(name for _, _, name in self.rows or ())
        if "left_knee" not in names:
            raise ValueError(
                "pose_from_smpl needs a body whose pose is rotations of joints with SMPL's names: "
                f"got {type(self.model).__name__} with {', '.join(self.joint_names[:6])}, ...; "
                "make its own pose with pose_of."
            )
        return poses.pose_from_smpl(pose, names)

    def __call__(
        self,
        pose: Float[Array | np.ndarray, "..."],
        shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
    ) -> PosedBody:
        """The model's vertices and joints in a pose.

        Args:
            pose: (..., *pose_shape).
            shape: identity coefficients one after the other, such as shape and expression; fewer
                leave the rest at the model's default.
            translation: in metres.

        Raises:
            TypeError, ValueError: as `BodyModel`.
        Differentiation: as the model's, and at the zero pose.
        """
        return _posed(self, pose, shape, translation)

    def parameters(
        self,
        pose: Float[Array | np.ndarray, "..."],
        shape: Float[Array | np.ndarray, "*#batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
    ) -> dict[str, Array]:
        """The given model's own arguments: `given.forward_vertices(**body.parameters(pose))`.

        Rotations are written as the model that was given to `adapt` writes them.

        Args, Raises: as a call.
        """
        return self.arguments(pose, shape, translation, self.kind)

    def arguments(self, pose: Any, shape: Any, translation: Any, kind: str | None = None) -> Any:
        """The arguments of `model`, or with rotations of another kind."""
        given = floating("pose", pose)
        own = self.pose_shape
        if given.ndim < len(own) or given.shape[given.ndim - len(own) :] != own:
            raise ValueError(f"pose must have shape (..., {own}): got {tuple(given.shape)}.")
        dtype = given.dtype
        betas = jnp.zeros((0,), dtype) if shape is None else floating("shape", shape).astype(dtype)
        if betas.ndim < 1 or betas.shape[-1] > self.num_shape:
            raise ValueError(
                f"shape must have at most {self.num_shape} coefficients: got {betas.shape}."
            )
        place = jnp.zeros((3,), dtype)
        if translation is not None:
            place = floating("translation", translation).astype(dtype)
        batch = broadcast_batches(
            pose=given.shape[: given.ndim - len(own)],
            shape=betas.shape[:-1],
            translation=place.shape[:-1],
        )
        found = {_PLACE: jnp.broadcast_to(place, (*batch, 3))}
        start = 0
        for name, size in self._sizes("identity"):
            values = betas[..., start : start + size]
            default = jnp.full((size - values.shape[-1],), self._spec[name].default, dtype)
            parts = [jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in (values, default)]
            found[name] = jnp.concatenate(parts, axis=-1)
            start += size
        given = jnp.broadcast_to(given, (*batch, *own))
        if self.rows is None:
            return found | self._numbers(given)
        return found | self._turns(given, kind)

    def pose_of(self, parameters: Mapping[str, Any]) -> Float[Array, "..."]:
        """The pose that stands for the model's own arguments; what is missing is at rest.

        Raises:
            TypeError: an argument is not floating-point.
        """
        if self.rows is None:
            parts = []
            for name, size in self._sizes("pose"):
                default = jnp.full(size, self._spec[name].default)
                parts.append(floating(name, parameters.get(name, default)))
            return jnp.concatenate(parts, axis=-1)
        from nanomanifold import SO3

        rows = []
        for name, k, _ in self.rows:
            kind = self.kind or self._spec[name].rotation_type
            if name not in parameters:
                rows.append(jnp.zeros(3))
                continue
            value = floating(name, parameters[name])
            value = value if self._is_single(name) else jnp.moveaxis(value, axis_of(kind), 0)[k]
            with as_written():
                rows.append(SO3.convert(value, src=kind, dst="axis_angle", xp=jnp))  # type: ignore
        batch = jnp.broadcast_shapes(*(row.shape for row in rows))
        return jnp.stack([jnp.broadcast_to(row, batch) for row in rows], axis=-2)

    def at_vertices(self, indices: Any) -> "AdaptedBody":
        """The same body with some of its vertices only, and no faces.

        Raises:
            TypeError, ValueError: as `BodyModel.at_vertices`.
        """
        rows = jnp.asarray(checked_rows(indices, self.num_vertices))
        kept = rows if self.only is None else self.only[rows]
        return AdaptedBody(
            self.leaves,
            self.structure,
            jnp.zeros((0, 3), jnp.int32),
            self.weights[rows],
            self.parents,
            self.joint_names,
            self.rows,
            self.kind,
            kept,
        )

    @property
    def _spec(self) -> Mapping[str, Any]:
        return self.model.parameter_spec

    def _sizes(self, role: str) -> list[tuple[str, int]]:
        return [
            (name, int(np.prod(spec.dims)))
            for name, spec in self._spec.items()
            if spec.role == role
        ]

    def _is_single(self, name: str) -> bool:
        """Whether a parameter is one rotation, and no list of them."""
        spec = self._spec[name]
        return len(spec.dims) == (2 if spec.rotation_type in MATRICES else 1)

    def _numbers(self, pose) -> dict[str, Array]:
        found, start = {}, 0
        for name, size in self._sizes("pose"):
            found[name] = pose[..., start : start + size]
            start += size
        rest = jnp.zeros((*pose.shape[:-1], 3), pose.dtype)
        return found | {TURN: as_rotation(rest, self._spec[TURN].rotation_type)}

    def _turns(self, pose, kind: str | None) -> dict[str, Array]:
        rows: dict[str, list[tuple[int, int]]] = {}
        for row, (name, k, _) in enumerate(self.rows or ()):
            rows.setdefault(name, []).append((k, row))
        found = {}
        for name in (name for name, spec in self._spec.items() if spec.rotation_type is not None):
            own = kind or self._spec[name].rotation_type
            if name not in rows:  # the model's root has a rotation of its own
                found[name] = as_rotation(jnp.zeros_like(pose[..., 0, :]), own)
                continue
            chosen = np.array([row for _, row in sorted(rows[name])])
            turned = as_rotation(pose[..., chosen, :], own)
            found[name] = jnp.squeeze(turned, axis_of(own)) if self._is_single(name) else turned
        return found


def _parents_first(parents: tuple[int, ...]) -> list[int]:
    """Joints in an order in which every parent comes before its children."""
    depth = []
    for joint in range(len(parents)):
        steps, at = 0, joint
        while parents[at] >= 0:
            at, steps = parents[at], steps + 1
        depth.append(steps)
    return sorted(range(len(parents)), key=lambda joint: (depth[joint], joint))


# Compiled as a whole: one by one the model's operations take half a minute the first time.
@eqx.filter_jit
def _posed(body: AdaptedBody, pose, shape, translation) -> PosedBody:
    given = body.arguments(pose, shape, translation)
    with as_written():
        vertices = body.model.forward_vertices(**given)
        skeleton = body.model.forward_skeleton(**given)
    if body.only is not None:
        vertices = vertices[..., body.only, :]
    return PosedBody(vertices, skeleton[..., :3, 3])
