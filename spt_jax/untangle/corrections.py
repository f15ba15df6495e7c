"""Small turns of a motion's joints, what they move, and what is left of the overlap after them."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax._geometry import inflate
from spt_jax._penalty import self_intersection_penalty
from spt_jax.body import AbstractBody
from spt_jax.body.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from spt_jax.rest.surface import RestSurface
from spt_jax.untangle.descent import CENTIMETRE, STIFFNESS

# Vertices and frames by which a window's displacements are weighed.
_SAMPLED_VERTICES, _SAMPLED_FRAMES = 1500, 6

# Frames that one compiled call measures, so that each processor has some.
BATCH = 8


class Frames(NamedTuple):
    """The frames of a motion.

    Attributes:
        pose: axis-angle of each joint, in radians.
        shape: shape coefficients of each frame.
        translation: of each frame, in metres.
    """

    pose: Float[Array, "T J 3"] | Float[np.ndarray, "T J 3"]
    shape: Float[Array, "T B"] | Float[np.ndarray, "T B"]
    translation: Float[Array, "T 3"] | Float[np.ndarray, "T 3"]

    def at(self, frames: Int[np.ndarray, "N"]) -> "Frames":
        """Some of them, in arrays of NumPy: any number of frames is taken without a program."""
        return Frames(*(np.asarray(array)[frames] for array in self))

    def batches(self) -> Iterator[tuple[int, "Frames"]]:
        """All of them in batches of one size, so that one program does for any number.

        Returns:
            Of each batch how many frames are new; the last one fills it up.
        """
        count = len(self.pose)
        for start in range(0, count, BATCH):
            at = np.minimum(np.arange(start, start + BATCH), count - 1)
            yield min(BATCH, count - start), self.at(at)


def corrected(
    pose: Float[Array, "*batch J 3"], turn: Float[Array, "*batch K 3"]
) -> Float[Array, "*batch J 3"]:
    """The pose with every joint but the root turned on, in the axes of its own part.

    A turn that does not change keeps its place on a limb, however the limb moves, and whichever
    of its vectors a rotation is written as.
    """
    given = matrix_from_axis_angle(pose[..., 1:, :])
    turned = axis_angle_from_matrix(given @ matrix_from_axis_angle(turn))
    return jnp.concatenate([pose[..., :1, :], turned], axis=-2)


def as_given(
    pose: Float[np.ndarray, "T J 3"], like: Float[np.ndarray, "T J 3"]
) -> Float[np.ndarray, "T J 3"]:
    """The same rotations by those vectors that lie nearest to others: angles beyond pi stay so."""
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    axis = pose / np.where(angle > 0, angle, 1.0)
    along = np.sum(like * axis, axis=-1, keepdims=True)
    turns = np.where(angle > 0, np.round((along - angle) / (2 * np.pi)), 0.0)
    return np.where(turns == 0, pose, pose + axis * (2 * np.pi * turns).astype(pose.dtype))


@eqx.filter_jit
def _displacement_forms(body, frames: Frames, stride: int, feet, standing):
    """For each frame the quadratic form: turns -> mean squared displacement."""
    chosen = body.at_vertices(np.arange(0, body.num_vertices, stride))
    feet = feet[:, ::stride]
    size = jnp.maximum(feet.sum(axis=1), 1.0)

    def form(pose, shape, standing):
        zero = jnp.zeros_like(pose[1:])
        jacobian = jax.jacfwd(lambda turn: chosen(corrected(pose, turn), shape).vertices)(zero)
        jacobian = jacobian.reshape(-1, 3, zero.size)
        weight = 1 / len(jacobian) + (standing / size) @ feet
        flat = (jnp.sqrt(weight)[:, None, None] * jacobian).reshape(-1, zero.size)
        return flat.T @ flat

    return jax.lax.map(lambda x: form(*x), (frames.pose, frames.shape, standing))


def displacement_factor(
    body: AbstractBody,
    frames: Frames,
    feet: Bool[np.ndarray, "K V"],
    standing: Float[np.ndarray, "T K"],
) -> Float[np.ndarray, "N N"]:
    """Cholesky factor of the form: turns -> mean squared displacement, in a window's mean.

    One form for all frames of a window: a correction that is smooth in it is smooth in turns.

    Args:
        body: the body.
        frames: those of the window.
        feet: which vertices are of each foot.
        standing: what the mean squared displacement of each foot weighs, in each frame.
    """
    count = len(frames.pose)
    spread = np.arange(min(_SAMPLED_FRAMES, count)) * (count - 1) // max(_SAMPLED_FRAMES - 1, 1)
    # As many from the end as from the start: a motion played backwards weighs the same.
    chosen = np.concatenate([spread, count - 1 - spread])
    stride = max(body.num_vertices // _SAMPLED_VERTICES, 1)
    dtype = frames.pose.dtype
    forms = _displacement_forms(
        body,
        frames.at(chosen),
        stride,
        jnp.asarray(feet, dtype),
        jnp.asarray(standing[chosen], dtype),
    )
    form = np.asarray(forms, np.float64).mean(axis=0)
    return np.linalg.cholesky(form + STIFFNESS * np.eye(len(form)))


@eqx.filter_jit
def posed(body, frames: Frames) -> Float[Array, "T V 3"]:
    """The vertices of each frame."""
    return body(frames.pose, frames.shape, frames.translation).vertices


@eqx.filter_jit
def _turned(frames: Frames, turn):
    return corrected(jnp.asarray(frames.pose), turn)


@eqx.filter_jit
def _overlaps(body, rest: RestSurface | None, frames: Frames, turn, margin):
    def overlap(turn, pose, shape, translation, margin):
        vertices = body(corrected(pose, turn), shape, translation).vertices
        outer = inflate(vertices, body.faces, margin / 2)
        volume = self_intersection_penalty(outer, body.faces, rest_surface=rest)
        return volume / CENTIMETRE**3

    return jax.vmap(jax.value_and_grad(overlap))(turn, *frames, margin)


class Corrections(NamedTuple):
    """How vectors become turns of one body's joints in one window.

    A vector's squared length is the mean squared displacement in cm^2, to first order.
    """

    body: AbstractBody
    rest: RestSurface | None
    frames: Frames
    factor: Float[np.ndarray, "N N"]

    def turns(self, vectors: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T K 3"]:
        """Turns of the joints, in radians."""
        turn = np.linalg.solve(self.factor.T, CENTIMETRE * vectors.T).T
        return turn.reshape(len(vectors), -1, 3)

    def vectors(self, turns: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T N"]:
        """The vectors of turns."""
        return turns.reshape(-1, len(self.factor)) @ self.factor / CENTIMETRE

    def overlaps(
        self,
        chosen: Int[np.ndarray, "F"],
        vectors: Float[np.ndarray, "F N"],
        margin: Float[np.ndarray, "F"],
    ) -> tuple[Float[np.ndarray, "F"], Float[np.ndarray, "F N"]]:
        """The overlap of some frames, in cm^3, and its gradient by the vectors.

        Args:
            chosen: which frames.
            vectors: their corrections.
            margin: how far apart colliding parts are to be pushed, in metres.
        """
        turns = self.turns(vectors)
        values, gradients = [], []
        for start in range(0, len(chosen), BATCH):
            # The last one again, which is measured once: one program does for any number.
            at = np.minimum(np.arange(start, start + BATCH), len(chosen) - 1)
            dtype = self.frames.pose.dtype
            value, gradient = _overlaps(
                self.body,
                self.rest,
                self.frames.at(chosen[at]),
                jnp.asarray(turns[at], dtype),
                jnp.asarray(margin[at], dtype),
            )
            values.append(np.asarray(value, np.float64))
            gradients.append(np.asarray(gradient, np.float64).reshape(BATCH, -1))
        value = np.concatenate(values)[: len(chosen)]
        by_turn = np.concatenate(gradients)[: len(chosen)]
        return value, CENTIMETRE * np.linalg.solve(self.factor, by_turn.T).T

    def poses(
        self, chosen: Int[np.ndarray, "F"], vectors: Float[np.ndarray, "F N"]
    ) -> Float[np.ndarray, "F J 3"]:
        """The corrected poses of some frames, written as the poses given are."""
        dtype = self.frames.pose.dtype
        given = np.asarray(self.frames.pose)[chosen]
        padded = -(-len(chosen) // BATCH) * BATCH
        at = np.minimum(np.arange(padded), len(chosen) - 1)
        turns = jnp.asarray(self.turns(vectors)[at], dtype)
        found = np.asarray(_turned(self.frames.at(chosen[at]), turns))[: len(chosen)]
        return as_given(found, given)
