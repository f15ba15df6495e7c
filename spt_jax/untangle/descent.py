"""A search for a pose without collisions: what is minimised, at once or step by step."""

from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from spt_jax._penalty import self_intersection_penalty
from spt_jax._status import RESULTS
from spt_jax._steps import OnStep, Step
from spt_jax.body import AbstractBody, BodyGroup
from spt_jax.bridge.programs import program
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.measure import Measurement, Sampling, Unmeasurable, measure
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface
from spt_jax.untangle.contact_solver import ContactSolver
from spt_jax.untangle.contacts import Held, contact_cost

Folds = Literal["ignore", "remove", "count"]

# Added to the mean squared vertex displacement per squared radian of every joint axis, in m^2.
# Without it the fingers, which move few vertices, may turn through any angle for next to nothing.
# Over six poses 1e-3 gave smaller displacements than 1e-4 at the same overlap (57 against 77 mm).
STIFFNESS = 1e-3

CENTIMETRE = 0.01

# What is tried where the weights left collisions: the margin, times this, with the last weights
# again from where the last attempt ended.
_WIDER = (2.0, 4.0)
_AGAIN = 3

# One object, so that a search is compiled once.
SOLVER = ContactSolver(rtol=0.03, atol=1e-6)


class Search(eqx.Module):
    """What stays the same for all poses; static, so that the solver is compiled once."""

    rays: Rays = eqx.field(static=True)
    directions: tuple = eqx.field(static=True)
    folds: Folds = eqx.field(static=True)
    margin: float = eqx.field(static=True)
    weights: tuple[float, ...] = eqx.field(static=True)
    steps_per_weight: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    rest: RestSurface | None = eqx.field(static=True)
    solver: optx.AbstractMinimiser
    contacts: Held | None = None

    @property
    def measured_rays(self) -> Rays:
        """What is compared and reported is measured with."""
        return 2 * self.rays if isinstance(self.rays, int) else None

    def measure(
        self, vertices: Float[Array | np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
    ) -> Measurement:
        """The overlap of a posed body, of which no more is worked out than is asked for.

        Raises:
            Unmeasurable: there is none that could be measured.
        """
        return measure(
            np.asarray(vertices, np.float64),
            faces,
            Sampling(self.measured_rays, self.directions),
            Exclusions(rest=self.rest),
            float(jnp.finfo(vertices.dtype).eps),
        )

    def rank(self, found: Measurement) -> tuple[int, float]:
        """Sorts overlaps, the best first."""
        return (0 if self.folds == "count" else found.intersecting_pairs), found.volume

    def is_free(self, found: Measurement) -> bool:
        """Whether there is nothing left to do."""
        pairs, volume = self.rank(found)
        return pairs == 0 and volume <= self.tolerance

    def attempts(self) -> list[tuple[float, float]]:
        """Margin and weight of every descent."""
        if self.folds == "count":
            return [(0.0, weight) for weight in self.weights]
        wider = _WIDER if self.margin else ()
        again = [(self.margin * more, w) for more in wider for w in self.weights[-_AGAIN:]]
        return [(self.margin, weight) for weight in self.weights] + again


# As the body is posed elsewhere: the last bit of what need not move hangs on how it is compiled.
@eqx.filter_jit
def vertices_of(body, pose, shape, translation) -> Float[Array, "V 3"]:
    """The vertices of a posed body."""
    return body(pose, shape, translation).vertices


def faces_of(body: AbstractBody) -> Int[np.ndarray, "F 3"]:
    """A body's faces as the host takes them."""
    return np.asarray(body.faces, np.int64)


@program
def displacement_factor(body, pose, shape):
    """Cholesky factor of the quadratic form: free rows -> mean squared displacement."""
    if isinstance(body, BodyGroup) and body.count > 1:
        # What moves one person moves no other: a block for each.
        forms = [_displacement_form(*one) / body.count for one in body.alone(pose, shape)]
        form = jax.scipy.linalg.block_diag(*forms)
    else:
        form = _displacement_form(body, pose, shape)
    return jnp.linalg.cholesky(form + STIFFNESS * jnp.eye(len(form), dtype=form.dtype))


def _displacement_form(body, pose, shape):
    free = body.free_rows
    given = pose[free]
    jacobian = jax.jacfwd(lambda rows: body(pose.at[free].set(rows), shape).vertices)(given)
    jacobian = jacobian.reshape(-1, given.size)
    return jacobian.T @ jacobian / body.num_vertices


def turned(body, pose, factor, moved):
    """The pose whose linearised displacement, in centimetres, has the squared norm of `moved`."""
    turn = jax.scipy.linalg.solve_triangular(factor, moved, trans=1, lower=True)
    free = body.free_rows
    return pose.at[free].add(CENTIMETRE * turn.reshape(pose[free].shape))


# What is looked at between descents.
pose_of = program(turned)


def _objective(search: Search, moved, arguments):
    body, (pose, shape, translation, factor), margin, weight = arguments
    vertices = body(turned(body, pose, factor, moved), shape, translation).vertices
    volume = self_intersection_penalty(
        vertices,
        body.faces,
        rays=search.rays,
        directions=np.array(search.directions),
        margin=margin,
        rest_surface=search.rest,
    )
    cost = jnp.sum(moved**2) + weight * volume / CENTIMETRE**3
    if search.contacts is None:
        return cost
    return cost + contact_cost(vertices, search.contacts, margin)


@program
def descend(search: Search, body, fixed, moved, margin, weight):
    """One run of the solver, compiled as a whole.

    Args:
        search: what stays the same.
        body: the body.
        fixed: pose, shape and translation given, and the factor of the displacement.
        moved: where the search starts, as `turned` takes it.
        margin, weight: those of this run.

    Returns:
        Where it ended, how many steps it took, and how it ended.
    """
    solution = optx.minimise(
        partial(_objective, search),
        search.solver,
        moved,
        (body, fixed, margin, weight),
        max_steps=search.steps_per_weight,
        throw=False,
    )
    return solution.value, solution.stats["num_steps"], RESULTS.promote(solution.result)


def descend_in_steps(
    search: Search, body, fixed, moved, margin, weight, stage: int, steps: int, on_step: OnStep
):
    """`descend` with the solver's loop in Python, so that each step can be looked at.

    The loop is that of https://docs.kidger.site/optimistix/examples/interactive-solves/.
    """
    arguments = (body, fixed, margin, weight)
    state = _first_state(search, arguments, moved)
    done, result = _terminated(search, arguments, moved, state)
    taken = 0
    while not done and taken < search.steps_per_weight:
        moved, state, done, result, pose, vertices = _one_step(search, arguments, moved, state)
        taken += 1
        vertices, faces = np.asarray(vertices), faces_of(body)
        on_step(
            Step(
                stage,
                steps + taken,
                vertices,
                np.asarray(pose),
                partial(_volume_and_pairs, search, vertices, faces),
            )
        )
    if not done:
        result = RESULTS.nonlinear_max_steps_reached
    return moved, taken, RESULTS.promote(result) if done else result


def _volume_and_pairs(search: Search, vertices, faces) -> tuple[float, int]:
    try:
        overlap = search.measure(vertices, faces)
    except Unmeasurable:
        return float("nan"), -1
    return overlap.volume, overlap.intersecting_pairs


def _with_aux(search: Search, moved, arguments):
    return _objective(search, moved, arguments), None


def _solving(search: Search, arguments) -> dict[str, Any]:
    return {
        "fn": partial(_with_aux, search),
        "args": arguments,
        "options": {},
        "tags": frozenset(),
    }


@eqx.filter_jit
def _first_state(search: Search, arguments, moved):
    shape = jax.ShapeDtypeStruct((), moved.dtype)
    return search.solver.init(
        y=moved, f_struct=shape, aux_struct=None, **_solving(search, arguments)
    )


@eqx.filter_jit
def _terminated(search: Search, arguments, moved, state):
    return search.solver.terminate(y=moved, state=state, **_solving(search, arguments))


@eqx.filter_jit
def _one_step(search: Search, arguments, moved, state):
    solving = _solving(search, arguments)
    moved, state, _ = search.solver.step(y=moved, state=state, **solving)
    done, result = search.solver.terminate(y=moved, state=state, **solving)
    body, (pose, shape, translation, factor), _, _ = arguments
    at = turned(body, pose, factor, moved)
    return moved, state, done, result, at, body(at, shape, translation).vertices


def is_near(candidate: Any, pose: Any) -> bool:
    """Whether no joint turns by more than a full turn, as one of a search that ran away does."""
    turn = np.linalg.norm(np.asarray(candidate) - np.asarray(pose), axis=-1)
    return float(turn.max()) <= 2 * np.pi
