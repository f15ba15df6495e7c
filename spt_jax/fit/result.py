"""What a fit comes to."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from spt_jax._result import Result, plain
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax.body import BodyModel
from spt_jax.fit.problem import photograph
from spt_jax.fit.problem.objective import Objective

_WORDS = {
    "successful": "converged",
    "nonlinear_max_steps_reached": "stopped at the largest number of steps, still gaining: "
    "Stages(max_steps=) allows more",
}


class FitResult(Result):
    """What `fit_pose` found.

    Attributes:
        pose: axis-angle of every joint, in radians.
        shape: shape coefficients, those given where they were not fitted.
        translation: in metres.
        vertices, joints: the body, in metres, in the world of the camera.
        keypoints: where the body's keypoints are in the image, in pixels.
        steps: of the solvers, over all starts and stages.
        terms: what each term costs at the end: "reprojection", "prior", "limits", "shape",
            "upright" and the regularizer's name, weighted, those that were used; their sum is
            "total". `fit_pose` says what they are.
        status: how it ended, one of `spt_jax.RESULTS` for each person; `reason` says it in words.
    """

    pose: Float[Array, "*batch J 3"]
    shape: Float[Array, "*batch B"]
    translation: Float[Array, "*batch 3"]
    vertices: Float[Array, "*batch V 3"]
    joints: Float[Array, "*batch J 3"]
    keypoints: Float[Array, "*batch K 2"]
    steps: Int[Array, "*batch"]
    terms: dict[str, Float[Array, "*batch"]]
    status: RESULTS

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the last stage ended at a minimum that a photograph could show, free if asked."""
        return self.status == RESULTS.successful

    @property
    def reason(self) -> Any:
        """The status in words: a string, or nested lists of strings over the batch axes."""
        return in_words(self.status, _WORDS)

    def as_dict(self) -> dict[str, Any]:
        """How the fit ended and what its terms cost, as JSON types."""
        return {
            "status": names_of(self.status),
            "reason": self.reason,
            "terms": {name: plain(cost) for name, cost in self.terms.items()},
            "steps": plain(self.steps),
        }


def fit_result(
    body: BodyModel,
    objective: Objective,
    vector: Float[Array, "D"],
    regularized: dict[str, Float[Array, ""]],
    converged: Bool[Array, ""],
    steps: Int[Array, ""],
    free: Bool[Array, ""] | bool = True,
) -> FitResult:
    """The result of one person's fit that ended at a vector.

    Args:
        body: the model.
        objective: whose variables they are.
        vector: where the fit ended.
        regularized: what the regularizer costs, by its name; empty for none.
        converged: whether the last stage ended at a minimum.
        steps: of the solvers.
        free: whether no parts intersect, where the fit was to end so.
    """
    found = objective.unpack(vector)
    posed = body(found.pose, found.shape, found.translation)
    terms = objective.costs(vector)
    del terms["ridge"]
    terms |= regularized
    terms["total"] = sum(terms.values(), jnp.zeros((), vector.dtype))
    finite = jnp.all(jnp.isfinite(posed.vertices)) & jnp.isfinite(terms["total"])
    outside = photograph.outside_photographs(objective, vector, posed.vertices)
    ended: Any = RESULTS.successful, RESULTS.nonlinear_max_steps_reached
    status: Any = RESULTS.where(converged, *ended)
    status = RESULTS.where(free, status, RESULTS.intersections_left)
    for code, one in photograph.STATUSES.items():
        status = RESULTS.where(outside == code, one, status)
    status = RESULTS.where(finite, status, RESULTS.not_finite)
    status = RESULTS.where(jnp.any(objective.confidence > 0), status, RESULTS.unseen)
    return FitResult(
        pose=found.pose,
        shape=found.shape,
        translation=found.translation,
        vertices=posed.vertices,
        joints=posed.joints,
        keypoints=objective.project(vector),
        steps=steps,
        terms=terms,
        status=status,
    )
