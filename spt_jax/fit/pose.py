"""A body's pose from keypoints in one image."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax.body import BodyModel
from spt_jax.fit.inputs import Person
from spt_jax.fit.programs import program
from spt_jax.fit.result import FitResult, fit_result
from spt_jax.fit.search.candidates import Candidates
from spt_jax.fit.setup import Search, Setup, prepare_fit
from spt_jax.fit.stages import descend, unpacked
from spt_jax.fit.terms.priors import GaussianPosePrior, JointLimits
from spt_jax.fit.terms.regularisers import Regulariser

# Candidates whose energy is looked at before two of them go through the regularised stages.
_LOOKED_AT = 4


def fit_pose(
    body: BodyModel,
    keypoints: Any,
    camera: PinholeCamera,
    *,
    layout: Any,
    confidence: Any = None,
    regulariser: Literal["spt", "none", "laplacian", "spheres"] | Regulariser = "spt",
    pose: Any = None,
    shape: Any = None,
    translation: Any = None,
    fit_shape: bool = False,
    fit_translation: bool = True,
    prior: Literal["mocap"] | GaussianPosePrior | None = "mocap",
    limits: Literal["anatomical"] | JointLimits | None = "anatomical",
    prior_weight: float = 1.0,
    limits_weight: float = 1.0,
    shape_weight: float = 1.0,
    upright_weight: float = 0.25,
    expected_error: Any = None,
    robust: Any = None,
    starts: int = 6,
    solver: optx.AbstractMinimiser | None = None,
    keypoint_solver: optx.AbstractMinimiser | None = None,
    max_steps: int = 20,
) -> FitResult:
    """Find the pose of a body that matches keypoints in an image and does not intersect itself.

    It minimises (section 4.3 of the paper, with what is needed to make the pose a person's)

        sum over keypoints k of c_k rho(distance in the image / expected error)
        + prior weight * squared Mahalanobis distance of the pose from the prior
        + limits weight * sum of (angle beyond a joint's range / 0.1 rad)^2
        + shape weight * |shape|^2 + upright weight * |body's up - image's up|^2
        + the regulariser's last weight * its energy

    first without the regulariser, from `starts` orientations and then through the depth flips of
    each limb (a bone that leans towards the camera and its mirror image that leans away look the
    same); then with it, its weight rising from stage to stage, from the two best of these, one
    of them chosen with the regulariser in view. What ends with the lowest total is returned.
    All of it is compiled. The people of a batch are solved one after another, so that
    each ends when it is done; under `vmap` they are solved side by side. Other numbers of any kind
    do not compile anew; other counts, options and layouts do.

    Args:
        body: any `BodyModel`.
        keypoints: pixels, x to the right and y down, (..., K, 2); or a list of people, each
            (K, 2). People are fitted side by side and do not see each other: `fit_people` is for
            those. A point whose confidence is 0 may be anything, NaN too.
        camera: a `PinholeCamera`; with one that has no rotation the body comes back in the
            camera's axes.
        layout: what the K keypoints are: "coco17", "body25", "h36m17", "smpl", or whatever
            `keypoint_regressor` takes.
        confidence: (..., K), 0 for a point that was not seen; all 1 if None.
        regulariser: "spt", the self-intersection penalty; "none"; "spheres" and "laplacian", the
            rivals of the paper's section 4.4; or a `Regulariser` with weights of its own.
        pose: where to start, (..., J, 3); then no other orientations and flips are tried. Give the
            translation, too: it starts at zero otherwise.
        shape: coefficients, (..., B); held fixed, or with `fit_shape` where to start.
        translation: in metres, (..., 3); held fixed without `fit_translation`, else found from the
            keypoints, or where to start if `pose` is given too.
        fit_shape: whether to fit the shape.
        fit_translation: whether to fit the translation.
        prior: "mocap", a Gaussian of the embedded motion capture; one of your own (`pose_prior`);
            or None.
        limits: "anatomical", the ranges in `spt_jax.fit.terms.priors`; `joint_limits` of your own;
            or None.
        prior_weight, limits_weight, shape_weight, upright_weight: what each term counts for.
        expected_error: of a keypoint, in pixels, one number or one for each person, (...); by None
            a hundredth of the larger side of the box around a person's keypoints.
        robust: Geman-McClure's scale in pixels (rho(x) = x^2 / (1 + (x / scale)^2)), one number or
            one for each person, (...): keypoints much farther off are taken for mistakes. By None
            rho(x) = x^2.
        starts: how many orientations to try.
        solver: of the regularised stages, any optimistix minimiser; BFGS by default.
        keypoint_solver: minimises the keypoints' objective in the search; any optimistix minimiser.
        max_steps: of each regularised stage.

    Returns:
        FitResult with the batch axes of `keypoints`. It is never NaN for usable input: where a
        stage fails, what was there before it stays.

    Raises:
        TypeError, ValueError: arguments of the wrong kind or shape, named in the message; where
            values are known: keypoints that are seen and not finite, confidence negative or not
            finite, nobody's keypoints seen, parameters that are not finite.

    Differentiation: none is meant; it runs under jit and vmap.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import PinholeCamera, fit_pose, load_body
        >>> body = load_body()
        >>> camera = PinholeCamera(1000.0, (500.0, 500.0), translation=(0.0, 0.0, 4.0))
        >>> turned = jnp.zeros((52, 3)).at[0, 0].set(jnp.pi)  # upright: the image's y points down
        >>> seen = camera.project(body(turned).joints[:22])
        >>> fit = fit_pose(body, seen, camera, layout=body.joint_names[:22], regulariser="none")
        >>> bool(jnp.abs(fit.keypoints - seen).max() < 10)  # pixels, of a person of 460
        True
    """
    setup, people, batch = prepare_fit(
        body,
        keypoints,
        camera,
        layout=layout,
        confidence=confidence,
        regulariser=regulariser,
        pose=pose,
        shape=shape,
        translation=translation,
        fit_shape=fit_shape,
        fit_translation=fit_translation,
        prior=prior,
        limits=limits,
        prior_weight=prior_weight,
        limits_weight=limits_weight,
        shape_weight=shape_weight,
        upright_weight=upright_weight,
        expected_error=expected_error,
        robust=robust,
        starts=starts,
        solver=solver,
        keypoint_solver=keypoint_solver,
        max_steps=max_steps,
    )
    found = _fit_each(setup, people)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), found)


def _fit_each(setup: Setup, people: Person) -> FitResult:
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((setup, people))):
        return jax.vmap(lambda person: _fit_one(setup, person))(people)
    # Under vmap every lane waits for the slowest, through each of the search's loops: eight people
    # took 1.3 times as long as one by one. Nor in threads: two of these programs at a time make
    # XLA's CPU client wait for itself for ever (jax 0.10.2, two cores).
    count = len(people.keypoints)
    rows = [jax.tree.map(lambda leaf, k=k: leaf[k], people) for k in range(count)]
    found = [_fit_one(setup, row) for row in rows]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


def _fit_one(setup: Setup, person: Person) -> FitResult:
    # Two programs: fits with different regularisers share the first, which takes longer to compile.
    return _regularise(setup, person, _searched(setup.search, person))


@program
def _searched(search: Search, person: Person) -> Candidates:
    return search.candidates(search.objective(person).forgiving(), _LOOKED_AT)


@program
def _regularise(setup: Setup, person: Person, candidates: Candidates) -> FitResult:
    objective, regulariser = setup.search.objective(person), setup.regulariser
    alone = jax.tree.map(lambda leaf: leaf[None], objective)
    weights = regulariser.weights.astype(candidates.vectors.dtype)

    def energy(vector):
        now = unpacked(alone, vector[None])
        start = jax.tree.map(lambda leaf: leaf[None], objective.start)
        return regulariser.energy(setup.body, start, now)

    looked = candidates.vectors
    # What was searched with a more forgiving loss costs something else with its own.
    costs = candidates.costs if objective.robust is None else jax.vmap(objective.cost)(looked)
    energies = jax.vmap(energy)(looked)
    # The best by the keypoints, and the best with the regulariser: what a graze costs to end is
    # only known when both have gone through the stages.
    judged = costs + weights[-1] * energies
    tracks = jnp.stack([looked[_least(costs)], looked[_least(judged)]])

    def through_stages(vector):
        return descend(regulariser, setup.body, alone, vector[None], setup.solver, setup.max_steps)

    ends = jax.vmap(through_stages)(tracks)
    best = _least(ends.cost + weights[-1] * ends.energy)
    end = jax.tree.map(lambda leaf: leaf[best], ends)
    name = regulariser.name
    cost = {} if name == "none" else {name: weights[-1] * end.energy}
    steps = candidates.steps + jnp.sum(ends.steps)
    return fit_result(setup.body, objective, end.vectors[0], cost, end.converged, steps)


def _least(costs: Float[Array, "N"]) -> Int[Array, ""]:
    return jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
