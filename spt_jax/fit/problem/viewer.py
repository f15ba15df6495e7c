"""The axes in which a fit is solved: those of whoever looks at the image."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax._camera import PinholeCamera
from spt_jax.body import BodyModel
from spt_jax.body.rotations import axis_angle_from_matrix
from spt_jax.fit.problem.variables import Variables

# From the camera's axes (y down, z forward) to the viewer's.
_UPRIGHT = np.diag([1.0, -1.0, -1.0])


class Viewer(eqx.Module):
    """A camera's place in the world, and the same camera at the origin of its own axes.

    The viewer's axes have x to the image's right, y up and z towards the camera, which is at their
    origin. A solver works in them: the path of a search, and with it the minimum that it finds,
    then does not depend on how the world is turned, and a person who stands and faces the camera,
    turned by nothing, is far from the angles at which axis-angle vectors go bad.

    Attributes:
        camera: with its rotation and translation left out, in the viewer's axes.
        rotation, translation: from the world to the viewer.
        turn: the rotation as axis-angle.
    """

    camera: PinholeCamera
    rotation: Float[Array, "3 3"]
    turn: Float[Array, "3"]
    translation: Float[Array, "3"]

    @classmethod
    def of(cls, camera: PinholeCamera) -> "Viewer":
        """The viewer of a camera."""
        dtype = camera.rotation.dtype
        over = jnp.asarray(_UPRIGHT, dtype)
        own = PinholeCamera(camera.focal, camera.center, over, near=camera.near)
        place = _times(over, camera.translation.astype(dtype))
        rotation = _times(over, camera.rotation)
        return cls(own, rotation, axis_angle_from_matrix(rotation), place)

    @property
    def upright(self) -> Float[Array, "3"]:
        """Axis-angle, in the world, of a root whose body stands and faces the camera."""
        return -self.turn

    def from_world(self, body: BodyModel, given: Variables) -> Variables:
        """A body's parameters in the viewer's axes.

        Only the root's rotation and the translation change. The root turns about its own joint,
        which lies at J in the resting body: R_v = Q R and t_v = Q (J + t) + q - J for a viewer at
        Q p + q.
        """
        root = composed(self.turn.astype(given.pose.dtype), given.pose[0])
        pose = given.pose.at[0].set(root)
        return given._replace(pose=pose, translation=self.place_of(body, given))

    def place_of(self, body: BodyModel, given: Variables) -> Float[Array, "3"]:
        """The translation alone of a body in the viewer's axes; its rotations do not matter."""
        rotation, place = self._as(given)
        at = _root_joint(body, given)
        return _times(rotation, at + given.translation) + place - at

    def to_world(self, body: BodyModel, given: Variables) -> Variables:
        """The same parameters in the world's axes. Every mode of differentiation."""
        rotation, place = self._as(given)
        at = _root_joint(body, given)
        pose = given.pose.at[0].set(composed(-self.turn.astype(given.pose.dtype), given.pose[0]))
        moved = _times(rotation.T, at + given.translation - place) - at
        return given._replace(pose=pose, translation=moved)

    def _as(self, given: Variables):
        dtype = given.pose.dtype
        return self.rotation.astype(dtype), self.translation.astype(dtype)


def composed(second: Float[Array, "3"], first: Float[Array, "3"]) -> Float[Array, "3"]:
    """Axis-angle of one rotation after another, the angle between 0 and pi.

    By quaternions: a tenth of the operations, which a fit compiles in five places, of the way
    through two matrices and back.

    Differentiation: every mode, once; finite everywhere.
    """
    w_2, v_2 = _quaternion(second)
    w_1, v_1 = _quaternion(first)
    w = w_2 * w_1 - jnp.sum(v_2 * v_1)
    v = w_2 * v_1 + w_1 * v_2 + jnp.cross(v_2, v_1)
    v, w = jnp.where(w < 0, -v, v), jnp.abs(w)
    square = jnp.sum(v**2)
    # Both branches of a double where are finite; below it, 1 / w and 1 are one and the same.
    tiny = square < jnp.finfo(v.dtype).eps ** 2
    sine = jnp.sqrt(jnp.where(tiny, 1.0, square))
    return v * jnp.where(tiny, 2.0, 2 * jnp.arctan2(sine, w) / sine)


def _quaternion(axis_angle: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    square = jnp.sum(axis_angle**2)
    tiny = square < jnp.finfo(axis_angle.dtype).eps ** 2
    angle = jnp.sqrt(jnp.where(tiny, 1.0, square))
    cosine = jnp.where(tiny, 1.0, jnp.cos(angle / 2))
    return cosine, axis_angle * jnp.where(tiny, 0.5, jnp.sin(angle / 2) / angle)


def _times(left, right):
    return jnp.matmul(left, right, precision=jax.lax.Precision.HIGHEST)


def _root_joint(body: BodyModel, given: Variables) -> Float[Array, "3"]:
    basis = body.joint_shape_basis[0].astype(given.shape.dtype)
    return body.joint_template[0].astype(given.shape.dtype) + _times(basis, given.shape)
