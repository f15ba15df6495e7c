"""Rotations as axis-angle vectors and as 3 x 3 matrices, with derivatives that exist everywhere.

The two coefficients of Rodrigues' formula are entire functions of the squared angle, and both are
computed as such: a power series near zero, the closed form elsewhere. The usual branch (the series
below an angle of 1e-4, say) has a value that is good to the last digit, but automatic
differentiation of sin(angle) / angle just above the branch loses eps / angle^4 in the second
derivative, all of float32. A branch at angle 0.5 with eight terms is exact in both precisions.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

# Below this squared angle the series are used: their first missing term is 0.25^8 / 17! < 1e-19.
_SERIES_BELOW = 0.25
_SINC = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(8))
_COSC = tuple((-1.0) ** k / math.factorial(2 * k + 2) for k in range(8))
# angle / sin(angle / 2) for a sine s: 2 asin(s) / s = 2 (1 + s^2 / 6 + 3 s^4 / 40 + ...).
_ASIN = tuple(2.0 * math.comb(2 * k, k) / (4.0**k * (2 * k + 1)) for k in range(14))
_ASIN_BELOW = 0.0625


def _polynomial(
    coefficients: tuple[float, ...], x: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def matrix_from_axis_angle(axis_angle: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors.

    Rodrigues' formula, R = I + sin(t)/t [a]x + (1 - cos(t))/t^2 [a]x^2 with t = |a|.

    Args:
        axis_angle: rotation axis times angle, in radians; any number of leading batch axes.

    Returns:
        Matrices that act on column vectors.

    Differentiation: every mode and order; value and derivatives are finite and exact at zero and
        at an angle of pi.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.body.rotations import matrix_from_axis_angle
        >>> quarter_turn = matrix_from_axis_angle(jnp.array([0.0, 0.0, jnp.pi / 2]))
        >>> jnp.rint(quarter_turn @ jnp.array([1.0, 0.0, 0.0])).astype(int).tolist()
        [0, 1, 0]
    """
    squared = jnp.sum(axis_angle * axis_angle, axis=-1)
    small = squared < _SERIES_BELOW
    # Double where: neither branch ever sees a number at which its derivative is not finite.
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    half_sine = jnp.sin(0.5 * angle) / angle
    near = jnp.where(small, squared, 0.0)
    first = jnp.where(small, _polynomial(_SINC, near), jnp.sin(angle) / angle)
    second = jnp.where(small, _polynomial(_COSC, near), 2.0 * half_sine * half_sine)

    x, y, z = axis_angle[..., 0], axis_angle[..., 1], axis_angle[..., 2]
    one = jnp.ones_like(x)
    rows = [
        [one - second * (y * y + z * z), second * x * y - first * z, second * x * z + first * y],
        [second * x * y + first * z, one - second * (x * x + z * z), second * y * z - first * x],
        [second * x * z - first * y, second * y * z + first * x, one - second * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_axis_angle(axis_angle: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Unit quaternions (w, x, y, z) of axis-angle vectors: cos(t/2), and sin(t/2)/t times them.

    Args:
        axis_angle: rotation axis times angle, in radians; any number of leading batch axes.

    Returns:
        Quaternions; w is negative beyond half a turn.

    Differentiation: every mode and order; value and derivatives are finite and exact at zero.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.body.rotations import quaternion_from_axis_angle
        >>> quaternion_from_axis_angle(jnp.array([jnp.pi, 0.0, 0.0])).round(6).tolist()
        [-0.0, 1.0, 0.0, 0.0]
    """
    half = 0.5 * axis_angle
    squared = jnp.sum(half * half, axis=-1, keepdims=True)
    small = squared < _SERIES_BELOW
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    near = jnp.where(small, squared, 0.0)
    sine = jnp.where(small, _polynomial(_SINC, near), jnp.sin(angle) / angle)
    # cos(a) = 1 - a^2 (1 - cos(a)) / a^2: the series is at hand.
    cosine = jnp.where(small, 1.0 - near * _polynomial(_COSC, near), jnp.cos(angle))
    return jnp.concatenate([cosine, sine * half], axis=-1)


def axis_angle_from_matrix(matrix: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Axis-angle vectors of rotation matrices, the angle between 0 and pi.

    By way of the unit quaternion whose largest component is computed first (Shepperd 1978), which
    keeps every digit at an angle of pi, where the usual arccos of the trace keeps half of them.

    Args:
        matrix: rotation matrices; any number of leading batch axes.

    Returns:
        Rotation axis times angle, in radians. At exactly pi both signs of the axis are right and
        one of them is returned.

    Differentiation: every mode; finite everywhere, the identity and pi included. At pi the
        derivative is that of the sign returned.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.body.rotations import axis_angle_from_matrix
        >>> jnp.rad2deg(axis_angle_from_matrix(jnp.diag(jnp.array([1.0, -1.0, -1.0])))).tolist()
        [180.0, 0.0, 0.0]
    """
    m00, m11, m22 = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 2, 2]
    w_x = matrix[..., 2, 1] - matrix[..., 1, 2]
    w_y = matrix[..., 0, 2] - matrix[..., 2, 0]
    w_z = matrix[..., 1, 0] - matrix[..., 0, 1]
    x_y = matrix[..., 1, 0] + matrix[..., 0, 1]
    y_z = matrix[..., 2, 1] + matrix[..., 1, 2]
    z_x = matrix[..., 0, 2] + matrix[..., 2, 0]
    # Row k is 4 q_k (w, x, y, z): the outer product of the quaternion with itself.
    squares = [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22]
    rows = [
        [squares[0], w_x, w_y, w_z],
        [w_x, squares[1], x_y, z_x],
        [w_y, x_y, squares[2], y_z],
        [w_z, z_x, y_z, squares[3]],
    ]
    outer = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = jnp.argmax(jnp.stack(squares, axis=-1), axis=-1)
    row = jnp.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = row / jnp.sqrt(jnp.sum(row * row, axis=-1, keepdims=True))
    quaternion = jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)

    w, axis = quaternion[..., 0], quaternion[..., 1:]
    squared = jnp.sum(axis * axis, axis=-1)  # sin(angle / 2)^2
    small = squared < _ASIN_BELOW
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    near = jnp.where(small, squared, 0.0)
    scale = jnp.where(
        small,
        _polynomial(_ASIN, near),
        2.0 * jnp.arctan2(sine, jnp.where(small, 1.0, w)) / sine,
    )
    return axis * scale[..., None]
