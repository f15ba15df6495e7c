"""The axes in which a fit is solved: those of whoever looks at the image."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from spt_jax.camera import PinholeCamera
from spt_jax.fit.figure import Variables

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
    """

    camera: PinholeCamera
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]

    @classmethod
    def of(cls, camera: PinholeCamera) -> "Viewer":
        """The viewer of a camera."""
        dtype = camera.rotation.dtype
        over = jnp.asarray(_UPRIGHT, dtype)
        own = PinholeCamera(camera.focal, camera.center, over, near=camera.near)
        place = _times(over, camera.translation.astype(dtype))
        return cls(own, _times(over, camera.rotation), place)

    @property
    def upright(self) -> Float[Array, "3"]:
        """Axis-angle, in the world, of a root whose body stands and faces the camera."""
        return axis_angle_from_matrix(self.rotation.T)

    def from_world(self, body: BodyModel, given: Variables) -> Variables:
        """A body's parameters in the viewer's axes.

        Only the root's rotation and the translation change. The root turns about its own joint,
        which lies at J in the resting body: R_v = Q R and t_v = Q (J + t) + q - J for a viewer at
        Q p + q.
        """
        turn, _ = self._as(given)
        root = matrix_from_axis_angle(given.pose[0])
        pose = given.pose.at[0].set(axis_angle_from_matrix(_times(turn, root)))
        return given._replace(pose=pose, translation=self.place_of(body, given))

    def place_of(self, body: BodyModel, given: Variables) -> Float[Array, "3"]:
        """The translation alone of a body in the viewer's axes; its rotations do not matter."""
        turn, place = self._as(given)
        at = _root_joint(body, given)
        return _times(turn, at + given.translation) + place - at

    def to_world(self, body: BodyModel, given: Variables) -> Variables:
        """The same parameters in the world's axes. Every mode of differentiation."""
        turn, place = self._as(given)
        root = matrix_from_axis_angle(given.pose[0])
        at = _root_joint(body, given)
        pose = given.pose.at[0].set(axis_angle_from_matrix(_times(turn.T, root)))
        moved = _times(turn.T, at + given.translation - place) - at
        return given._replace(pose=pose, translation=moved)

    def _as(self, given: Variables):
        dtype = given.pose.dtype
        return self.rotation.astype(dtype), self.translation.astype(dtype)


def _times(left, right):
    return jnp.matmul(left, right, precision=jax.lax.Precision.HIGHEST)


def _root_joint(body: BodyModel, given: Variables) -> Float[Array, "3"]:
    basis = body.joint_shape_basis[0].astype(given.shape.dtype)
    return body.joint_template[0].astype(given.shape.dtype) + _times(basis, given.shape)
