"""The keypoints' objective with a regularizer whose weight rises from stage to stage."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from spt_jax.body import BodyModel
from spt_jax.fit.problem.objective import Objective
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.regularizers._base import Regularizer


class Descent(NamedTuple):
    """Where the stages ended."""

    vectors: Float[Array, "N D"]
    cost: Float[Array, ""]  # of the keypoints' objectives of all people
    energy: Float[Array, ""]  # of the regularizer, without its weight
    steps: Int[Array, ""]
    converged: Bool[Array, ""]  # of the last stage


def descend(
    regularizer: Regularizer,
    body: BodyModel,
    people: Objective,
    vectors: Float[Array, "N D"],
    solver: optx.AbstractMinimiser,
    max_steps: int,
) -> Descent:
    """Minimise the objectives of N people and a regularizer of all of them together.

    Each stage minimises cost + weight * energy from where the last one ended, in coordinates in
    which the cost is round there (`Objective.unwhitening`).

    Args:
        regularizer: prepared for the body and N people.
        body: the model.
        people: the objectives, stacked.
        vectors: where to start.
        solver: any optimistix minimiser.
        max_steps: of each stage.
    """
    start = jax.vmap(lambda one: one.start)(people)

    def stage(carry, weight):
        vectors, steps = carry
        back = jax.vmap(lambda one, x: one.unwhitening(x))(people, vectors)

        def moved(white):
            return vectors + jnp.einsum("nij,nj->ni", back, white)

        def total(white, _):
            now = moved(white)
            return total_cost(people, now) + weight * energy(now)

        def energy(now):
            return regularizer.energy(body, start, unpacked(people, now))

        solution = optx.minimise(
            total, solver, jnp.zeros_like(vectors), None, max_steps=max_steps, throw=False
        )
        ended = moved(solution.value)
        # A fixed-step solver may end in a place that is no number; the stage then did nothing.
        usable = jnp.all(jnp.isfinite(ended))
        carry = jnp.where(usable, ended, vectors), steps + solution.stats["num_steps"]
        return carry, (solution.result == optx.RESULTS.successful) & usable

    weights = regularizer.weights.astype(vectors.dtype)
    (vectors, steps), converged = jax.lax.scan(stage, (vectors, jnp.array(0)), weights)
    now = unpacked(people, vectors)
    return Descent(
        vectors,
        total_cost(people, vectors),
        regularizer.energy(body, start, now),
        steps,
        converged[-1],
    )


def total_cost(people: Objective, vectors: Float[Array, "N D"]) -> Float[Array, ""]:
    """The keypoints' objectives of all people."""
    return jnp.sum(jax.vmap(lambda one, x: one.cost(x))(people, vectors))


def unpacked(people: Objective, vectors: Float[Array, "N D"]) -> Variables:
    """The parameters of all people, (N, ...)."""
    return jax.vmap(lambda one, x: one.unpack(x))(people, vectors)
