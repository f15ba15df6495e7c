"""Laplacian regularization, the paper's rival "RE + LR": vertices move as their neighbors do."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Integer

from spt_jax._query import as_mesh
from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.regularizers._base import Regularizer, as_weights
from spt_jax.overlap.topology import Edges


class MeshLaplacian(eqx.Module):
    """The uniform Laplacian of a mesh (Wang et al. 2018, section 3.3).

    delta_p = p - mean of p's neighbors; zero for a vertex without any. Make one with `from_faces`,
    once and outside `jit`; it is a pytree.

    Attributes:
        edges: both ends of every edge, each edge once.
        valence: how many neighbors each vertex has.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.regularizers.laplacian import MeshLaplacian, laplacian_penalty
        >>> body = load_body()
        >>> laplacian = MeshLaplacian.from_faces(body.faces, body.num_vertices)
        >>> rest = body.rest()
        >>> bool(laplacian_penalty(laplacian, rest, rest + 0.25) < 1e-12)  # moved as a whole
        True
    """

    edges: Int[Array, "E 2"]
    valence: Int[Array, "V"]

    @classmethod
    def from_faces(
        cls, faces: Integer[Array, "F 3"] | np.ndarray, num_vertices: int
    ) -> "MeshLaplacian":
        """The Laplacian of a mesh; an edge counts once, however many triangles share it.

        Args:
            faces: indices of each triangle's corners.
            num_vertices: of the mesh, those included that no triangle uses.

        Raises:
            TypeError: faces are traced or no whole numbers.
            ValueError: faces are not (F, 3), or index beyond the vertices.
        """
        if isinstance(faces, Tracer):
            raise TypeError(
                "faces must be known: got a traced array; make the Laplacian outside jit, vmap "
                "and grad, and pass it in."
            )
        as_mesh(np.zeros((num_vertices, 3), np.float32), faces)
        ends = Edges(np.asarray(faces, np.int64)).ends
        ends = ends[ends[:, 0] != ends[:, 1]]
        valence = np.bincount(ends.ravel(), minlength=num_vertices)
        return cls(jnp.asarray(ends, jnp.int32), jnp.asarray(valence, jnp.int32))

    def coordinates(self, vertices: Float[Array, "*batch V 3"]) -> Float[Array, "*batch V 3"]:
        """The Laplacian coordinates delta of every vertex, in the vertices' unit.

        Args:
            vertices: positions of one mesh or of a batch.

        Raises:
            ValueError: another number of vertices than the mesh has.

        Differentiation: every mode; the map is linear.
        """
        self._check("vertices", vertices)
        # Scatters over the edges: with the gradient 1.4 ms for 12,272 vertices on two CPU cores. A
        # padded table of neighbors took 1.9 ms, since the gradient of a gather is a scatter, and
        # 0.8 with a hand-written transpose; a sparse matrix product took 1.9.
        first, second = self.edges[:, 0], self.edges[:, 1]
        total = jnp.zeros_like(vertices)
        total = total.at[..., first, :].add(vertices[..., second, :])
        total = total.at[..., second, :].add(vertices[..., first, :])
        valence = self.valence.reshape((1,) * (vertices.ndim - 2) + (-1, 1))
        mean = total / jnp.maximum(valence, 1).astype(vertices.dtype)
        return jnp.where(valence > 0, vertices - mean, 0.0)

    def _check(self, name: str, vertices: Array) -> None:
        if vertices.ndim < 2 or vertices.shape[-2:] != (len(self.valence), 3):
            raise ValueError(
                f"{name} must have shape (..., {len(self.valence)}, 3), as the mesh that this "
                f"Laplacian is of: got {vertices.shape}."
            )


@jax.jit
def laplacian_penalty(
    laplacian: MeshLaplacian,
    reference: Float[Array, "*#batch V 3"],
    vertices: Float[Array, "*#batch V 3"],
) -> Float[Array, "*batch"]:
    """How far the Laplacian coordinates have moved, as a loss.

    The mean over vertices of |delta'_p - delta_p|^2: the l_lap of Wang et al. 2018 divided by the
    number of vertices, so that one weight serves meshes of any density. Translating the mesh costs
    nothing; turning it costs, so a body is to be given in its own frame. It keeps surfaces from
    bending sharply, and knows nothing of intersections.

    Args:
        laplacian: of the mesh.
        reference: positions before the fit.
        vertices: positions now; batch axes of both broadcast.

    Returns:
        One number per mesh, in the square of the vertices' unit.

    Raises:
        ValueError: another number of vertices than the mesh has.

    Differentiation: every mode, with respect to both.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from spt_jax.fit.regularizers.laplacian import MeshLaplacian, laplacian_penalty
        >>> square = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        >>> two = MeshLaplacian.from_faces(np.array([[0, 1, 2], [0, 2, 3]]), 4)
        >>> lifted = square.at[1, 2].set(3.0)  # deltas change by 3, -1, -1 and 0
        >>> float(laplacian_penalty(two, square, lifted))
        2.75
    """
    laplacian._check("reference", reference)
    laplacian._check("vertices", vertices)
    # Of the difference, since the map is linear: one pass, and no cancellation at small steps.
    rank = max(reference.ndim, vertices.ndim)
    reference = reference.reshape((1,) * (rank - reference.ndim) + reference.shape)
    vertices = vertices.reshape((1,) * (rank - vertices.ndim) + vertices.shape)
    moved = laplacian.coordinates(vertices - reference)
    return jnp.mean(jnp.sum(moved**2, axis=-1), axis=-1)


class Laplacian(Regularizer):
    """Laplacian regularization ("RE + LR", Wang et al. 2018), in mm^2.

    What bends the surface costs, wherever it lies: the mean squared change of the Laplacian
    coordinates since the first stage began, in the body's own frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Laplacian
        >>> body = load_body()
        >>> shape, translation = jnp.zeros((1, body.num_shape)), jnp.zeros((1, 3))
        >>> rest = Variables(jnp.zeros((1, body.num_joints, 3)), shape, translation)
        >>> turned = rest._replace(pose=rest.pose.at[0, 0, 1].set(1.0))
        >>> bent = rest._replace(pose=rest.pose.at[0, 4, 0].set(1.0))
        >>> term = Laplacian().prepared(body, 1)
        >>> [bool(term.energy(body, rest, now) > 0) for now in (turned, bent)]
        [False, True]
    """

    name: ClassVar[str] = "laplacian"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(1.0,))
    laplacian: MeshLaplacian | None = None

    def prepared(self, body: BodyModel, people: int) -> "Laplacian":
        """With the neighbors of the body's vertices."""
        if self.laplacian is not None:
            return self
        found = MeshLaplacian.from_faces(np.asarray(body.faces), body.num_vertices)
        return dataclasses.replace(self, laplacian=found)

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Mean squared change of the Laplacian coordinates, in mm^2, summed over the people."""
        if self.laplacian is None:
            raise ValueError("laplacian must be known: call prepared(body, people) first.")

        def own_frame(variables: Variables) -> Array:
            pose = variables.pose.at[..., 0, :].set(0.0)
            return body(pose, variables.shape).vertices

        reference = jax.lax.stop_gradient(own_frame(start))
        return jnp.sum(laplacian_penalty(self.laplacian, reference, own_frame(now))) * 1e6
