"""Rotations as files write them: axis-angle, matrices, six numbers, quaternions, Euler angles.

What a file holds is turned into axis-angle vectors in double precision, and back into its own form.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

# How far from a rotation a matrix, or from length 1 a quaternion, may be: half precision loses
# 1e-3, and a sum of several networks' outputs more.
_NEARLY = 2e-2


class Form(NamedTuple):
    """A way to write a rotation.

    Attributes:
        name: what messages call it.
        tail: the shape of one rotation in the file, such as (3, 3).
        decode: from (..., *tail) to axis-angle (..., 3), in radians; ValueError where it is none.
        encode: the way back.
        note: what had to be decided about it, as a sentence.
    """

    name: str
    tail: tuple[int, ...]
    decode: Callable[[np.ndarray], np.ndarray]
    encode: Callable[[np.ndarray], np.ndarray]
    note: str = ""

    @property
    def size(self) -> int:
        """How many numbers one rotation takes."""
        return int(np.prod(self.tail))


def matrices(axis_angle: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors, in double precision on the host."""
    flat = Rotation.from_rotvec(np.asarray(axis_angle, np.float64).reshape(-1, 3)).as_matrix()
    return flat.reshape(*axis_angle.shape[:-1], 3, 3)


def axis_angles(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Axis-angle vectors of the rotations next to some matrices.

    Raises:
        ValueError: one is no rotation; the message says which.
    """
    flat = np.asarray(matrix, np.float64).reshape(-1, 3, 3)
    off = np.abs(flat @ flat.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    wrong = (off > _NEARLY) | (np.linalg.det(flat) < 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        rows = np.array2string(flat[k], precision=3, separator=", ").replace("\n", "")
        raise ValueError(f"must hold rotation matrices: got {rows} as number {k}")
    return Rotation.from_matrix(flat).as_rotvec().reshape(*matrix.shape[:-2], 3)


def _same(values: np.ndarray) -> np.ndarray:
    return values


AXIS_ANGLE = Form("axis-angle", (3,), _same, _same)
MATRIX = Form("matrices", (3, 3), axis_angles, matrices)


def _complete(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three axes at right angles from two that need not be, by Gram and Schmidt's method."""
    first = first / np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    second = second - (first * second).sum(-1, keepdims=True) * first
    second = second / np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-12)
    return first, second, np.cross(first, second)


def _from_two_rows(six: np.ndarray) -> np.ndarray:
    return axis_angles(np.stack(_complete(six[..., :3], six[..., 3:]), axis=-2))


def _to_two_rows(axis_angle: np.ndarray) -> np.ndarray:
    return matrices(axis_angle)[..., :2, :].reshape(*axis_angle.shape[:-1], 6)


def _from_two_columns(six: np.ndarray) -> np.ndarray:
    pairs = six.reshape(*six.shape[:-1], 3, 2)
    return axis_angles(np.stack(_complete(pairs[..., 0], pairs[..., 1]), axis=-1))


def _to_two_columns(axis_angle: np.ndarray) -> np.ndarray:
    return matrices(axis_angle)[..., :2].reshape(*axis_angle.shape[:-1], 6)


# The same six numbers in two orders: PyTorch3D's `matrix_to_rotation_6d` (transforms of
# facebookresearch/pytorch3d), and `rot6d_to_rotmat` of SPIN and all that came of it (HMR2, TRAM).
SIX_ROWS = Form(
    "6D rotations",
    (6,),
    _from_two_rows,
    _to_two_rows,
    "6D rotations are read as PyTorch3D writes them, the first two rows of a matrix",
)
SIX_COLUMNS = Form(
    "6D rotations",
    (6,),
    _from_two_columns,
    _to_two_columns,
    "6D rotations are read as SPIN and HMR write them, two columns of a matrix in turn",
)


def _quaternion(order: str, places: tuple[int, int, int, int]) -> Form:
    back = tuple(np.argsort(places).tolist())

    def decode(values: np.ndarray) -> np.ndarray:
        length = np.linalg.norm(values, axis=-1)
        wrong = np.abs(length - 1) > _NEARLY
        if wrong.any():
            raise ValueError(
                f"must hold quaternions of length 1: got one of length {length[wrong][0]:.3g}"
            )
        flat = values.reshape(-1, 4)[:, places]
        return Rotation.from_quat(flat).as_rotvec().reshape(*values.shape[:-1], 3)

    def encode(axis_angle: np.ndarray) -> np.ndarray:
        flat = Rotation.from_rotvec(axis_angle.reshape(-1, 3)).as_quat(canonical=True)
        return flat[:, back].reshape(*axis_angle.shape[:-1], 4)

    note = f"quaternions are read in the order {', '.join(order)}"
    return Form("quaternions", (4,), decode, encode, note)


QUATERNION_WXYZ = _quaternion("wxyz", (1, 2, 3, 0))
QUATERNION_XYZW = _quaternion("xyzw", (0, 1, 2, 3))


def euler(order: str, before: np.ndarray, after: np.ndarray) -> Form:
    """Angles in degrees about the axes of `order`, each about the axes that those before it turned.

    Args:
        order: such as "ZXY".
        before, after: the rotation is `before @ R @ after`.
    """

    def decode(degrees: np.ndarray) -> np.ndarray:
        turned = Rotation.from_euler(order, degrees.reshape(-1, 3), degrees=True).as_matrix()
        return axis_angles(before @ turned @ after).reshape(*degrees.shape[:-1], 3)

    def encode(axis_angle: np.ndarray) -> np.ndarray:
        turned = before.T @ matrices(axis_angle.reshape(-1, 3)) @ after.T
        with warnings.catch_warnings():
            # Where two axes coincide, one of many equal triples is as good as another.
            warnings.filterwarnings("ignore", "Gimbal lock")
            angles = Rotation.from_matrix(turned).as_euler(order, degrees=True)
        return angles.reshape(*axis_angle.shape[:-1], 3)

    return Form(f"Euler angles {order}", (3,), decode, encode)


def form_of(
    values: np.ndarray, joints: int, frames: int | None = None, forms: Sequence[Form] = ()
) -> Form | None:
    """In which form an array holds frames of so many joints' rotations; None where in none.

    Six numbers may stand in two orders, as may four: which it is shows in the numbers.

    Args:
        values: (N, joints, ...), (N, joints * size) or one frame of these.
        joints: how many.
        frames: how many frames there are, where that is known: (3, 3) may be three of vectors.
        forms: those that are possible, where other entries decide.

    Raises:
        ValueError: six numbers that are orthonormal in neither order.
    """
    for form in forms or (AXIS_ANGLE, MATRIX, SIX_ROWS, QUATERNION_WXYZ):
        shapes = [(joints, *form.tail), (joints * form.size,), *([form.tail] * (joints == 1))]
        for shape in shapes:
            extra = values.ndim - len(shape)
            if extra not in (0, 1) or values.shape[extra:] != shape:
                continue
            if frames is not None and extra and len(values) not in (1, frames):
                continue
            if forms:
                return form
            if form is SIX_ROWS:
                return _order_of_six(values.reshape(-1, 6))
            return _order_of_four(values.reshape(-1, 4)) if form is QUATERNION_WXYZ else form
    return None


def _order_of_six(six: np.ndarray) -> Form:
    for form, first, second in (
        (SIX_ROWS, six[:, :3], six[:, 3:]),
        (SIX_COLUMNS, six[:, ::2], six[:, 1::2]),
    ):
        lengths = np.linalg.norm(np.stack([first, second]), axis=-1)
        if (np.abs(lengths - 1) < _NEARLY).all() and (
            np.abs((first * second).sum(-1)) < _NEARLY
        ).all():
            return form
    raise ValueError(
        "must hold 6D rotations whose two vectors have length 1 and stand at right angles: got "
        "others, which may be in either of two orders; convert them to matrices first"
    )


def _order_of_four(four: np.ndarray) -> Form:
    # Joints turn by less than a quarter in most frames: there the scalar part is the largest.
    middle = np.abs(four).mean(axis=0) if len(four) else np.zeros(4)
    return QUATERNION_XYZW if middle[3] > middle[0] else QUATERNION_WXYZ
