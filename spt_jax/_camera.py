"""The pinhole camera: points of the world in, pixels out."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax._camera_arguments import as_focal, check_rotation, checked, decompose


class PinholeCamera(eqx.Module):
    """A camera without distortion: x to the right, y down, z forward, pixels from the top left.

    A point p of the world is at q = R p + t for the camera and at the pixel

        u = (fx q_x / q_z + cx,  fy q_y / q_z + cy).

    At and behind the camera's plane that has no useful value. Nearer than `near`, 1 / q_z is
    continued by its tangent, (2 - q_z / near) / near: value and slope are continuous there, pixels
    and gradients finite everywhere. A point behind the camera keeps its side of the image and lies
    farther out the farther behind it is, so that a reprojection error pushes it to the front.

    It is a pytree of arrays: pass it through `jit`, `grad` or `vmap`. A batch of cameras is made
    and used under `vmap`: `cameras = jax.vmap(PinholeCamera)(focals, centers)`.

    Attributes:
        focal: focal lengths along x and y, in pixels; one number means both.
        center: the principal point, in pixels.
        rotation: R, from the world to the camera.
        translation: t, from the world to the camera, in the world's unit.
        near: the distance, in the world's unit, at which the tangent takes over. Static.

    Raises:
        TypeError: an argument holds no real numbers; `near` is not a float.
        ValueError: wrong shapes; where values are known: a focal length that is not positive, a
            rotation that is none, NaN or infinity; `near` not positive.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax._camera import PinholeCamera
        >>> camera = PinholeCamera(1000.0, (320.0, 240.0), translation=(0.0, 0.0, 4.0))
        >>> camera.project(jnp.array([[0.4, -0.2, 0.0]])).tolist()
        [[420.0, 190.0]]
    """

    focal: Float[Array, "2"]
    center: Float[Array, "2"]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    near: float = eqx.field(static=True)

    def __init__(
        self,
        focal: Any,
        center: Any,
        rotation: Any = None,
        translation: Any = None,
        *,
        near: float = 0.1,
    ):
        self.focal = as_focal(focal)
        self.center = checked("center", center, (2,))
        kind = self.focal.dtype
        self.rotation = (
            jnp.eye(3, dtype=kind) if rotation is None else checked("rotation", rotation, (3, 3))
        )
        self.translation = (
            jnp.zeros(3, kind) if translation is None else checked("translation", translation, (3,))
        )
        if isinstance(near, bool) or not isinstance(near, (int, float, np.integer, np.floating)):
            raise TypeError(f"near must be a number known when traced: got {near!r}.")
        if not 0 < near < np.inf:
            raise ValueError(f"near must be positive and finite: got {near!r}; 0.1 m is usual.")
        self.near = float(near)
        check_rotation(self.rotation)

    @property
    def matrix(self) -> Float[Array, "3 4"]:
        """The projection matrix K [R | t]: homogeneous pixels of a point in front of the camera.

        Example:
            >>> from spt_jax._camera import PinholeCamera
            >>> PinholeCamera(2.0, (5.0, 7.0)).matrix.tolist()
            [[2.0, 0.0, 5.0, 0.0], [0.0, 2.0, 7.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
        """
        dtype = self.focal.dtype
        center, rotation = self.center.astype(dtype), self.rotation.astype(dtype)
        last = jnp.array([[0, 0, 1]], dtype)
        intrinsic = jnp.concatenate(
            [jnp.concatenate([jnp.diag(self.focal), center[:, None]], axis=1), last]
        )
        motion = jnp.concatenate([rotation, self.translation.astype(dtype)[:, None]], axis=1)
        return jnp.matmul(intrinsic, motion, precision=jax.lax.Precision.HIGHEST)

    @classmethod
    def from_matrix(cls, matrix: Any, *, near: float = 0.1) -> "PinholeCamera":
        """The camera of a 3 x 4 projection matrix, K [R | t] times any number but zero.

        By an RQ decomposition, in float64 outside JAX. The matrix says where points appear and not
        whether they are in front; of the two cameras that it allows the one whose rotation has
        determinant +1 is taken, which is right for images with y down.

        Args:
            matrix: the projection matrix, pixels in homogeneous coordinates.
            near: as the class says.

        Returns:
            A PinholeCamera whose `matrix` is the one given, times a number, in JAX's default dtype.

        Raises:
            TypeError: it holds no real numbers, or is traced.
            ValueError: it has another shape; it is not finite, or its left 3 x 3 part is singular;
                its pixels have a skew of more than 0.001 of the focal length (less is dropped).

        Example:
            >>> import numpy as np
            >>> from spt_jax._camera import PinholeCamera
            >>> matrix = np.array([[800, 0, 320, 0], [0, 800, 240, 0], [0, 0, 1, 2]])
            >>> camera = PinholeCamera.from_matrix(-3 * matrix)
            >>> print(camera.focal.round(2), camera.center.round(2))
            [800. 800.] [320. 240.]
        """
        if isinstance(matrix, Tracer):
            raise TypeError(
                "matrix must be known: got a traced array; call from_matrix outside jit, grad and "
                "vmap."
            )
        given = np.asarray(matrix)
        if not (np.issubdtype(given.dtype, np.floating) or np.issubdtype(given.dtype, np.integer)):
            raise TypeError(f"matrix must hold real numbers: got dtype {given.dtype}.")
        if given.shape != (3, 4):
            raise ValueError(
                f"matrix must have shape (3, 4), K [R | t]: got {given.shape}; for a 3 x 3 matrix "
                "of intrinsics give focal and center."
            )
        if not np.isfinite(given).all():
            raise ValueError(f"matrix must be finite: got {given.tolist()}.")
        focal, center, rotation, translation = decompose(given.astype(np.float64))
        return cls(focal, center, rotation, translation, near=near)

    @classmethod
    def from_field_of_view(
        cls,
        width: float | int,
        height: float | int,
        degrees: float | int = 55.0,
        *,
        near: float | int = 0.1,
    ) -> "PinholeCamera":
        """A camera for an image whose own is not known: at the origin, looking along z.

        The default, 55 degrees over the longer side, is that of a 35 mm lens on full frame, which
        lies between telephones (65 to 70) and portrait lenses (25 to 40), and is not far from the
        habit of taking the image's diagonal for the focal length (45 over the longer side of
        3 : 2). The habit of 5000 pixels, 12 degrees or less, puts people 20 to 60 m away, where no
        perspective is left to distinguish an arm in front from one behind. For an image cut out of
        another, take the whole one's width and height, and move the center.

        Args:
            width, height: of the image, in pixels.
            degrees: the angle that the longer side of the image spans.
            near: as the class says.

        Returns:
            A PinholeCamera with equal focal lengths and the image's middle as its center.

        Raises:
            TypeError, ValueError: sizes that are not positive numbers, an angle that is not above 0
                and below 180.

        Example:
            >>> from spt_jax._camera import PinholeCamera
            >>> camera = PinholeCamera.from_field_of_view(640, 480, 90.0)
            >>> camera.focal.round(3).tolist(), camera.center.tolist()
            ([320.0, 320.0], [320.0, 240.0])
        """
        for name, value, top in (
            ("width", width, np.inf),
            ("height", height, np.inf),
            ("degrees", degrees, 180.0),
        ):
            if isinstance(value, bool) or not isinstance(
                value, (int, float, np.integer, np.floating)
            ):
                raise TypeError(f"{name} must be a number: got {value!r}.")
            if not 0 < value < top:
                bound = "finite" if top == np.inf else f"below {top:g}"
                raise ValueError(f"{name} must be positive and {bound}: got {value!r}.")
        focal = max(width, height) / 2 / np.tan(np.radians(degrees) / 2)
        return cls(float(focal), (width / 2, height / 2), near=near)

    def to_camera(
        self, points: Float[Array | np.ndarray, "*batch N 3"]
    ) -> Float[Array, "*batch N 3"]:
        """Points in the camera's axes, R p + t: x to the right, y down, z forward.

        Args:
            points: positions in the world; any number of leading batch axes.

        Returns:
            As many positions, in the dtype and unit of `points`.

        Raises:
            TypeError, ValueError: `points` is not floating-point, or not (..., N, 3).
        Differentiation: every mode, with respect to the points and to the camera.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax._camera import PinholeCamera
            >>> camera = PinholeCamera(1.0, (0.0, 0.0), translation=(0.0, 0.0, 3.0))
            >>> camera.to_camera(jnp.zeros((1, 3))).tolist()
            [[0.0, 0.0, 3.0]]
        """
        array = jnp.asarray(points)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise TypeError(
                f"points must be floating-point: got dtype {array.dtype}; convert them with "
                "points.astype('float32')."
            )
        if array.ndim < 2 or array.shape[-1] != 3:
            raise ValueError(
                f"points must be (..., N, 3): got shape {tuple(array.shape)}; write one point as "
                "[[x, y, z]]."
            )
        rotation = self.rotation.astype(array.dtype)
        turned = jnp.matmul(array, rotation.T, precision=jax.lax.Precision.HIGHEST)
        return turned + _row(self.translation, turned)

    def project(
        self, points: Float[Array | np.ndarray, "*batch N 3"]
    ) -> Float[Array, "*batch N 2"]:
        """The pixels at which points appear.

        The class says the equation, and what happens behind the camera.

        Args:
            points: positions in the world; any number of leading batch axes.

        Returns:
            (x, y) in pixels, in the dtype of `points`; finite for every finite point, up to
            overflow.

        Raises:
            TypeError, ValueError: as `to_camera`.
        Differentiation: every mode, with respect to the points and to the camera; the second
            derivative jumps at the depth `near`.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax._camera import PinholeCamera
            >>> camera = PinholeCamera(100.0, (0.0, 0.0))
            >>> camera.project(jnp.array([[1.0, 0.0, 2.0], [1.0, 0.0, 0.0]])).tolist()
            [[50.0, 0.0], [2000.0, 0.0]]
        """
        seen = self.to_camera(points)
        depth = seen[..., 2:]
        in_front = depth > self.near
        # Two wheres: the branch not taken must have a finite derivative too.
        safe = jnp.where(in_front, depth, jnp.full_like(depth, self.near))
        inverse = jnp.where(in_front, 1 / safe, (2 - depth / self.near) / self.near)
        flat = seen[..., :2] * inverse
        return flat * _row(self.focal, flat) + _row(self.center, flat)


def _row(vector, like) -> Float[Array, "..."]:
    """The vector in the dtype of an array, with the axes that the array has before its last."""
    return vector.astype(like.dtype).reshape((1,) * (like.ndim - 1) + vector.shape)
