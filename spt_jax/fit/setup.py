"""Check the arguments of a fit and build the problem that all people of the batch share."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array

from spt_jax._camera import PinholeCamera
from spt_jax.body import BodyModel
from spt_jax.fit.figure import Figure, Variables, make_figure
from spt_jax.fit.inputs import Person, as_people, count_points
from spt_jax.fit.objective import Objective, Weights, as_seen
from spt_jax.fit.search.candidates import Candidates, find_candidates, refine_start
from spt_jax.fit.search.flips import Limb, limbs_of
from spt_jax.fit.solver import default_solver
from spt_jax.fit.terms.priors import GaussianPosePrior, JointLimits, joint_limits, pose_prior
from spt_jax.fit.terms.regularisers import Regulariser, as_regulariser
from spt_jax.fit.viewer import Viewer
from spt_jax.keypoints import keypoint_regressor

# Of the fit to the keypoints alone, for each start. With 60 all starts of eight frames were cut
# off, and two of the frames ended in worse minima than those next to the truth.
_KEYPOINT_STEPS = 120


class Search(eqx.Module):
    """What a fit to the keypoints alone has to know: camera, terms and solver."""

    figure: Figure
    camera: PinholeCamera
    prior: GaussianPosePrior | None
    limits: JointLimits | None
    weights: Weights
    keypoint_solver: optx.AbstractMinimiser
    limbs: tuple[Limb, ...] = eqx.field(static=True)
    starts: int = eqx.field(static=True)
    fit_shape: bool = eqx.field(static=True)
    fit_translation: bool = eqx.field(static=True)

    def objective(self, person: Person) -> Objective:
        """The squares of one person's fit."""
        dtype, viewer, start = person.keypoints.dtype, Viewer.of(self.camera), person.start
        if self.starts:
            # Upright is no rotation in the viewer's axes.
            pose = start.pose[self.figure.rows].at[0].set(0.0)
            seen = Variables(pose, start.shape, viewer.place_of(self.figure.body, start))
            start = start._replace(pose=start.pose.at[0].set(viewer.upright.astype(dtype)))
        else:
            seen = as_seen(self.figure, viewer, start)
        return Objective(
            figure=self.figure,
            viewer=viewer,
            keypoints=person.keypoints,
            confidence=person.confidence,
            pixels=person.pixels,
            robust=person.robust,
            prior=self.prior,
            limits=self.limits,
            weights=Weights(*(weight.astype(dtype) for weight in self.weights)),
            start=start,
            seen=seen,
            fit_shape=self.fit_shape,
            fit_translation=self.fit_translation,
        )

    def candidates(self, objective: Objective, count: int) -> Candidates:
        """Fits to the keypoints alone, the best first; one where a start was given."""
        if not self.starts:
            return refine_start(objective, self.keypoint_solver, 2 * _KEYPOINT_STEPS)
        return find_candidates(
            objective, self.limbs, self.starts, self.keypoint_solver, _KEYPOINT_STEPS, count
        )


class Setup(eqx.Module):
    """What a whole fit has to know: the search, and the stages that come after it."""

    search: Search
    body: BodyModel
    regulariser: Regulariser
    solver: optx.AbstractMinimiser
    max_steps: int = eqx.field(static=True)


def prepare_fit(
    body: BodyModel,
    keypoints: Any,
    camera: PinholeCamera,
    *,
    layout: Any,
    confidence: Any,
    regulariser: Any,
    pose: Any,
    shape: Any,
    translation: Any,
    fit_shape: bool,
    fit_translation: bool,
    prior: Any,
    limits: Any,
    prior_weight: float,
    limits_weight: float,
    shape_weight: float,
    upright_weight: float,
    expected_error: Any,
    robust: Any,
    starts: int,
    solver: Any,
    keypoint_solver: Any,
    max_steps: int,
    in_scene: int = 1,
) -> tuple[Setup, Person, tuple[int, ...]]:
    """The setup of a call, its people in one leading axis, and the batch axes they came with.

    Args:
        in_scene: how many people the regulariser sees together.

    The others, and the errors, are as `fit_pose` has them.
    """
    if not isinstance(body, BodyModel):
        raise TypeError(f"body must be a BodyModel: got {type(body).__name__}; see load_body.")
    if not isinstance(camera, PinholeCamera):
        raise TypeError(
            f"camera must be a PinholeCamera: got {type(camera).__name__}; "
            "PinholeCamera.from_matrix takes a 3 x 4 matrix."
        )
    if camera.focal.ndim != 1:
        raise ValueError(
            f"camera must be one: got a batch of {camera.focal.shape[:-1]}; for a camera each use "
            "jax.vmap(lambda points, camera: fit_pose(body, points, camera, ...))."
        )
    for name, number, least in (("starts", starts, 1), ("max_steps", max_steps, 1)):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < least:
            raise ValueError(f"{name} must be a whole number of at least {least}: got {number!r}.")
    weights = {
        "prior_weight": prior_weight,
        "limits_weight": limits_weight,
        "shape_weight": shape_weight,
        "upright_weight": upright_weight,
    }
    weights = {name: _as_weight(name, weight) for name, weight in weights.items()}
    for name, flag in (("fit_shape", fit_shape), ("fit_translation", fit_translation)):
        if not isinstance(flag, (bool, np.bool_)):
            raise TypeError(f"{name} must be True or False: got {flag!r}.")
    likely, ranges = _as_prior(body, prior), _as_limits(body, limits)
    for name, rows in (("prior", likely and likely.mean), ("limits", ranges and ranges.low)):
        if rows is not None and len(rows) != body.num_joints:
            raise ValueError(
                f"{name} must be of the body's {body.num_joints} joints: got one of {len(rows)}; "
                "make it with body.joint_names."
            )
    for name, given in (("solver", solver), ("keypoint_solver", keypoint_solver)):
        if given is not None and not isinstance(given, optx.AbstractMinimiser):
            raise TypeError(
                f"{name} must be an optimistix minimiser, such as optimistix.BFGS(1e-3, 1e-3): got "
                f"{type(given).__name__}."
            )
    # Of the body alone, and read on the host: under jit its constants would be tracers there.
    with jax.ensure_compile_time_eval():
        figure = make_figure(body, keypoint_regressor(body, layout, count=count_points(keypoints)))
    search = Search(
        figure=figure,
        camera=camera,
        prior=likely and likely.of_joints(figure.moving),
        limits=ranges and ranges.of_joints(figure.moving),
        weights=Weights(**{name.removesuffix("_weight"): w for name, w in weights.items()}),
        keypoint_solver=keypoint_solver or default_solver(),
        limbs=limbs_of(figure.body),
        starts=int(starts) if pose is None else 0,
        fit_shape=bool(fit_shape),
        fit_translation=bool(fit_translation),
    )
    setup = Setup(
        search=search,
        body=body,
        regulariser=as_regulariser(regulariser).prepared(body, in_scene),
        solver=solver or default_solver(),
        max_steps=int(max_steps),
    )
    # A search starts from the middle of what is likely: a T-pose is far from any that people take.
    middle = (likely or pose_prior(body.joint_names)).mean
    start = (middle if pose is None else pose, shape, translation)
    people, batch = as_people(body, keypoints, confidence, start, expected_error, robust)
    return setup, people, batch


def _as_weight(name: str, weight: Any) -> Array:
    # A JAX scalar may change without compiling anew, and may be traced.
    number = isinstance(weight, (int, float, np.integer, np.floating))
    known = number or (isinstance(weight, Array) and not isinstance(weight, Tracer))
    if not isinstance(weight, Tracer) and not (
        known and np.ndim(weight) == 0 and 0 <= float(weight) < np.inf
    ):
        raise ValueError(f"{name} must be a finite number, not negative: got {weight!r}.")
    return jnp.asarray(weight, jnp.zeros(()).dtype)


def _as_prior(body: BodyModel, prior: Any) -> GaussianPosePrior | None:
    if isinstance(prior, str) and prior == "mocap":
        return pose_prior(body.joint_names)
    if prior is None or isinstance(prior, GaussianPosePrior):
        return prior
    raise ValueError(f'prior must be "mocap", a GaussianPosePrior or None: got {prior!r}.')


def _as_limits(body: BodyModel, limits: Any) -> JointLimits | None:
    if isinstance(limits, str) and limits == "anatomical":
        return joint_limits(body.joint_names)
    if limits is None or isinstance(limits, JointLimits):
        return limits
    raise ValueError(f'limits must be "anatomical", JointLimits or None: got {limits!r}.')
