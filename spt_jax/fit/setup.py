"""Check the arguments of a fit and build the problem that all people of the batch share."""

from typing import Literal

import equinox as eqx
import jax
import optimistix as optx

from spt_jax._camera import PinholeCamera
from spt_jax.body import BodyModel
from spt_jax.fit.options import Numbers, Search, Stages, Start, Terms, scalar
from spt_jax.fit.problem.figure import Figure, make_figure
from spt_jax.fit.problem.inputs import Keypoints, Person, as_people, as_seen_points, count_points
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.limits import JointLimits, joint_limits
from spt_jax.fit.problem.objective import Objective, Weights, as_seen
from spt_jax.fit.problem.priors import FunctionPosePrior, PosePrior, PriorFunction
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.problem.viewer import Viewer
from spt_jax.fit.regularizers import as_regularizer
from spt_jax.fit.regularizers._base import Regularizer
from spt_jax.fit.search.candidates import Candidates, find_candidates, refine_start
from spt_jax.fit.search.flips import Limb, limbs_of
from spt_jax.fit.solver import default_solver
from spt_jax.keypoints import AnyLayout, keypoint_regressor


class KeypointSearch(eqx.Module):
    """What a fit to the keypoints alone has to know: camera, terms and solver."""

    figure: Figure
    camera: PinholeCamera
    prior: PosePrior | None
    limits: JointLimits | None
    weights: Weights
    solver: optx.AbstractMinimiser
    max_steps: int = eqx.field(static=True)
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
            prior=self.prior and self.prior.around(start.pose),
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
            return refine_start(objective, self.solver, 2 * self.max_steps)
        return find_candidates(
            objective, self.limbs, self.starts, self.solver, self.max_steps, count
        )


class Setup(eqx.Module):
    """What a whole fit has to know: the search, and the stages that come after it.

    Attributes:
        search: the fit to the keypoints alone.
        body: the model.
        regularizer: prepared for the body.
        solver: what the stages minimize with; None for what suits the regularizer.
        max_steps: of each stage.
        free: whether the search goes on until nothing intersects.
    """

    search: KeypointSearch
    body: BodyModel
    regularizer: Regularizer
    solver: optx.AbstractMinimiser | None
    max_steps: int = eqx.field(static=True)
    free: bool = eqx.field(static=True)


def prepare_fit(
    body: BodyModel,
    keypoints: Keypoints,
    camera: PinholeCamera,
    *,
    layout: AnyLayout | None,
    confidence: Numbers | None,
    start: Start,
    terms: Terms,
    regularizer: str | Regularizer,
    search: Search,
    stages: Stages,
    in_scene: int = 1,
) -> tuple[Setup, Person, tuple[int, ...]]:
    """The setup of a call, its people in one leading axis, and the batch axes they came with.

    Args:
        in_scene: how many people the regularizer sees together.

    The others, and the errors, are as `fit_pose` has them.
    """
    _check_body_and_camera(body, camera)
    for name, given, kind in (
        ("start", start, Start),
        ("terms", terms, Terms),
        ("search", search, Search),
        ("stages", stages, Stages),
    ):
        if not isinstance(given, kind):
            raise TypeError(
                f"{name} must be a spt_jax.fit.{kind.__name__}: got {type(given).__name__}."
            )
    points, trust, layout = as_seen_points(keypoints, confidence, layout)
    likely, ranges = _as_prior(body, terms.prior), _as_limits(body, terms.limits)
    for name, rows in (("prior", likely and likely.middle()), ("limits", ranges and ranges.low)):
        if rows is not None and len(rows) != body.num_joints:
            raise ValueError(
                f"{name} must be of the body's {body.num_joints} joints: got one of {len(rows)}; "
                "make it with body.joint_names."
            )
    # Of the body alone, and read on the host: under jit its constants would be tracers there.
    with jax.ensure_compile_time_eval():
        figure = make_figure(body, keypoint_regressor(body, layout, count=count_points(points)))
    alone = KeypointSearch(
        figure=figure,
        camera=camera,
        prior=likely and likely.of_joints(figure.moving),
        limits=ranges and ranges.of_joints(figure.moving),
        weights=Weights(
            prior=scalar(terms.prior_weight),
            limits=scalar(terms.limits_weight),
            shape=scalar(terms.shape_weight),
            upright=scalar(terms.upright_weight),
        ),
        solver=search.solver or default_solver(),
        max_steps=int(search.max_steps),
        limbs=limbs_of(figure.body),
        starts=int(search.starts) if start.pose is None else 0,
        fit_shape=bool(start.fit_shape),
        fit_translation=bool(start.fit_translation),
    )
    setup = Setup(
        search=alone,
        body=body,
        regularizer=as_regularizer(regularizer).prepared(body, in_scene),
        solver=stages.solver,
        max_steps=int(stages.max_steps),
        free=bool(stages.free),
    )
    # A search starts from the middle of what is likely: a T-pose is far from any that people take.
    middle = (likely or pose_prior(body.joint_names)).middle()
    first = (middle if start.pose is None else start.pose, start.shape, start.translation)
    placed = figure.regressor.placed
    people, batch = as_people(
        body, points, trust, first, terms.expected_error, terms.robust, placed=placed
    )
    return setup, people, batch


def _check_body_and_camera(body: BodyModel, camera: PinholeCamera) -> None:
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


def _as_prior(
    body: BodyModel, prior: Literal["mocap"] | PosePrior | PriorFunction | None
) -> PosePrior | None:
    if prior is None or isinstance(prior, PosePrior):
        return prior
    usual = pose_prior(body.joint_names)
    return usual if isinstance(prior, str) else FunctionPosePrior(prior, usual.mean)


def _as_limits(
    body: BodyModel, limits: Literal["anatomical"] | JointLimits | None
) -> JointLimits | None:
    return joint_limits(body.joint_names) if isinstance(limits, str) else limits
