"""A minimiser made for a displacement and an overlap: each step goes to the edge of contact.

A line search does not know how far contact is. Near contact an overlap's volume grows with the
square of its depth, so the root of the penalty p grows in proportion to it: c = sqrt(p) is about
the length of a vector that is linear in the pose, a convex function. Each evaluation gives a plane
under it, a cut, and the next place is where the model

    |y|^2 + max(0, c_k + c_k' . (y - y_k) for every cut k)^2

is least: a bundle method (Kiwiel 1985, "Methods of Descent for Nondifferentiable Optimization",
https://doi.org/10.1007/BFb0074500), and with one cut the step that reliability analysis takes to
the nearest point of failure (Hasofer and Lind 1974; Rackwitz and Fiessler 1978). Where c turns out
lower than a cut said, the cut is lowered; where a step makes things worse, the next one is held to
the best place.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

# Cuts that are kept, the latest ones; and rounds over them in which the model is solved, by which
# it is known to three digits or more.
_CUTS = 16
_ROUNDS = 100

# How strongly a step is held to the best place after one that made things worse, how much more
# after the next, and how much less after one that did well.
_HELD, _MORE, _LESS = 1.0, 4.0, 0.25


class _State(eqx.Module):
    """What is known between two evaluations.

    Attributes:
        slope, height: the cuts c >= height + slope . y; cuts not there yet have a height of -inf.
        place: where the function is evaluated next.
        value: the least one found.
        steps: how many evaluations there were.
        held: how strongly the next place is held to the best one.
        done: whether the model promises no more than `rtol` of the value.
    """

    slope: Float[Array, "K N"]
    height: Float[Array, " K"]
    place: Float[Array, " N"]
    value: Float[Array, ""]
    steps: Int[Array, ""]
    held: Float[Array, ""]
    done: Bool[Array, ""]
    aux: Any


class ContactSolver(optx.AbstractMinimiser):
    """Minimises f(y) = |y|^2 + p(y), p >= 0, for one array y: see the module's docstring.

    Attributes:
        rtol: it ends where the model promises to take away no more than this part of f.
        atol: or no more than this.
        norm: of no use here.
    """

    rtol: float
    atol: float
    norm: Any = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first evaluation, which is at y."""
        del fn, args, options, tags
        dtype = f_struct.dtype
        return _State(
            slope=jnp.zeros((_CUTS, y.size), dtype),
            height=jnp.full(_CUTS, -jnp.inf, dtype),
            place=y,
            value=jnp.array(jnp.inf, dtype),
            steps=jnp.array(0),
            held=jnp.array(0.0, dtype),
            done=jnp.array(False),
            aux=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), aux_struct),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        """One evaluation, and where the next one is to be."""
        del options, tags
        at = state.place
        (value, aux), gradient = jax.value_and_grad(lambda x: fn(x, args), has_aux=True)(at)
        usable = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        better = usable & (value < state.value)
        first = state.steps == 0
        held = jnp.where(
            better,
            jnp.where(state.held > _LESS * _HELD, _LESS * state.held, 0.0),
            jnp.maximum(_MORE * state.held, _HELD),
        )
        best = jnp.where(better, at, y)
        least = jnp.where(better, value, state.value)
        slope, height = _with_cut(state, at, value, gradient, usable)
        place, promised = _model_minimum(slope, height, best, jnp.where(first, 0.0, held))
        gain = least - promised
        aux = jax.tree.map(lambda new, old: jnp.where(better, new, old), aux, state.aux)
        return (
            best,
            _State(
                slope=slope,
                height=height,
                place=jnp.where(jnp.isfinite(place).all(), place, best),
                value=least,
                steps=state.steps + 1,
                held=jnp.where(first, 0.0, held),
                done=~(gain > self.rtol * least + self.atol),
                aux=aux,
            ),
            aux,
        )

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the model promises nothing more."""
        del fn, y, args, options, tags
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """Nothing is left to do."""
        del fn, args, options, state, tags, result
        return y, aux, {}


def _with_cut(state: _State, at, value, gradient, usable):
    """The cuts, none above what was found at a place, and the one from there."""
    squared = jnp.maximum(value - jnp.sum(at**2), 0.0)
    root = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    there = jnp.where(squared > 0, root, 0.0)
    known = jnp.isfinite(state.height)
    said = jnp.where(known, state.height, 0.0) + state.slope @ at
    height = jnp.where(known, state.height - jnp.maximum(said - there, 0.0), -jnp.inf)
    slope = (gradient - 2 * at) / (2 * root)
    fresh = usable & (squared > 0)
    # The oldest one goes.
    slopes = jnp.concatenate([state.slope[1:], slope[None]])
    heights = jnp.append(height[1:], root - slope @ at)
    kept = jnp.where(usable, height, state.height)
    return jnp.where(fresh, slopes, state.slope), jnp.where(fresh, heights, kept)


def _model_minimum(slope, height, best, held):
    """Where |y|^2 + t^2 + held |y - best|^2 is least, t the highest cut or 0; |y|^2 + t^2 there.

    By its dual, whose variables are one weight for each cut, not negative: of a weight alone the
    best value is known, and they take turns.
    """
    known = jnp.isfinite(height)
    slope, height = jnp.where(known[:, None], slope, 0.0), jnp.where(known, height, -1.0)
    matrix = slope @ slope.T / (1 + held) + 1.0
    wanted = 2 * (height + slope @ best * (held / (1 + held)))
    count = len(height)

    def improved(turn, weight):
        k = turn % count
        left = wanted[k] - matrix[k] @ weight
        better = jnp.maximum(weight[k] + left / matrix[k, k], 0.0)
        return weight.at[k].set(jnp.where(known[k], better, 0.0))

    weight = jax.lax.fori_loop(0, _ROUNDS * count, improved, jnp.zeros_like(height))
    place = (held * best - 0.5 * (weight @ slope)) / (1 + held)
    reach = jnp.max(jnp.where(known, height + slope @ place, 0.0), initial=0.0)
    return place, jnp.sum(place**2) + reach**2
