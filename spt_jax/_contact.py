"""Contact that is wanted: patches of a surface that shall touch."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Integer

from spt_jax._query import as_faces, as_margin, as_vertices
from spt_jax.bridge.callback import call_on_host
from spt_jax.overlap.nearest import nearest_points

Patch = Integer[np.ndarray, "_"] | Sequence[int]


class _Known(NamedTuple):
    """What stays the same, hashable: how many pairs there are."""

    pairs: int


def contact_penalty(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    pairs: Sequence[tuple[Patch, Patch]],
    *,
    margin: float = 0.0,
) -> Float[Array, "*batch"]:
    """How far patches that shall touch are from that: the sum of their squared distances.

    With d the distance of two patches, of the two of their points that are nearest, a pair adds
    max(d - margin, 0)^2. It is zero, with a zero gradient, where the patches touch or intersect:
    there `self_intersection_penalty` takes over, which is zero where they touch or are apart. With
    the same margin in both the two agree about where the surface is: sheets that face each other
    at that distance are neither too far nor too near.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners; known when traced.
        pairs: for each pair of patches the numbers of the triangles of the one and of the other,
            such as `np.flatnonzero(body.part_groups == joint)`; known when traced.
        margin: the distance at which the patches touch, in the vertices' unit.

    Returns:
        One number per mesh, in the square of the unit and the vertices' dtype; NaN where a vertex
        of a patch is not finite.

    Raises:
        TypeError: vertices not float32 or float64; faces or pairs traced, or not whole numbers.
        ValueError: wrong shapes; a patch without triangles, or of triangles that are not there; a
            margin that is negative or not finite.

    Differentiation: every mode, exact: the nearest points move with their triangles. Where two
        pairs of points are equally near, the derivative is that of one of them. In second
        derivatives the points keep their places on their triangles.

    Example:
        >>> import jax, numpy as np, trimesh
        >>> from spt_jax import contact_penalty
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([1.5, 0.0, 0.0]))
        >>> vertices = jax.numpy.asarray(pair.vertices, "float32")
        >>> loss = lambda v: contact_penalty(v, pair.faces, [(range(12), range(12, 24))])
        >>> value, gradient = jax.value_and_grad(loss)(vertices)
        >>> print(f"{value:.2f} {gradient[8:].sum(axis=0)[0]:.1f}")
        0.25 1.0
    """
    vertices = as_vertices(vertices)
    if isinstance(faces, Tracer):
        raise TypeError(
            "faces must be known when traced: got a traced array; pass a NumPy array of the mesh's "
            "faces, not an argument of the function that is traced."
        )
    corners = np.asarray(as_faces(faces, vertices.shape[-2]), np.int64)
    rows = as_rows(pairs, corners)
    return contact_of_rows(vertices, rows, len(pairs), as_margin(margin))


def as_rows(
    pairs: Sequence[tuple[Any, Any]], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "N 3"]:
    """Patches as rows: of each of their triangles pair, side and 0, and then the corners of each.

    All of it in one array of rows of three, as the bridge takes faces, so that it may be traced.

    Raises:
        TypeError, ValueError: as `contact_penalty`.
    """
    rows, num_faces = [np.zeros((0, 2, 3), np.int64)], len(faces)
    for number, pair in enumerate(pairs):
        if isinstance(pair, Tracer) or len(pair) != 2:
            raise ValueError(
                "pairs must be pairs of patches, [(faces, faces), ...], known when traced: got "
                f"{len(pair)} patches in pair {number}."
            )
        for side, patch in enumerate(pair):
            found = np.asarray(patch)
            if found.ndim != 1 or not found.size:
                raise ValueError(
                    "pairs must name the triangles of each patch, at least one: got shape "
                    f"{found.shape} in pair {number}."
                )
            if not np.issubdtype(found.dtype, np.integer):
                raise TypeError(
                    f"pairs must name triangles by whole numbers: got {found.dtype} in pair "
                    f"{number}; np.flatnonzero(mask) makes numbers of a mask."
                )
            if found.min() < 0 or found.max() >= num_faces:
                wrong = found.min() if found.min() < 0 else found.max()
                raise ValueError(
                    f"pairs must name triangles of the mesh: got number {wrong} for {num_faces} "
                    f"faces in pair {number}; numbers are 0-based."
                )
            at = np.unique(found)
            which = np.broadcast_to([number, side, 0], (len(at), 3))
            rows.append(np.stack([which, faces[at]], axis=1))
    return np.concatenate(np.concatenate(rows).transpose(1, 0, 2))


def contact_of_rows(
    vertices: Float[Array, "*batch V 3"],
    rows: Integer[np.ndarray, "R 3"] | Integer[Array, "R 3"],
    pairs: int,
    margin: float | Float[Array, " K"],
) -> Float[Array, "*batch"]:
    """`contact_penalty` of patches as rows, which may be traced.

    Args:
        vertices: positions.
        rows: of `as_rows`; triangles of a pair of -1 are padding.
        pairs: how many pairs there are at most.
        margin: the distance at which patches touch, one or one for each pair.
    """
    dtype = vertices.dtype.name
    known = _Known(pairs)
    results = (((pairs, 2), "int32"), ((pairs, 2, 3), dtype), ((pairs,), dtype))
    places, weights, apart = call_on_host(_nearest_on_host, known, results, vertices, rows)
    weights, apart = jax.lax.stop_gradient((weights, apart))
    corners = jnp.asarray(rows)[len(rows) // 2 :][places]  # (..., pairs, 2, 3)
    batch = vertices.shape[:-2]
    flat = vertices.reshape(-1, *vertices.shape[-2:])
    taken = jax.vmap(lambda one, at: one[at])(flat, corners.reshape(len(flat), pairs, 2, 3))
    points = (weights.reshape(len(flat), pairs, 2, 3)[..., None] * taken).sum(axis=-2)
    way = points[:, :, 1] - points[:, :, 0]
    apart = apart.reshape(len(flat), pairs)
    touching = apart <= 0  # or no such pair; NaN where it cannot be determined
    square = jnp.sum(way**2, axis=-1)
    distance = jnp.sqrt(jnp.where(touching | (square == 0), jnp.ones_like(square), square))
    limit = jnp.broadcast_to(jnp.asarray(margin, dtype), distance.shape)
    over = jnp.where(touching, jnp.zeros_like(distance), jnp.maximum(distance - limit, 0.0))
    over = jnp.where(jnp.isnan(apart), apart, over)
    return jnp.sum(over**2, axis=-1).reshape(batch)


def _nearest_on_host(vertices, rows, known: _Known):
    """Of each pair of patches the rows, the weights and the distance; -1 where there is none."""
    which, faces = np.split(rows.astype(np.int64), 2)
    places = np.zeros((known.pairs, 2), np.int32)
    weights = np.zeros((known.pairs, 2, 3))
    apart = np.full(known.pairs, -1.0)
    for pair in range(known.pairs):
        own = which[:, 0] == pair
        first, second = (np.flatnonzero(own & (which[:, 1] == side)) for side in (0, 1))
        if not len(first) or not len(second):
            continue
        corners = faces[np.concatenate([first, second])]
        if not np.isfinite(vertices[corners]).all():
            apart[pair] = np.nan
            continue
        found = nearest_points(vertices, faces, first, second)
        places[pair], weights[pair], apart[pair] = found.faces, found.weights, found.distance
    return places, weights, apart
