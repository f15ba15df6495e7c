"""Keypoints of a body: a fixed linear map from its joints and a few of its vertices.

Here is what the map does; `making_regressors.py` makes one for a layout.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body import PosedBody


class KeypointRegressor(eqx.Module):
    """Keypoints as weighted sums of a body's joints and of some of its vertices.

        keypoints = joint_weights joints + vertex_weights vertices[list(regressor.vertices)]

    Get one from `keypoint_regressor`. Where only keypoints are wanted, pose
    `body.at_vertices(regressor.vertices)`: its vertices are the `landmarks` of a call.

    Attributes:
        names: one a keypoint, in the vocabulary of `spt_jax.keypoints.layouts.Layout`, so that
            "left_hip" or "nose" can be found whatever the layout. Static.
        vertices: the vertices of the body that are used. Static.
        joint_weights: of each joint in each keypoint.
        vertex_weights: of each of `vertices` in each keypoint.
        placed: whether each keypoint lies anywhere on the body. Points of the face do not, nor do
            those of fingers on a body without: their rows are the head's or the root joint, and
            fits leave them out. None where all do. Static.

    Raises:
        TypeError: weights that are not floating-point.
        ValueError: shapes disagree.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax.body import load_body
        >>> from spt_jax.keypoints import keypoint_regressor
        >>> body = load_body()
        >>> regressor = keypoint_regressor(body, "coco17")
        >>> posed = body.at_vertices(regressor.vertices)(jnp.zeros((52, 3)))
        >>> regressor(posed.joints, posed.vertices).shape
        (17, 3)
        >>> regressor.names[5]
        'left_shoulder'
    """

    names: tuple[str, ...] = eqx.field(static=True)
    vertices: tuple[int, ...] = eqx.field(static=True)
    joint_weights: Float[Array, "K J"]
    vertex_weights: Float[Array, "K L"]
    placed: tuple[bool, ...] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.placed is not None and len(self.placed) != len(self.names):
            raise ValueError(
                f"placed must be given for each of the {len(self.names)} names: got "
                f"{len(self.placed)}."
            )
        counts = {"joint_weights": None, "vertex_weights": len(self.vertices)}
        for name, columns in counts.items():
            array = getattr(self, name)
            if not jnp.issubdtype(array.dtype, jnp.floating):
                raise TypeError(f"{name} must be floating-point: got dtype {array.dtype}.")
            fits = array.ndim == 2 and array.shape[0] == len(self.names)
            if not fits or columns not in (None, array.shape[1]):
                wanted = "joints" if columns is None else columns
                raise ValueError(
                    f"{name} must have shape ({len(self.names)}, {wanted}), a row a name: got "
                    f"{array.shape}."
                )

    def __call__(
        self,
        joints: Float[Array | np.ndarray, "*batch J 3"],
        landmarks: Float[Array | np.ndarray, "*batch L 3"],
    ) -> Float[Array, "*batch K 3"]:
        """The keypoints of a posed body.

        Args:
            joints: the body's joints; any number of leading batch axes.
            landmarks: its vertices `self.vertices`, in that order.

        Returns:
            A row for each of `names`, in the unit and dtype of `joints`.

        Raises:
            TypeError, ValueError: not floating-point, or as many joints or landmarks as the
                weights have columns.
        Differentiation: every mode; the map is linear.

        Example:
            See the class.
        """
        total = None
        for name, points, weights in (
            ("joints", joints, self.joint_weights),
            ("landmarks", landmarks, self.vertex_weights),
        ):
            array = jnp.asarray(points)
            if not jnp.issubdtype(array.dtype, jnp.floating):
                raise TypeError(f"{name} must be floating-point: got dtype {array.dtype}.")
            count = weights.shape[-1]
            if array.ndim < 2 or array.shape[-2:] != (count, 3):
                raise ValueError(
                    f"{name} must be (..., {count}, 3): got shape {tuple(array.shape)}; joints are "
                    "all of the body's, landmarks its vertices of regressor.vertices."
                )
            dtype = array.dtype if total is None else total.dtype
            part = jnp.einsum(
                "kp,...pc->...kc",
                weights.astype(dtype),
                array.astype(dtype),
                precision=jax.lax.Precision.HIGHEST,
            )
            total = part if total is None else total + part
        return total

    def of(self, posed: PosedBody) -> Float[Array, "*batch K 3"]:
        """The keypoints of a whole posed body, all of its vertices given.

        Args:
            posed: what the body that the regressor was made for returns.

        Returns, Raises, Differentiation: as a call.

        Example:
            >>> import jax.numpy as jnp
            >>> from spt_jax.body import load_body
            >>> from spt_jax.keypoints import keypoint_regressor
            >>> body = load_body()
            >>> keypoint_regressor(body, "body25").of(body(jnp.zeros((52, 3)))).shape
            (25, 3)
        """
        rows = np.array(self.vertices, np.int32)
        return self(posed.joints, posed.vertices[..., rows, :])

    def find(self, *names: str) -> tuple[int, ...] | None:
        """The rows of keypoints by name, or None where one of them is missing.

        Example:
            >>> from spt_jax.body import load_body
            >>> from spt_jax.keypoints import keypoint_regressor
            >>> regressor = keypoint_regressor(load_body(), "h36m17")
            >>> regressor.find("left_hip", "right_hip"), regressor.find("left_heel")
            ((4, 1), None)
        """
        missing = any(name not in self.names for name in names)
        return None if missing else tuple(self.names.index(name) for name in names)
