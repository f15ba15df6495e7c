"""The descents of the paper's sections 4.1 and 4.2, which `paper_figures` draws and reports.

"Plain gradient descent" is `pose - rate * gradient`, jitted, over every pose parameter, the global
orientation included; shape fixed, 512 x 512 rays along one direction, the paper's rate 1e-4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from rich.progress import Progress

from spt_jax import paper_penalty, self_intersection_penalty
from spt_jax._labels import classify_vertices
from spt_jax.body import BodyModel, load_mocap

RATE = 1e-4
EVERY = 10  # the paper shows every tenth iteration
LONG, SHORT = 300, 100
CM3 = 1e6  # of a cubic metre

NAMES = ("arm in chest", "legs crossed", "spinkick/0057")

Tree = Any
Penalty = Callable[[Tree], Float[Array, "*batch"]]


class Descent(NamedTuple):
    """A run: the penalty (Eq. 11) before each step, and the parameters at every tenth."""

    values: Float[np.ndarray, "steps *batch"]
    snapshots: list[Tree]
    first_step: float
    """Norm of the first step's change of pose, in radians, averaged over the poses."""


def start_poses(body: BodyModel) -> Float[Array, "3 J 3"]:
    """Two frames of a walk with limbs turned into the body, and a kick as it was captured."""
    walk, kick = _frame(body, "walk/0010"), _frame(body, "spinkick/0057")
    arm = _turn(body, walk, left_shoulder=(0.0, -0.9, -0.3), left_elbow=(0.0, -0.6, 0.0))
    return jnp.stack([arm, _cross_legs(body, walk), kick])


def start_pair(body: BodyModel) -> tuple[Float[Array, "2 J 3"], Float[Array, "2 3"]]:
    """Two bodies half a metre apart, each in itself, and one's forearm in the other's chest."""
    walk = _frame(body, "walk/0010")
    left = _turn(body, walk, right_shoulder=(0.0, 0.9, 0.3), right_elbow=(0.0, 0.6, 0.0))
    right = _turn(body, _cross_legs(body, walk), right_shoulder=(0.0, 0.0, -0.8))
    return jnp.stack([left, right]), jnp.array([[-0.25, 0.0, 0.0], [0.25, 0.0, 0.0]])


def _frame(body: BodyModel, name: str) -> Float[Array, "J 3"]:
    mocap = load_mocap()
    return body.pose_from_smpl(mocap.pose[mocap.names.index(name)])


def _turn(body: BodyModel, pose: Array, **turns: tuple[float, float, float]) -> Array:
    for joint, axis_angle in turns.items():
        pose = pose.at[body.joint_names.index(joint)].add(jnp.array(axis_angle))
    return pose


def _cross_legs(body: BodyModel, pose: Array) -> Array:
    return _turn(body, pose, left_hip=(0.0, 0.0, -0.35), right_hip=(0.0, 0.0, 0.25))


class Descender:
    """Gradient descent on one penalty; its step is compiled once for every rate."""

    def __init__(self, penalty: Penalty, bars: Progress):
        def total(parameters):
            values = penalty(parameters)
            return values.sum(), values

        gradient = jax.value_and_grad(total, has_aux=True)

        @jax.jit
        def step(parameters, rates):
            (_, values), slopes = gradient(parameters)
            moved = jax.tree.map(lambda x, r, s: x - r * s, parameters, rates, slopes)
            return moved, values, slopes

        self._step, self._bars = step, bars

    def gradient(self, parameters: Tree) -> Tree:
        """The penalty's gradient at some parameters."""
        return self._step(parameters, jax.tree.map(jnp.zeros_like, parameters))[2]

    def run(self, name: str, start: Tree, rates: Tree, iterations: int) -> Descent:
        """Descend from `start`; `rates` is a tree like it that broadcasts against it."""
        parameters, values, snapshots = start, [], []
        bar = self._bars.add_task(name, total=iterations + 1)
        for iteration in range(iterations + 1):
            if iteration % EVERY == 0:
                snapshots.append(parameters)
            parameters, value, _ = self._step(parameters, rates)
            values.append(np.asarray(value))
            if iteration == 0:
                change = jax.tree.leaves(parameters)[0] - jax.tree.leaves(start)[0]
            self._bars.advance(bar)
        self._bars.remove_task(bar)
        first = float(jnp.linalg.norm(change, axis=(-2, -1)).mean())
        return Descent(np.stack(values), snapshots, first)


class Singles(NamedTuple):
    """Section 4.1's runs, by equation and rate, with the overlap volume at every tenth step."""

    runs: dict[tuple[str, float], Descent]
    volumes: dict[tuple[str, float], Float[np.ndarray, "snapshots 3"]]
    faces: Int[np.ndarray, "F 3"]


def run_singles(body: BodyModel, bars: Progress) -> Singles:
    """Eq. 10 at the paper's rate and at 10 and 100 times it; Eq. 9 beside each.

    Eq. 9's rate is scaled for each pose so that its first step is as long as Eq. 10's: its vectors
    are areas, and at the paper's rate ("Eq. 9, same rate") they move nothing.
    """
    start = start_poses(body)

    def descender(normalize: bool) -> Descender:
        return Descender(
            lambda pose: paper_penalty(body(pose).vertices, body.faces, normalize=normalize), bars
        )

    unit, area = descender(True), descender(False)
    lengths = [jnp.linalg.norm(d.gradient(start), axis=(1, 2)) for d in (unit, area)]
    scale = (lengths[0] / lengths[1])[:, None, None]
    one = jnp.ones_like(scale)
    runs = {("Eq. 9, same rate", RATE): area.run("Eq. 9, same rate", start, RATE * one, SHORT)}
    for factor, iterations in ((1, LONG), (10, SHORT), (100, SHORT)):
        rate = factor * RATE
        for name, one_descender, rates in (("Eq. 10", unit, one), ("Eq. 9", area, scale)):
            runs[name, rate] = one_descender.run(
                f"{name}, {rate:g}", start, rate * rates, iterations
            )
    volume = jax.jit(lambda p: CM3 * self_intersection_penalty(body(p).vertices, body.faces))
    volumes = {key: np.stack([volume(p) for p in run.snapshots]) for key, run in runs.items()}
    return Singles(runs, volumes, np.asarray(body.faces))


class Kinds(NamedTuple):
    """Overlap of two bodies, apart: each within itself, and one within the other."""

    own: float
    between: float
    own_volume: float
    between_volume: float


class Pairs(NamedTuple):
    """Section 4.2's runs by name, and the kinds of overlap at every tenth step."""

    runs: dict[str, Descent]
    kinds: dict[str, list[Kinds]]
    faces: Int[np.ndarray, "F 3"]


def run_pairs(body: BodyModel, bars: Progress) -> Pairs:
    """Both bodies as one mesh; both poses descend together, the places fixed or free."""
    start, count = start_pair(body), body.num_vertices
    faces = np.concatenate([body.faces, np.asarray(body.faces) + count])

    @jax.jit
    def kinds(parameters) -> tuple:
        vertices = as_one_mesh(body, parameters)
        halves = vertices.reshape(2, count, 3)
        union = classify_vertices(vertices, faces, directions=1, rays=512, rule="triangle").clear
        alone = classify_vertices(
            halves, body.faces, directions=1, rays=512, rule="triangle"
        ).clear.reshape(-1)
        volumes = self_intersection_penalty(halves, body.faces).sum()
        whole = self_intersection_penalty(vertices, faces)
        shares = jnp.mean(~alone), jnp.mean(~union & alone)
        return (*shares, CM3 * volumes, CM3 * (whole - volumes))

    descender = Descender(lambda p: paper_penalty(as_one_mesh(body, p), faces), bars)
    runs = {}
    for name, rate, place_rate, iterations in (
        ("places fixed", RATE, 0.0, LONG),
        ("places fixed, rate 1e-3", 10 * RATE, 0.0, SHORT),
        ("places free", RATE, RATE, SHORT),
    ):
        rates = (jnp.array(rate), jnp.array(place_rate))
        runs[name] = descender.run(f"two bodies, {name}", start, rates, iterations)
    measured = {
        name: [Kinds(*map(float, kinds(p))) for p in run.snapshots] for name, run in runs.items()
    }
    return Pairs(runs, measured, faces)


def as_one_mesh(body: BodyModel, parameters: tuple[Array, Array]) -> Float[Array, "V 3"]:
    """The vertices of all bodies, one after another."""
    poses, places = parameters
    return body(poses, None, places).vertices.reshape(-1, 3)
