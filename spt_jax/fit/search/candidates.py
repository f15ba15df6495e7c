"""Fits to the keypoints alone, from several starts and through the depth flips of the limbs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from spt_jax.fit.problem.objective import Objective
from spt_jax.fit.search.flips import Limb, combined_flips, limb_flips, num_flips
from spt_jax.fit.search.starts import orientation_starts

# Two fits whose variables agree to this, in radians and metres, are the same fit found twice.
_SAME = 0.15

_TRACED_BEST = 2  # candidates whose limbs are flipped


class Candidates(NamedTuple):
    """Local minima, the best first."""

    vectors: Float[Array, "M D"]
    costs: Float[Array, "M"]
    steps: Int[Array, ""]


def find_candidates(
    objective: Objective,
    limbs: tuple[Limb, ...],
    starts: int,
    solver: optx.AbstractMinimiser,
    max_steps: int,
    count: int,
) -> Candidates:
    """Different minima of the keypoints' objective, the best first.

    `starts` orientations are fitted; then every limb of the two best is flipped in depth, one at a
    time and three ways, and fitted; then the limbs' flips with the lowest sums of costs together.
    All of that goes through one loop that fits `starts` lanes a round: compiled once, where three
    calls of the solver took three times as long to compile.

    Args:
        objective: of one person.
        limbs: from `limbs_of`; without any nothing is flipped.
        starts: orientations tried, and lanes of a round.
        solver: any optimistix minimiser.
        max_steps: for each fit.
        count: how many minima to return; where fewer were found the best comes several times.
    """
    vectors, costs, steps = _rounds(objective, limbs, starts, solver, max_steps)
    best = _distinct(vectors, costs, count)
    return Candidates(vectors[best], costs[best], steps)


def refine_start(
    objective: Objective, solver: optx.AbstractMinimiser, max_steps: int
) -> Candidates:
    """The one minimum that is reached from the start that the user gave."""
    start = objective.repacked(objective.seen)
    fitted, steps = _fit(objective, start, solver, max_steps)
    vector = jnp.where(jnp.isfinite(objective.cost(fitted)), fitted, start)
    return Candidates(vector[None], objective.cost(vector)[None], steps)


def _rounds(objective, limbs, starts, solver, max_steps):
    # What a round fits: 0 orientations, 1 a part of the flips, 2 flips combined.
    flips = _TRACED_BEST * num_flips(limbs)
    chunks = -(-flips // starts)
    kinds = [0] + [1] * chunks + [2] * bool(limbs)
    first = orientation_starts(objective, starts)

    def orientations(best, vectors, costs, chunk):
        return first

    def flipped(best, vectors, costs, chunk):
        every = jax.vmap(lambda x: limb_flips(objective, x, limbs))(vectors[best])
        padded = every.reshape(flips, -1)[np.arange(chunks * starts) % flips]
        return jax.lax.dynamic_slice_in_dim(padded, chunk * starts, starts)

    def combined(best, vectors, costs, chunk):
        rows = slice(starts, starts + flips)
        alone, found = vectors[best], costs[best]
        changed = (vectors[rows].reshape(_TRACED_BEST, -1, alone.shape[-1]),)
        changed += (costs[rows].reshape(_TRACED_BEST, -1),)
        each = -(-starts // _TRACED_BEST)
        mixed = jax.vmap(
            lambda x, cost, others, theirs: combined_flips(
                objective, limbs, x, cost, others, theirs, each
            )
        )(alone, found, *changed)
        # Turn about: the best combination of the one, of the other, the second best of the one.
        return mixed.transpose(1, 0, 2).reshape(-1, alone.shape[-1])[:starts]

    def one_round(carry, what):
        vectors, costs, steps = carry
        kind, chunk, place = what
        branches = [orientations, flipped, combined] if limbs else [orientations]
        best = _distinct(vectors[:starts], costs[:starts], _TRACED_BEST)
        lanes = jax.lax.switch(kind, branches, best, vectors, costs, chunk)
        fitted, taken = jax.vmap(lambda x: _fit(objective, x, solver, max_steps))(lanes)
        # A solver that was thrown off course hands back where it was thrown: not a candidate.
        found = _finite(jax.vmap(objective.cost)(fitted))
        vectors = jax.lax.dynamic_update_slice_in_dim(vectors, fitted, place, 0)
        costs = jax.lax.dynamic_update_slice_in_dim(costs, found, place, 0)
        return (vectors, costs, steps + jnp.sum(taken)), None

    schedule = (
        jnp.array(kinds),
        jnp.array([max(k - 1, 0) for k in range(len(kinds))]),
        jnp.arange(len(kinds)) * starts,
    )
    # What has not been fitted yet, and what a solver lost, stays where the search began.
    size = len(kinds) * starts
    empty = jnp.broadcast_to(first[:1], (size, first.shape[-1]))
    unknown = jnp.full(size, jnp.inf, first.dtype)
    done, _ = jax.lax.scan(one_round, (empty, unknown, jnp.array(0)), schedule)
    return done


def _fit(objective: Objective, vector, solver, max_steps):
    back = objective.unwhitening(vector)

    def cost(white, _):
        return objective.cost(vector + back @ white)

    solution = optx.minimise(
        cost, solver, jnp.zeros_like(vector), None, max_steps=max_steps, throw=False
    )
    return vector + back @ solution.value, jnp.asarray(solution.stats["num_steps"])


def _distinct(vectors, costs, count):
    """Of the best minima that are not the same, the best first; the best again where they end."""

    def choose(costs, _):
        following = jnp.argmin(costs)
        near = jnp.max(jnp.abs(vectors - vectors[following][None]), axis=-1) < _SAME
        left = jnp.isfinite(costs[following])
        return jnp.where(near, jnp.inf, costs), jnp.where(left, following, jnp.argmin(first))

    first = costs
    return jax.lax.scan(choose, costs, length=count)[1]


def _finite(costs: Float[Array, "N"]) -> Float[Array, "N"]:
    return jnp.where(jnp.isfinite(costs), costs, jnp.inf)
