"""What a fit comes to."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax.body import BodyModel
from spt_jax.fit import photograph
from spt_jax.fit.objective import Objective

_REASONS = (
    "converged",
    "stopped at the largest number of steps",
    "not finite: keypoints or camera are unusable",
    "no keypoint was seen: this is where the fit started",
    *(photograph.REASONS[code] for code in sorted(photograph.REASONS)),
)


class FitResult(eqx.Module):
    """What `fit_pose` found.

    Attributes:
        pose: axis-angle of every joint, in radians.
        shape: shape coefficients, those given where they were not fitted.
        translation: in metres.
        vertices, joints: the body, in metres, in the world of the camera.
        keypoints: where the body's keypoints are in the image, in pixels.
        steps: of the solvers, over all starts and stages.
        terms: what each term costs at the end: "reprojection", "prior", "limits", "shape",
            "upright" and the regulariser's name, weighted, those that were used; their sum is
            "total". `fit_pose` says what they are.
        status: 0 converged; 1 stopped at the largest number of steps; 2 not finite; 3 no keypoint
            was seen; 4, 5 and 6: distance, size or focal length lie outside any photograph, so that
            camera or keypoints are in other units than pixels. `reason` says it in words.
    """

    pose: Float[Array, "*batch J 3"]
    shape: Float[Array, "*batch B"]
    translation: Float[Array, "*batch 3"]
    vertices: Float[Array, "*batch V 3"]
    joints: Float[Array, "*batch J 3"]
    keypoints: Float[Array, "*batch K 2"]
    steps: Int[Array, "*batch"]
    terms: dict[str, Float[Array, "*batch"]]
    status: Int[Array, "*batch"]

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the last stage ended at a minimum that a photograph could show."""
        return self.status == 0

    @property
    def reason(self) -> Any:
        """The status in words: a string, or nested lists of strings over the batch axes."""
        words = np.array(_REASONS, dtype=object)[np.asarray(self.status)]
        return words if isinstance(words, str) else words.tolist()


def fit_result(
    body: BodyModel,
    objective: Objective,
    vector: Float[Array, "D"],
    regularised: dict[str, Float[Array, ""]],
    converged: Bool[Array, ""],
    steps: Int[Array, ""],
) -> FitResult:
    """The result of one person's fit that ended at a vector.

    Args:
        body: the model.
        objective: whose variables they are.
        vector: where the fit ended.
        regularised: what the regulariser costs, by its name; empty for none.
        converged: whether the last stage ended at a minimum.
        steps: of the solvers.
    """
    found = objective.unpack(vector)
    posed = body(found.pose, found.shape, found.translation)
    terms = objective.costs(vector)
    del terms["ridge"]
    terms |= regularised
    terms["total"] = sum(terms.values(), jnp.zeros((), vector.dtype))
    finite = jnp.all(jnp.isfinite(posed.vertices)) & jnp.isfinite(terms["total"])
    outside = photograph.outside_photographs(objective, vector, posed.vertices)
    status = jnp.where(outside == 0, jnp.where(converged, 0, 1), outside)
    status = jnp.where(finite, status, 2)
    status = jnp.where(jnp.any(objective.confidence > 0), status, 3)
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
