"""The gradient of the overlap volume and the triangle rule's labels, as `overlap.boundary`."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from spt_jax.xla.arrays import take
from spt_jax.xla.levels import Intervals
from spt_jax.xla.strips import Ray

# Labels while they are collected: of several the largest is taken.
_CODE_INVERTED, _CODE_PENETRATING = 1, 2


def boundary_gradient(
    vertices: Float[Array, "V 3"],
    faces: Int[Array, "F 3"],
    intervals: Intervals,
    ray: Ray,
) -> Float[Array, "V 3"]:
    """One strip's share of the boundary integral; the shares of all beams add up to it."""
    corners = take(faces, intervals.ends.reshape(-1))
    normal = _area_normals(vertices, corners)
    # The weight does not depend on the normal's length; squares of tiny or huge ones would.
    longest = jnp.abs(normal).max(axis=1)
    normal = normal / jnp.where(longest > 0, longest, jnp.ones_like(longest))[:, None]
    seen = jnp.zeros_like(longest)
    for k in range(len(ray.directions)):
        seen = seen + _dot(normal, ray.directions[k]) ** 2
    outer = jnp.repeat(intervals.outer, 2).astype(normal.dtype)
    weight = outer * jnp.abs(_dot(normal, ray.direction)) * ray.area
    weight = weight / jnp.where(seen > 0, seen, jnp.ones_like(seen))
    force = weight[:, None] * normal
    shares = intervals.barycentric.reshape(-1, 3)[:, :, None] * force[:, None, :]
    return jnp.zeros_like(vertices).at[corners.reshape(-1)].add(shares.reshape(-1, 3))


def add_codes(
    codes: Int[Array, "V"], faces: Int[Array, "F 3"], intervals: Intervals
) -> Int[Array, "V"]:
    """Apply the triangle rule to the ends' corners: penetrating, then inverted, then clear."""
    outer = jnp.repeat(intervals.outer, 6)
    code = jnp.where(outer > 0, _CODE_PENETRATING, jnp.where(outer < 0, _CODE_INVERTED, 0))
    return codes.at[take(faces, intervals.ends.reshape(-1)).reshape(-1)].max(code)


def as_labels(codes: Int[Array, "V"]) -> Int[Array, "V"]:
    """The codes as labels: +1 penetrating, -1 inverted, 0 clear."""
    return jnp.where(codes == _CODE_PENETRATING, 1, jnp.where(codes == _CODE_INVERTED, -1, 0))


def vertex_gradient(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], label: Int[Array, "V"], *, unit: bool
) -> Float[Array, "V 3"]:
    """The paper's gradient: Eq. 9, or Eq. 10 where `unit` (zero where the normals cancel)."""
    normal = _area_normals(vertices, faces)
    gradient = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(normal, 3, axis=0))
    if unit:
        norm = jnp.sqrt((gradient * gradient).sum(axis=1, keepdims=True))
        gradient = gradient / jnp.where(norm > 0, norm, jnp.ones_like(norm))
    else:
        gradient = gradient / 6.0  # a third of the areas, and the normals are twice the area
    return gradient * label[:, None].astype(gradient.dtype)


def _area_normals(vertices: Float[Array, "V 3"], corners: Int[Array, "K 3"]) -> Float[Array, "K 3"]:
    a, b, c = (take(vertices, corners[:, k]) for k in range(3))
    return jnp.cross(b - a, c - a)


def _dot(vectors: Float[Array, "K 3"], axis: Float[Array, "3"]) -> Float[Array, "K"]:
    # Not a matrix product: accelerators round those to fewer bits.
    return (vectors * axis[None, :]).sum(axis=1)
