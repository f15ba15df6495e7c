"""What a pinhole camera is made from: its arrays checked, and a projection matrix taken apart."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

# What is left out of a matrix with skew moves no pixel of a 1000-pixel image by more than a half.
_SKEW = 1e-3
_ORTHONORMAL = 1e-3
# Of the rows of a 3 x 3 matrix scaled to length 1; a focal length of a millionth of the distance
# from the image to its center gives 1e-12, float32 rounding of a singular matrix 1e-7.
_SINGULAR = 1e-7


def checked(name: str, value: Any, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """An array of real, finite numbers and of this shape; whole numbers become floating-point."""
    if isinstance(value, (tuple, list)) and any(isinstance(entry, Tracer) for entry in value):
        value = jnp.stack([jnp.asarray(entry) for entry in value])
    array = value if isinstance(value, Tracer | Array) else np.asarray(value)
    whole = jnp.issubdtype(array.dtype, jnp.integer)
    if not (whole or jnp.issubdtype(array.dtype, jnp.floating)):
        raise TypeError(f"{name} must hold real numbers: got dtype {array.dtype}.")
    if array.shape != shape:
        raise ValueError(
            f"{name} must have shape {shape}: got {array.shape}; a batch of cameras is made with "
            "jax.vmap(PinholeCamera)."
        )
    array = jnp.asarray(array, jnp.zeros(()).dtype) if whole else jnp.asarray(array)
    if not isinstance(array, Tracer) and not np.isfinite(np.asarray(array)).all():
        raise ValueError(f"{name} must be finite: got {np.asarray(array).tolist()}.")
    return array


def as_focal(value: Any) -> Float[Array, "2"]:
    """Focal lengths along x and y, each positive; one number means both."""
    scalar = np.ndim(value) == 0
    array = checked("focal", value, () if scalar else (2,))
    if not isinstance(array, Tracer) and not (np.asarray(array) > 0).all():
        raise ValueError(
            f"focal must be positive: got {np.asarray(array).tolist()}; it is in pixels, and an "
            "image with y up must be turned first."
        )
    return jnp.stack([array, array]) if scalar else array


def check_rotation(rotation) -> None:
    """Raise where a known matrix is no rotation."""
    if isinstance(rotation, Tracer):
        return
    value = np.asarray(rotation, np.float64)
    off = np.abs(value @ value.T - np.eye(3)).max()
    if off > _ORTHONORMAL:
        raise ValueError(
            f"rotation must be orthonormal: got {value.tolist()}, off by {off:.3g}; for an "
            "axis-angle vector use scipy's Rotation.from_rotvec(vector).as_matrix()."
        )
    if np.linalg.det(value) < 0:
        raise ValueError(
            f"rotation must have determinant +1: got a reflection, {value.tolist()}; x is to the "
            "right, y down and z forward."
        )


def decompose(
    matrix: Float[np.ndarray, "3 4"],
) -> tuple[
    Float[np.ndarray, "2"], Float[np.ndarray, "2"], Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]
]:
    """Focal lengths, center, rotation and translation of a finite projection matrix."""
    left = matrix[:, :3]
    # Rows scaled by themselves: the pixels' unit and the matrix's scale say nothing about its rank.
    lengths = np.abs(left).max(axis=1, keepdims=True)
    rows = left / np.where(lengths > 0, lengths, 1)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    volume = np.linalg.det(rows)
    if not abs(volume) > _SINGULAR:
        raise ValueError(
            f"matrix must be of full rank in its left three columns: got {matrix.tolist()}; an "
            "affine or orthographic camera has no pinhole."
        )
    # Divided by the third row's length, which is 1 in K [R | t].
    matrix = matrix / lengths[2] * np.sign(volume)
    matrix = matrix / np.linalg.norm(matrix[2, :3])
    # QR of the rows in reverse order, transposed, is RQ.
    orthogonal, triangle = np.linalg.qr(matrix[::-1, :3].T)
    intrinsic, rotation = triangle.T[::-1, ::-1], orthogonal.T[::-1]
    signs = np.sign(np.diag(intrinsic))
    intrinsic, rotation = intrinsic * signs, rotation * signs[:, None]
    fx, skew, fy = intrinsic[0, 0], intrinsic[0, 1], intrinsic[1, 1]
    if abs(skew) > _SKEW * fx:
        raise ValueError(
            f"matrix must have no skew: got {skew:.4g} pixels for a focal length of {fx:.4g}; "
            "remove it from the image, or pass the camera that took the image."
        )
    # Of K without its skew, so that K t is the last column as it would be.
    translation = np.linalg.solve(intrinsic, matrix[:, 3])
    return np.array([fx, fy]), intrinsic[:2, 2], rotation, translation
