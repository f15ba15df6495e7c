"""A function of a pose as a body."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from spt_jax.body.base import AbstractBody, PosedBody, floating
from spt_jax.body.model_check import checked_rows
from spt_jax.rest.surface import RestSurface, local_distances


class FunctionBody(AbstractBody):
    """A function of a pose, with a surface: `adapt(function, faces=, rest_pose=)` makes it.

    It has no joints; its parts are the connected components of its faces.

    Attributes:
        function: pose to vertices (V, 3).
        faces: triangles.
        rest: the pose at rest.
        weights: of each vertex 1 for its part.
    """

    function: Callable[[Array], Array]
    faces: Int[Array, "F 3"]
    rest: Float[Array, "..."]
    weights: Float[Array, "V J"]
    parents: tuple[int, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    only: Int[Array, "V"] | None = None

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.weights.shape[0]

    @property
    def num_shape(self) -> int:
        """None: the function has what it needs."""
        return 0

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """That of the pose at rest."""
        return tuple(self.rest.shape)

    @property
    def pose_is_rotations(self) -> bool:
        """False: what a pose means is the function's."""
        return False

    @property
    def free_rows(self) -> Int[np.ndarray, "R"]:
        """All rows of a pose."""
        return np.arange(self.pose_shape[0])

    @property
    def rest_surface(self) -> RestSurface:
        """The surface at rest, with distances by how thick the solid is (`local_distances`)."""
        vertices = np.asarray(self(self.rest).vertices, np.float64)
        faces = np.asarray(self.faces, np.int64)
        return RestSurface(vertices, self.faces, local_distances(vertices, faces))

    def __call__(
        self,
        pose: Float[Array | np.ndarray, "..."],
        shape: Float[Array | np.ndarray, "*batch B"] | None = None,
        translation: Float[Array | np.ndarray, "*#batch 3"] | None = None,
    ) -> PosedBody:
        """The vertices of a pose, and no joints.

        Raises:
            ValueError: a pose of another shape, or a shape, which a function does not take.
        """
        given = floating("pose", pose)
        own = self.pose_shape
        batch = given.shape[: given.ndim - len(own)]
        if given.shape[len(batch) :] != own:
            raise ValueError(f"pose must have shape (..., {own}): got {tuple(given.shape)}.")
        if shape is not None and np.shape(shape)[-1:] != (0,):
            raise ValueError("shape goes into the function: got one; make a function of the pose.")
        vertices = jnp.vectorize(self.function, signature=_signature(len(own)))(given)
        if self.only is not None:
            vertices = vertices[..., self.only, :]
        if translation is not None:
            place = floating("translation", translation).astype(vertices.dtype)[..., None, :]
            shape_of = jnp.broadcast_shapes(vertices.shape, place.shape)
            vertices = jnp.broadcast_to(vertices, shape_of) + jnp.broadcast_to(place, shape_of)
        return PosedBody(vertices, jnp.zeros((*vertices.shape[:-2], len(self.parents), 3)))

    def at_vertices(self, indices: Any) -> "FunctionBody":
        """The same with some of its vertices only, and no faces.

        Raises:
            TypeError, ValueError: as `BodyModel.at_vertices`.
        """
        rows = jnp.asarray(checked_rows(indices, self.num_vertices))
        return FunctionBody(
            self.function,
            jnp.zeros((0, 3), jnp.int32),
            self.rest,
            self.weights[rows],
            self.parents,
            self.joint_names,
            rows if self.only is None else self.only[rows],
        )


def body_of_function(function: Callable, faces: Any, rest_pose: Any) -> FunctionBody:
    """A body of a function, its faces, and a pose in which nothing collides.

    Raises:
        ValueError: faces or rest_pose is missing, or does not fit.
    """
    if faces is None or rest_pose is None:
        raise ValueError(
            "faces and rest_pose must be given with a function: got none; rest_pose is a pose in "
            "which nothing collides."
        )
    rest = floating("rest_pose", rest_pose)
    if rest.ndim < 1:
        raise ValueError("rest_pose must be an array: got one number; write jnp.array([x]).")
    out = jax.eval_shape(function, rest)
    if out.ndim != 2 or out.shape[1] != 3:
        raise ValueError(f"model must return vertices (V, 3): got shape {out.shape}.")
    corners = np.asarray(faces)
    count = out.shape[0]
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.issubdtype(corners.dtype, np.integer):
        raise ValueError(f"faces must be triangles, (F, 3): got shape {corners.shape}.")
    if corners.size and not 0 <= corners.min() <= corners.max() < count:
        raise ValueError(
            f"faces must index into vertices: got {corners.min()} to {corners.max()} for {count}."
        )
    tail, head = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    links = scipy.sparse.coo_array((np.ones(len(tail)), (tail, head)), shape=(count, count))
    parts, part = scipy.sparse.csgraph.connected_components(links, directed=False)
    return FunctionBody(
        function,
        jnp.asarray(corners, jnp.int32),
        rest,
        jnp.asarray(np.eye(parts)[part], out.dtype),
        (-1,) * parts,
        tuple(f"part {k}" for k in range(parts)),
    )


def _signature(rank: int) -> str:
    return f"({','.join(f'p{k}' for k in range(rank))})->(v,c)"
