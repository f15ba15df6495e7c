"""Depth flips: the other poses of a limb that look the same in an image."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.body.rotations import axis_angle_from_matrix
from spt_jax.fit.problem.objective import Objective

_LIMBS = (
    ("left_hip", "left_knee", "left_ankle"),
    ("right_hip", "right_knee", "right_ankle"),
    ("left_shoulder", "left_elbow", "left_wrist"),
    ("right_shoulder", "right_elbow", "right_wrist"),
)
# Which of a limb's two bones are flipped.
_WAYS = ((True, False), (False, True), (True, True))

Limb = tuple[int, int, int]


def limbs_of(body: BodyModel) -> tuple[Limb, ...]:
    """Legs and arms as (upper joint, middle joint, end), where the body has them."""
    names = body.joint_names
    return tuple(
        (names.index(a), names.index(b), names.index(c))
        for a, b, c in _LIMBS
        if a in names and b in names and c in names
    )


def num_flips(limbs: tuple[Limb, ...]) -> int:
    """How many flips of one limb there are."""
    return len(limbs) * len(_WAYS)


def limb_flips(
    objective: Objective, vector: Float[Array, "D"], limbs: tuple[Limb, ...]
) -> Float[Array, "flips D"]:
    """The variables with one limb flipped at a time, three ways each.

    A bone of known length whose upper end is known meets the line of sight through its lower end
    twice; the second meeting is the bone's mirror image in the plane across that line (Sminchisescu
    and Triggs 2003, "kinematic jumps"). The bone turns there by the smallest rotation; what hangs
    below a flipped bone keeps its orientation in the world, so that it looks the same too, up to
    the change of perspective with its new depth, which is left to the solver.
    """
    moved = objective.moved(vector)
    _, at, world = objective.figure.posed(moved)
    above = [objective.figure.body.parents[limb[0]] for limb in limbs]
    chains = np.array([(top, *limb) for top, limb in zip(above, limbs, strict=True) for _ in _WAYS])
    turns = jnp.array([way for _ in limbs for way in _WAYS])

    def flipped(chain, turned):
        # Both bones at once, and all three rotations: a fit compiles each of these functions once.
        mirroring = jax.vmap(_mirroring)(at[chain[1:3]], at[chain[2:4]])
        kept = jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), (2, 3, 3))
        before = world[chain]
        after = jnp.where(turned[:, None, None], mirroring, kept) @ before[1:3]
        parents = jnp.concatenate([before[:1], after])
        children = jnp.concatenate([after, before[3:]])
        relative = axis_angle_from_matrix(jnp.swapaxes(parents, -1, -2) @ children)
        return objective.repacked(moved._replace(pose=moved.pose.at[chain[1:]].set(relative)))

    return jax.vmap(flipped)(chains, turns)


def _mirroring(start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The smallest rotation that takes a bone to its mirror image across the line of sight."""
    bone, sight = _unit(end - start), _unit(end)  # the viewer is at the origin
    image = bone - 2 * jnp.dot(bone, sight) * sight
    axis = jnp.cross(bone, image)
    x, y, z = axis
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    # A bone along the line of sight turns round: any axis will do, and the solver takes over.
    opposite = 1 + jnp.dot(bone, image)
    return jnp.eye(3, dtype=bone.dtype) + cross + cross @ cross / jnp.maximum(opposite, 1e-3)


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    square = jnp.sum(vector**2)
    tiny = square < 1e-12
    return vector / jnp.sqrt(jnp.where(tiny, 1.0, square))


def combined_flips(
    objective: Objective,
    limbs: tuple[Limb, ...],
    vector: Float[Array, "D"],
    cost: Float[Array, ""],
    flipped: Float[Array, "flips D"],
    costs: Float[Array, "flips"],
    count: int,
) -> Float[Array, "count D"]:
    """Poses whose limbs are flipped together, those with the lowest sums of costs first.

    Limbs share little but the trunk, so what a flip of one changes in the cost is added up over
    the limbs: 4^4 sums in place of as many fits.

    Args:
        objective: whose variables they are.
        limbs: from `limbs_of`.
        vector, cost: the variables with no limb flipped, and what they cost.
        flipped, costs: those with one limb flipped, as `limb_flips` orders them.
        count: how many.
    """
    ways = len(_WAYS) + 1
    change = (costs - cost).reshape(len(limbs), -1)
    # A cost that is not finite must not turn a sum into "not a number".
    change = jnp.nan_to_num(change, nan=1e9, posinf=1e9, neginf=1e9)
    change = jnp.concatenate([jnp.zeros((len(limbs), 1), costs.dtype), change], axis=1)
    grid = np.meshgrid(*[np.arange(ways)] * len(limbs), indexing="ij")
    every = np.stack(grid, axis=-1).reshape(-1, len(limbs))
    total = jnp.sum(change[np.arange(len(limbs)), every], axis=-1)
    _, best = jax.lax.top_k(-total, min(count, len(every)))
    chosen = jnp.asarray(every)[jnp.resize(best, (count,))]

    moved = objective.moved(vector)
    poses = jax.vmap(lambda x: objective.moved(x).pose)(jnp.concatenate([vector[None], flipped]))

    def assembled(way):
        row = jnp.where(way == 0, 0, way + np.arange(len(limbs)) * len(_WAYS))
        joints = np.array(limbs)
        turned = poses[row[:, None], joints]
        return objective.repacked(moved._replace(pose=moved.pose.at[joints].set(turned)))

    return jax.vmap(assembled)(chosen)
