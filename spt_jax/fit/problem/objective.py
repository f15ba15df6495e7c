"""What a fit minimises before any regularizer: keypoints, prior, limits, as a sum of squares."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from spt_jax.fit.problem.figure import Figure
from spt_jax.fit.problem.limits import JointLimits
from spt_jax.fit.problem.priors import PosePrior
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.problem.viewer import Viewer

# Per squared radian (and squared unit of shape) away from the start. It decides where nothing else
# does, as for the twist of a limb without a prior; a radian costs as much as one keypoint that is
# off by 3 % of its expected error.
_RIDGE = 1e-3

# Added to the Gauss-Newton matrix whose factor the penalty's stages take as coordinates, per
# squared radian: directions that the keypoints say nothing about would else be endlessly long.
_STIFFNESS = 1.0


# The scale of the robust loss while starts are tried, in units of the one that counts.
_FORGIVING = 4.0


class Weights(NamedTuple):
    """What each term counts for; the reprojection's weight is 1."""

    prior: Float[Array, ""]
    limits: Float[Array, ""]
    shape: Float[Array, ""]
    upright: Float[Array, ""]


class Objective(eqx.Module):
    """The squares of one person's fit.

    With c_k the confidence of keypoint k, e_k its distance in the image from where the body has it
    and s the expected error in pixels,

        sum over k of c_k rho(e_k / s)                      reprojection, rho(x) = x^2, or
                                                            x^2 / (1 + x^2 / g^2) (Geman-McClure)
        + prior weight * Mahalanobis distance^2 of the pose
        + limits weight * sum of (angle beyond its range / 0.1 rad)^2
        + shape weight * |shape|^2
        + upright weight * |body's up - the image's|^2.

    The variables of a solver are the rotations of the joints that move, then the translation and
    the shape where they are fitted, in one vector, in the viewer's axes; `pack` and `unpack` go
    from the world to there and back.
    """

    figure: Figure
    viewer: Viewer
    keypoints: Float[Array, "K 2"]
    confidence: Float[Array, "K"]
    pixels: Float[Array, ""]  # s, the expected error
    robust: Float[Array, ""] | None  # g, in units of s
    prior: PosePrior | None  # of the joints that move
    limits: JointLimits | None  # likewise
    weights: Weights
    start: Variables  # of the whole body, in the world
    seen: Variables  # the same of the joints that move, in the viewer's axes
    fit_shape: bool = eqx.field(static=True)
    fit_translation: bool = eqx.field(static=True)

    def forgiving(self) -> "Objective":
        """With a wider Geman-McClure scale, for a search.

        From far away every keypoint looks like a mistake, and a narrow scale lets go of all.
        """
        if self.robust is None:
            return self
        return dataclasses.replace(self, robust=_FORGIVING * self.robust)

    @property
    def names(self) -> tuple[str, ...]:
        """The keypoints' names."""
        return self.figure.regressor.names

    def pack(self, variables: Variables) -> Float[Array, "D"]:
        """The vector of a body in the world."""
        return self.repacked(as_seen(self.figure, self.viewer, variables))

    def unpack(self, vector: Float[Array, "D"]) -> Variables:
        """The whole body in the world: what the vector holds, and what is held fixed."""
        moved = self.viewer.to_world(self.figure.body, self.moved(vector))
        found = moved._replace(pose=self.start.pose.at[self.figure.rows].set(moved.pose))
        return found if self.fit_translation else found._replace(translation=self.start.translation)

    def moved(self, vector: Float[Array, "D"]) -> Variables:
        """The figure's parameters, of the joints that move alone, in the viewer's axes."""
        end = 3 * len(self.figure.moving)
        pose = vector[:end].reshape(-1, 3)
        translation, shape = self.start.translation, self.start.shape
        if self.fit_shape:
            shape = vector[len(vector) - len(shape) :]
        if self.fit_translation:
            return Variables(pose, shape, vector[end : end + 3])
        # Fixed in the world; in the viewer's axes it depends on where the root is, so on the shape.
        held = Variables(pose, shape, translation)
        return held._replace(translation=self.viewer.place_of(self.figure.body, held))

    def repacked(self, moved: Variables) -> Float[Array, "D"]:
        """The vector of the figure's parameters."""
        parts = [moved.pose.reshape(-1)]
        if self.fit_translation:
            parts.append(moved.translation)
        if self.fit_shape:
            parts.append(moved.shape)
        return jnp.concatenate(parts)

    def project(self, vector: Float[Array, "D"]) -> Float[Array, "K 2"]:
        """The keypoints of the body in the image, in pixels."""
        return self.viewer.camera.project(self.figure.posed(self.moved(vector)).points)

    def residuals(self, vector: Float[Array, "D"]) -> dict[str, Array]:
        """The terms' residuals, whose squares sum to the cost; `ridge` is not among the terms."""
        moved = self.moved(vector)
        posed = self.figure.posed(moved)
        off = (self.viewer.camera.project(posed.points) - self.keypoints) / self.pixels
        if self.robust is not None:
            square = jnp.sum(off**2, axis=-1, keepdims=True)
            off = off / jnp.sqrt(1 + square / self.robust**2)
        found = {"reprojection": jnp.sqrt(self.confidence)[:, None] * off}
        if self.prior is not None:
            found["prior"] = jnp.sqrt(self.weights.prior) * self.prior.residuals(moved.pose)
        if self.limits is not None:
            found["limits"] = jnp.sqrt(self.weights.limits) * self.limits.residuals(moved.pose)
        if self.fit_shape:
            found["shape"] = jnp.sqrt(self.weights.shape) * moved.shape
        upright = jnp.array([0.0, 1.0, 0.0], vector.dtype)
        found["upright"] = jnp.sqrt(self.weights.upright) * (posed.rotations[0, :, 1] - upright)
        ridge = jnp.sqrt(_RIDGE) * (vector - self.repacked(self.seen))
        if self.fit_translation:
            # Not of the translation: where a search starts it is zero, the camera's own place, and
            # a body of which one point is seen would walk into the camera.
            end = 3 * len(self.figure.moving)
            ridge = ridge.at[end : end + 3].set(0.0)
        found["ridge"] = ridge
        return found

    def costs(self, vector: Float[Array, "D"]) -> dict[str, Float[Array, ""]]:
        """The terms."""
        return {name: jnp.sum(r**2) for name, r in self.residuals(vector).items()}

    def cost(self, vector: Float[Array, "D"]) -> Float[Array, ""]:
        """Their sum, the ridge included."""
        return sum(self.costs(vector).values(), jnp.zeros((), vector.dtype))

    def unwhitening(self, vector: Float[Array, "D"]) -> Float[Array, "D D"]:
        """B such that in coordinates u, x = vector + B u, the cost is round near a point.

        B = L^-T with L L^T the Gauss-Newton matrix. A first-order solver in those coordinates goes
        straight to the keypoints' optimum, and what a regularizer adds is weighed against a plain
        sum of squares.
        """
        jacobian = jax.jacfwd(lambda x: jnp.concatenate(_flat(self.residuals(x))))(vector)
        matrix = jacobian.T @ jacobian
        eye = jnp.eye(len(matrix), dtype=matrix.dtype)
        factor = jnp.linalg.cholesky(matrix + _STIFFNESS * eye)
        return jax.scipy.linalg.solve_triangular(factor, eye, trans=1, lower=True)


def as_seen(figure: Figure, viewer: Viewer, variables: Variables) -> Variables:
    """Of a body in the world, the joints that move, in the viewer's axes."""
    seen = viewer.from_world(figure.body, variables)
    return seen._replace(pose=seen.pose[figure.rows])


def _flat(residuals: dict[str, Array]) -> list[Array]:
    return [r.reshape(-1) for r in residuals.values()]
