"""Places of a search, measured: the fit's terms by compiled programs, the overlap on the host.

The programs call nothing on the host. JAX keeps such programs from process to process, and none
holds the other up.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from spt_jax.body import BodyModel
from spt_jax.bridge.programs import program
from spt_jax.fit.contact.cuts import Squares
from spt_jax.fit.problem.objective import Objective
from spt_jax.fit.regularizers.spt import SelfIntersection
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.host_functions import PenaltyOptions, measured
from spt_jax.overlap.measure import Measurement, Sampling, Unmeasurable, measure

_CUBIC_CENTIMETER = 1e-6


class Place(NamedTuple):
    """Variables of N people, and what they come to.

    Attributes:
        vector: the variables.
        cost: the people's terms without the overlap.
        squares: the same terms about the place.
        vertices: of all people, in metres.
        energy: the overlap, in cm^3, of the surface moved outwards by half the margin.
        gradient: of the overlap by the variables.
    """

    vector: Float[np.ndarray, "N D"]
    cost: float
    squares: Squares
    vertices: Float[np.ndarray, "V 3"]
    energy: float
    gradient: Float[np.ndarray, "N D"]

    def total(self, weight: float) -> float:
        """The cost with the overlap."""
        return self.cost + weight * self.energy


class Ground:
    """Where a search for N people goes on.

    Args:
        body: the model.
        people: the objectives of those in one scene.
        term: the penalty, prepared for the body and N people.
    """

    def __init__(self, body: BodyModel, people: list[Objective], term: SelfIntersection):
        count = len(people)
        self.body, self.people, self.term = body, people, term
        self.dtype = people[0].keypoints.dtype
        faces = np.asarray(body.faces, np.int64)
        self.faces = np.concatenate([faces + k * body.num_vertices for k in range(count)])
        self._options = PenaltyOptions(
            value=term.value,
            gradient=term.gradient,
            rule=term.rule,
            sampling=Sampling(term.rays, term.directions),
            exclusions=Exclusions(rest=term.rest_surface),
            rounding=float(jnp.finfo(self.dtype).eps),
        )
        self.looks = 0

    def look(self, vector: Float[np.ndarray, "N D"], margin: float) -> Place | None:
        """A place; None where it cannot be measured.

        Args:
            vector: the variables.
            margin: how far apart parts are pushed, in metres.
        """
        self.looks += 1
        rows = [jnp.asarray(row, self.dtype) for row in vector]
        seen = [_seen(self.body, *one) for one in zip(self.people, rows, strict=True)]
        vertices, residuals, jacobians = (
            np.stack([np.asarray(one[k], np.float64) for one in seen]) for k in range(3)
        )
        cost = float(np.sum(residuals**2))
        if not (np.isfinite(cost) and np.isfinite(jacobians).all()):
            return None
        vertices = vertices.reshape(-1, 3)
        options = self._options._replace(outwards=margin / 2)
        energy, forces, _ = measured(vertices, self.faces, options, with_gradient=True)
        if not np.isfinite(energy):
            return None
        squares = Squares(
            np.einsum("nri,nrj->nij", jacobians, jacobians),
            np.einsum("nri,nr->ni", jacobians, residuals),
        )
        gradient = self._pulled(rows, forces) if energy > 0 else np.zeros_like(vector)
        scale = 1 / _CUBIC_CENTIMETER
        found = Place(vector, cost, squares, vertices, scale * float(energy), scale * gradient)
        return found if np.isfinite(found.gradient).all() else None

    def _pulled(self, rows: list[Array], forces: Float[np.ndarray, "V 3"]):
        each = forces.reshape(len(rows), -1, 3)
        found = [
            _pulled_back(self.body, person, row, jnp.asarray(force, self.dtype))
            for person, row, force in zip(self.people, rows, each, strict=True)
        ]
        return np.stack([np.asarray(one, np.float64) for one in found])

    def vertices(self, vector: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "V 3"]:
        """The surface of all people, in metres."""
        rows = [jnp.asarray(row, self.dtype) for row in vector]
        seen = [_seen(self.body, *one)[0] for one in zip(self.people, rows, strict=True)]
        return np.concatenate([np.asarray(one, np.float64) for one in seen])

    def measure(self, vertices: Float[np.ndarray, "V 3"]) -> Measurement | None:
        """The overlap of the surface as it is; None where it cannot be measured."""
        options = self._options
        try:
            return measure(
                vertices, self.faces, options.sampling, options.exclusions, options.rounding
            )
        except Unmeasurable:
            return None


@program
def _seen(
    body: BodyModel, objective: Objective, vector: Float[Array, "D"]
) -> tuple[Float[Array, "V 3"], Float[Array, "R"], Float[Array, "R D"]]:
    """Vertices, residuals and their derivatives."""

    def residuals(x):
        return jnp.concatenate([part.reshape(-1) for part in objective.residuals(x).values()])

    return (
        _vertices(body, objective, vector),
        residuals(vector),
        jax.jacfwd(residuals)(vector),
    )


@program
def _pulled_back(
    body: BodyModel,
    objective: Objective,
    vector: Float[Array, "D"],
    forces: Float[Array, "V 3"],
) -> Float[Array, "D"]:
    """Forces on vertices as forces on the variables."""
    (back,) = jax.vjp(lambda x: _vertices(body, objective, x), vector)[1](forces)
    return back


def _vertices(body: BodyModel, objective: Objective, vector):
    found = objective.unpack(vector)
    return body(found.pose, found.shape, found.translation).vertices
