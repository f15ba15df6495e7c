"""Small differentiable functions of a mesh's shape, in pure JAX."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer

from spt_jax._query import as_mesh
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.overlap.inflation import FARTHEST, SHARPNESS


def inflate(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    distance: float | Float[Array, ""],
) -> Float[Array, "*batch V 3"]:
    """The mesh with every triangle moved outwards by `distance` or a little more.

    A vertex moves along its angle-weighted normal n by distance / min(n . n_f) over the triangles
    f around it, at most three distances (a mitre): then every triangle, seen along its own normal,
    lies `distance` farther out than before, or more. The minimum is a smooth one, weighted by
    angles, so that there is a gradient where triangles lie in one plane too; a triangle with a
    twentieth of the angle may lie 0.04 % less far out. Angles, not areas, weigh the normals, so
    that n does not depend on how a flat side is cut into triangles.

    Two sheets that do not overlap after both moved by m / 2 are m apart; that is the penalty's
    `margin`. Three things limit it: a tip sharper than 39 degrees moves less than it should, a
    concave crease narrower than the distance folds into itself, and a part that is inside out
    moves inwards, since its outside is there.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        distance: how far, in the vertices' unit; negative deflates.

    Returns:
        The moved vertices, in the dtype of `vertices`. A vertex without a normal stays: one that no
        triangle uses, or only triangles without an area, or whose normals cancel. A vertex
        that is not finite stays so and is taken as the origin by its neighbors.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`, for vertices and faces.

    Differentiation: every mode; finite for every finite mesh, and right to central differences
        also where several triangles share the least n . n_f, as on flat sides and at a box's
        corner.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax._geometry import inflate
        >>> box = trimesh.creation.box()
        >>> larger = inflate(jnp.asarray(box.vertices, "float32"), box.faces, 0.1)
        >>> print(larger.max(axis=0))
        [0.6 0.6 0.6]
    """
    vertices, faces = as_mesh(vertices, faces)
    return _inflated(None, vertices, faces, jnp.asarray(distance, vertices.dtype))


def _inflate(_, vertices, faces, distance):
    finite = jnp.where(jnp.isfinite(vertices), vertices, 0.0)
    normal, angle = _normals_and_angles(finite, faces)
    corner = faces.reshape(-1)
    pull = (angle[..., None] * normal[..., None, :]).reshape(*vertices.shape[:-2], -1, 3)
    direction, _ = _unit(jnp.zeros_like(finite).at[..., corner, :].add(pull))
    cosine = jnp.sum(direction[..., faces, :] * normal[..., None, :], axis=-1)
    cosine = jnp.where(angle > 0, cosine, 1.0).reshape(*vertices.shape[:-2], -1)
    needed = 1 / jnp.maximum(cosine, 1 / FARTHEST)
    nothing = jnp.zeros_like(finite[..., 0])
    largest = jax.lax.stop_gradient(nothing.at[..., corner].max(needed))
    weight = angle.reshape(*vertices.shape[:-2], -1)
    above = jnp.exp(SHARPNESS * (needed - largest[..., corner])) * weight
    total = nothing.at[..., corner].add(weight)
    mean = nothing.at[..., corner].add(above)
    solid = (mean > 0) & (total > 0)
    mean = jnp.where(solid, mean, 1.0) / jnp.where(solid, total, 1.0)
    mitre = jnp.where(solid, largest + jnp.log(mean) / SHARPNESS, 1.0)
    return vertices + distance * mitre[..., None] * direction


_inflated = BoundedJit(_inflate)


def _normals_and_angles(vertices, faces):
    """Unit normals (..., F, 3) and the angles at the corners (..., F, 3); zero without an area."""
    corners = vertices[..., faces, :]
    along = jnp.roll(corners, -1, axis=-2) - corners
    # Angles and directions do not change with the scale, so it needs no derivative; dividing by it
    # keeps the squares of tiny and huge edges from under- and overflowing.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(along), axis=(-2, -1), keepdims=True))
    usable = (scale > jnp.finfo(scale.dtype).tiny) & jnp.isfinite(scale)
    along = jnp.where(usable, along, 0.0) / jnp.where(usable, scale, 1.0)
    normal, twice_area = _unit(jnp.cross(along[..., 0, :], along[..., 1, :]))
    facing = -jnp.sum(along * jnp.roll(along, 1, axis=-2), axis=-1)
    solid = twice_area[..., None] > 0
    angle = jnp.arctan2(twice_area[..., None], jnp.where(solid, facing, 1.0))
    return normal, jnp.where(solid, angle, 0.0)


def _unit(vector):
    """Direction and length of vectors of about unit size; both zero where rounding decides."""
    square = jnp.sum(vector**2, axis=-1)
    told = square > (16 * jnp.finfo(vector.dtype).eps) ** 2
    length = jnp.sqrt(jnp.where(told, square, 1.0))
    return (
        jnp.where(told[..., None], vector / length[..., None], 0.0),
        jnp.where(told, length, 0.0),
    )
