"""Groups of faces, by body part and by person, and the pairs of them whose overlaps to ignore."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Integer

from spt_jax._query import as_mesh

Pairs = tuple[tuple[int, int], ...]


class Scene(NamedTuple):
    """Several meshes as one: what the penalty takes.

    Attributes:
        vertices: of all, one mesh after the other.
        faces: indices into them.
        face_groups: of each face, the number of its mesh.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax import join_bodies, self_intersection_penalty, within_groups
        >>> box = trimesh.creation.box()
        >>> scene = join_bodies(np.stack([box.vertices, box.vertices + [0.6, 0.3, 0.2]]), box.faces)
        >>> between = self_intersection_penalty(
        ...     scene.vertices,
        ...     scene.faces,
        ...     face_groups=scene.face_groups,
        ...     ignore_groups=within_groups(2),
        ... )
        >>> print(f"{between:.3f}")
        0.224
    """

    vertices: Float[Array, "*batch V 3"]
    faces: Integer[Array | np.ndarray, "F 3"]
    face_groups: Int[np.ndarray, "F"]


def join_bodies(
    vertices: Float[Array, "*batch N V 3"] | np.ndarray, faces: Integer[Array, "F 3"] | np.ndarray
) -> Scene:
    """Several bodies of the same faces as one mesh, each a group of its own.

    Overlaps between the bodies and within them then count alike. `within_groups` and
    `between_groups` name the pairs that leave only the others, and `rest_surface.copies(N)` is
    the rest surface of the scene.

    Args:
        vertices: the bodies' positions; the last axis but two runs over the bodies.
        faces: indices of each triangle's corners, the same in every body.

    Returns:
        Scene(vertices, faces, face_groups) of N * V vertices and N * F faces.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`, for vertices and faces; or vertices
            without an axis for the bodies.

    Differentiation: every mode; the vertices are only reshaped.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body, self_intersection_penalty
        >>> body = load_body()
        >>> apart = jnp.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])  # metres: arm in arm
        >>> posed = body(jnp.zeros((2, 52, 3)), translation=apart)
        >>> scene = join_bodies(posed.vertices, body.faces)
        >>> scene.vertices.shape, scene.faces.shape, scene.face_groups.max()
        ((24544, 3), (49080, 3), np.int32(1))
        >>> bool(self_intersection_penalty(scene.vertices, scene.faces, rays=128) > 1e-3)
        True
    """
    checked, corners = as_mesh(vertices, faces)
    if checked.ndim < 3:
        raise ValueError(
            f"vertices must have shape (..., N, V, 3) for N bodies: got {checked.shape}; stack the "
            "bodies with jnp.stack, also where there is only one."
        )
    *batch, bodies, count, _ = checked.shape
    # Faces that are known stay so: what is computed with jnp inside jit is traced.
    if not isinstance(faces, Tracer):
        corners = np.asarray(faces)
    corners = corners.astype(np.int32)  # int8 may do for one body and not for all
    offsets = (np.arange(bodies, dtype=np.int32) * count)[:, None, None]
    return Scene(
        checked.reshape(*batch, bodies * count, 3),
        (corners[None] + offsets).reshape(-1, 3),
        np.repeat(np.arange(bodies, dtype=np.int32), len(corners)),
    )


def within_groups(count: int) -> Pairs:
    """Every group with itself: ignored, only overlaps between groups count.

    Example:
        >>> from spt_jax._groups import within_groups
        >>> within_groups(3)
        ((0, 0), (1, 1), (2, 2))
    """
    return tuple((group, group) for group in range(count))


def between_groups(count: int) -> Pairs:
    """Every two different groups: ignored, only overlaps within a group count.

    Example:
        >>> from spt_jax._groups import between_groups
        >>> between_groups(3)
        ((0, 1), (0, 2), (1, 2))
    """
    return tuple(itertools.combinations(range(count), 2))


def part_groups(weights: Any, faces: Any) -> Int[np.ndarray, "F"]:
    """Of each face, the joint with the largest mean skinning weight over its corners.

    Args:
        weights: (V, J), of each vertex to each joint.
        faces: (F, 3) indices of each triangle's corners.

    Returns:
        Numbers of joints, int32; of equal joints the first.

    Raises:
        TypeError: weights or faces are traced.

    Example:
        >>> import numpy as np
        >>> from spt_jax._groups import part_groups
        >>> weights = np.array([[1.0, 0.0], [0.7, 0.3], [0.2, 0.8], [0.0, 1.0]])
        >>> part_groups(weights, np.array([[0, 1, 2], [1, 2, 3]]))
        array([0, 1], dtype=int32)
    """
    if isinstance(weights, Tracer) or isinstance(faces, Tracer):
        raise TypeError(
            "groups of faces must be known when traced: got a traced body; take body.part_groups "
            "outside jit, grad and vmap, and pass it in as an option."
        )
    rows, corners = np.asarray(weights), np.asarray(faces)
    mean = rows[corners[:, 0]] + rows[corners[:, 1]] + rows[corners[:, 2]]
    return mean.argmax(axis=1).astype(np.int32)


def neighbor_pairs(parents: Sequence[int]) -> Pairs:
    """Each joint with itself and with its parent: the parts that skinning makes overlap.

    SMPLify-X leaves these out, and a few more that its settings name one by one.

    Args:
        parents: the parent of each joint, -1 for a root.

    Example:
        >>> from spt_jax._groups import neighbor_pairs
        >>> neighbor_pairs((-1, 0, 0))
        ((0, 0), (0, 1), (0, 2), (1, 1), (2, 2))
    """
    own = within_groups(len(parents))
    return tuple(sorted(own + tuple((p, joint) for joint, p in enumerate(parents) if p >= 0)))
