"""Small turns of a motion's joints, what they move, and what is left of the overlap after them."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from spt_jax._geometry import inflate
from spt_jax._groups import join_bodies
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
    """The frames of a motion of P people with the same body, mostly one.

    Attributes:
        pose: axis-angle of each joint, in radians.
        shape: shape coefficients of each frame.
        translation: of each frame, in metres.
    """

    pose: Float[Array, "T P J 3"] | Float[np.ndarray, "T P J 3"]
    shape: Float[Array, "T P B"] | Float[np.ndarray, "T P B"]
    translation: Float[Array, "T P 3"] | Float[np.ndarray, "T P 3"]

    @property
    def people(self) -> int:
        """How many there are."""
        return self.pose.shape[1]

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


def faces_of(body: AbstractBody, people: int) -> Int[np.ndarray, "F 3"]:
    """The triangles of so many people as one mesh."""
    faces = np.asarray(body.faces, np.int64)
    if people == 1:
        return faces
    return np.concatenate([faces + k * body.num_vertices for k in range(people)])


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
    pose: Float[np.ndarray, "*batch 3"], like: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """The same rotations by those vectors that lie nearest to others: angles beyond pi stay so."""
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    axis = pose / np.where(angle > 0, angle, 1.0)
    along = np.sum(like * axis, axis=-1, keepdims=True)
    turns = np.where(angle > 0, np.round((along - angle) / (2 * np.pi)), 0.0)
    return np.where(turns == 0, pose, pose + axis * (2 * np.pi * turns).astype(pose.dtype))


@eqx.filter_jit
def _displacement_forms(body, frames: Frames, stride: int):
    """For each frame and person the quadratic form: turns -> mean squared displacement."""
    chosen = body.at_vertices(np.arange(0, body.num_vertices, stride))

    def form(pose, shape):
        zero = jnp.zeros_like(pose[1:])
        jacobian = jax.jacfwd(lambda turn: chosen(corrected(pose, turn), shape).vertices)(zero)
        flat = jacobian.reshape(-1, zero.size)
        return flat.T @ flat / len(jacobian)

    def of_frame(frame):
        return jax.vmap(form)(*frame)

    return jax.lax.map(of_frame, (frames.pose, frames.shape))


def displacement_factors(body: AbstractBody, frames: Frames) -> Float[np.ndarray, "P N N"]:
    """Of each person the Cholesky factor of: turns -> mean squared displacement.

    One form for all frames of a window, their mean: a correction that is smooth in it is smooth in
    turns.
    """
    count = len(frames.pose)
    spread = np.arange(min(_SAMPLED_FRAMES, count)) * (count - 1) // max(_SAMPLED_FRAMES - 1, 1)
    # As many from the end as from the start: a motion played backwards weighs the same.
    chosen = np.concatenate([spread, count - 1 - spread])
    stride = max(body.num_vertices // _SAMPLED_VERTICES, 1)
    # One program for windows of all lengths: in short ones the last frame stands in for others.
    filled = np.pad(chosen, (0, 2 * _SAMPLED_FRAMES - len(chosen)), mode="edge")
    forms = _displacement_forms(body, frames.at(filled), stride)
    form = np.asarray(forms, np.float64)[: len(chosen)].mean(axis=0)
    return np.linalg.cholesky(form + STIFFNESS * np.eye(form.shape[-1]))


@eqx.filter_jit
def posed(body, frames: Frames) -> Float[Array, "T V 3"]:
    """The vertices of each frame, those of all people one after the other."""
    vertices = body(frames.pose, frames.shape, frames.translation).vertices
    return vertices.reshape(len(vertices), -1, 3)


@eqx.filter_jit
def _turned(frames: Frames, turn):
    return corrected(jnp.asarray(frames.pose), turn)


@eqx.filter_jit
def _overlaps(body, rest: RestSurface | None, frames: Frames, turn, margin):
    def overlap(turn, pose, shape, translation, margin):
        vertices = body(corrected(pose, turn), shape, translation).vertices
        scene = join_bodies(vertices, body.faces)
        outer = inflate(scene.vertices, scene.faces, margin / 2)
        volume = self_intersection_penalty(outer, scene.faces, rest_surface=rest)
        return volume / CENTIMETRE**3

    return jax.vmap(jax.value_and_grad(overlap))(turn, *frames, margin)


class Corrections(NamedTuple):
    """How vectors become turns of joints in one window.

    A vector's squared length is the mean squared displacement in cm^2, to first order; of several
    people, the sum of theirs.

    Attributes:
        body: that of all people.
        rest: the rest surface of all of them.
        frames: those of the window.
        factor, inverse: of each person, as `displacement_factors` has it.
    """

    body: AbstractBody
    rest: RestSurface | None
    frames: Frames
    factor: Float[np.ndarray, "P N N"]
    inverse: Float[np.ndarray, "P N N"]

    @classmethod
    def of(cls, body: AbstractBody, rest: RestSurface | None, frames: Frames) -> "Corrections":
        """Those of some frames."""
        factor = displacement_factors(body, frames)
        return cls(body, rest, frames, factor, np.linalg.inv(factor))

    @property
    def size(self) -> int:
        """How many numbers a frame's vector has."""
        return self.factor.shape[0] * self.factor.shape[1]

    def turns(self, vectors: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T P K 3"]:
        """Turns of the joints, in radians."""
        people, size, _ = self.factor.shape
        of_person = CENTIMETRE * vectors.reshape(len(vectors), people, size)
        turn = np.einsum("tpn,pnk->tpk", of_person, self.inverse, optimize=True)
        return turn.reshape(len(vectors), people, size // 3, 3)

    def vectors(self, turns: Float[np.ndarray, "T P K 3"]) -> Float[np.ndarray, "T N"]:
        """The vectors of turns."""
        flat = turns.reshape(-1, len(self.factor), self.factor.shape[1])
        return (
            np.einsum("tpk,pkn->tpn", flat, self.factor, optimize=True).reshape(-1, self.size)
            / CENTIMETRE
        )

    def slopes(self, by_turn: Float[np.ndarray, "*rows N"]) -> Float[np.ndarray, "*rows N"]:
        """Derivatives by the vectors, of those by the turns."""
        flat = by_turn.reshape(-1, len(self.factor), self.factor.shape[1])
        found = np.einsum("tpn,pkn->tpk", flat, self.inverse, optimize=True)
        return CENTIMETRE * found.reshape(by_turn.shape)

    def batches(
        self, chosen: Int[np.ndarray, "F"], turns: Float[np.ndarray, "F P K 3"]
    ) -> Iterator[tuple[Int[np.ndarray, "B"], Frames, Array]]:
        """Rows of `chosen`, their frames and turns, in batches of one size.

        The last row again fills the last batch: one program does for any number.
        """
        for start in range(0, len(chosen), BATCH):
            at = np.minimum(np.arange(start, start + BATCH), len(chosen) - 1)
            yield at, self.frames.at(chosen[at]), jnp.asarray(turns[at], self.frames.pose.dtype)

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
        values, gradients = [], []
        for at, frames, turn in self.batches(chosen, self.turns(vectors)):
            apart = jnp.asarray(margin[at], turn.dtype)
            value, gradient = _overlaps(self.body, self.rest, frames, turn, apart)
            values.append(np.asarray(value, np.float64))
            gradients.append(np.asarray(gradient, np.float64).reshape(len(at), -1))
        by_turn = np.concatenate(gradients)[: len(chosen)]
        return np.concatenate(values)[: len(chosen)], self.slopes(by_turn)

    def poses(
        self, chosen: Int[np.ndarray, "F"], vectors: Float[np.ndarray, "F N"]
    ) -> Float[np.ndarray, "F P J 3"]:
        """The corrected poses of some frames, written as the poses given are."""
        given = np.asarray(self.frames.pose)[chosen]
        parts = [
            np.asarray(_turned(frames, turn))
            for _, frames, turn in self.batches(chosen, self.turns(vectors))
        ]
        return as_given(np.concatenate(parts)[: len(chosen)], given)
