"""A body's pose from keypoints in one image."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax._report import intersection_report
from spt_jax._steps import OnStep, Step
from spt_jax.body import BodyModel
from spt_jax.bridge.programs import program
from spt_jax.fit.contact.places import Ground
from spt_jax.fit.contact.stages import Stages as PenaltyStages
from spt_jax.fit.contact.stages import settled
from spt_jax.fit.options import Numbers, Search, Stages, Start, Terms
from spt_jax.fit.problem.inputs import Keypoints, Person
from spt_jax.fit.problem.objective import Objective
from spt_jax.fit.regularizers._base import Regularizer
from spt_jax.fit.regularizers.spt import SelfIntersection
from spt_jax.fit.result import FitResult, fit_result
from spt_jax.fit.search.candidates import Candidates
from spt_jax.fit.setup import KeypointSearch, Setup, prepare_fit
from spt_jax.fit.solver import default_solver
from spt_jax.fit.stages import Descent, descend, unpacked
from spt_jax.keypoints import AnyLayout
from spt_jax.overlap.measure import Unmeasurable

# Candidates whose energy is looked at before two of them go through the regularized stages.
_LOOKED_AT = 4


def fit_pose(
    body: BodyModel,
    keypoints: Keypoints,
    camera: PinholeCamera,
    *,
    layout: AnyLayout | None = None,
    confidence: Numbers | None = None,
    start: Start = Start(),
    terms: Terms = Terms(),
    regularizer: str | Regularizer = "spt",
    search: Search = Search(),
    stages: Stages = Stages(),
    on_step: OnStep | None = None,
) -> FitResult:
    """Find the pose of a body that matches keypoints in an image and does not intersect itself.

    It minimises (section 4.3 of the paper, with what is needed to make the pose a person's)

        sum over keypoints k of c_k rho(distance in the image / expected error)
        + prior weight * squared Mahalanobis distance of the pose from the prior
        + limits weight * sum of (angle beyond a joint's range / 0.1 rad)^2
        + shape weight * |shape|^2 + upright weight * |body's up - image's up|^2
        + the regularizer's last weight * its energy

    first without the regularizer, from `search.starts` orientations and then through the depth
    flips of each limb (a bone that leans towards the camera and its mirror image that leans away
    look the same); then with it, its weight rising from stage to stage, from the two best of these,
    one of them chosen with the regularizer in view. What ends with the lowest total is returned.
    With the self-intersection penalty the search then goes on, by more weight and with the surface
    moved outwards, until no parts intersect (`Stages.free`); `status` says so where it does not.
    The terms are compiled; the penalty's own stages run on the host. The people of a batch are
    solved one after another, so that each ends when it is done; under `vmap` they are solved side
    by side. Other numbers of any kind do not compile anew; other counts, options and layouts do.

    Args:
        body: any `BodyModel`.
        keypoints: pixels, x to the right and y down, (..., K, 2); or a list of people, each
            (K, 2); or people of `read_keypoints`, one or a list, who know their layout and
            confidences. People are fitted side by side and do not see each other: `fit_people` is
            for those. A point whose confidence is 0 may be anything, NaN too.
        camera: a `PinholeCamera`; with one that has no rotation the body comes back in the
            camera's axes.
        layout: what the K keypoints are: "coco17", "body25", "h36m17", "smpl", or whatever
            `keypoint_regressor` takes; left out for people of `read_keypoints`.
        confidence: (..., K), 0 for a point that was not seen; all 1 if None.
        start: where the fit starts, what is held fixed and whether the shape is fitted.
        terms: prior, limits, their weights, and how far off keypoints are expected to be.
        regularizer: "spt", the self-intersection penalty; "none"; "spheres" and "laplacian", the
            rivals of the paper's section 4.4; or a `Regularizer` with weights of its own.
        search: how many orientations are tried, and what minimizes the keypoints' objective.
        stages: what minimizes it with the regularizer.
        on_step: called with a `spt_jax.Step` after the search, stage 0, after each stage of the
            regularizer, and once more where parts had to be freed after them; what it raises ends
            the fit. Person after person of a batch.

    Returns:
        FitResult with the batch axes of `keypoints`. Under jit and vmap the penalty has the stages
        of other regularizers, compiled, and is not freed afterwards. It is never NaN for usable
        input: where a stage fails, what was there before it stays.

    Raises:
        TypeError, ValueError: arguments of the wrong kind or shape, named in the message; on_step
            where values are traced; where they are known: keypoints that are seen and not finite,
            confidence negative or not finite, nobody's keypoints seen, parameters that are not
            finite.

    Differentiation: none is meant; it runs under jit and vmap.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import PinholeCamera, fit_pose, load_body
        >>> body = load_body()
        >>> camera = PinholeCamera(1000.0, (500.0, 500.0), translation=(0.0, 0.0, 4.0))
        >>> turned = jnp.zeros((52, 3)).at[0, 0].set(jnp.pi)  # upright: the image's y points down
        >>> seen = camera.project(body(turned).joints[:22])
        >>> fit = fit_pose(body, seen, camera, layout=body.joint_names[:22], regularizer="none")
        >>> bool(jnp.abs(fit.keypoints - seen).max() < 10)  # pixels, of a person of 460
        True
    """
    setup, people, batch = prepare_fit(
        body,
        keypoints,
        camera,
        layout=layout,
        confidence=confidence,
        start=start,
        terms=terms,
        regularizer=regularizer,
        search=search,
        stages=stages,
    )
    found = fit_each(setup, people, on_step)
    return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), found)


def fit_each(setup: Setup, people: Person, on_step: OnStep | None = None) -> FitResult:
    """Fit the people of one leading axis."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((setup, people))):
        if on_step is not None:
            raise TypeError(
                "on_step must be left out where values are traced: got one under jit, vmap or grad."
            )
        return jax.vmap(lambda person: _fit_one(setup, person))(people)
    # Under vmap every lane waits for the slowest, through each of the search's loops: eight people
    # took 1.3 times as long as one by one. Nor in threads: two of these programs at a time make
    # XLA's CPU client wait for itself for ever (jax 0.10.2, two cores).
    count = len(people.keypoints)
    rows = [jax.tree.map(lambda leaf, k=k: leaf[k], people) for k in range(count)]
    if has_cuts(setup):
        found = [_fit_by_cuts(setup, row, on_step) for row in rows]
    elif on_step is None:
        found = [_fit_one(setup, row) for row in rows]
    else:
        found = [_fit_in_steps(setup, row, on_step) for row in rows]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


def has_cuts(setup: Setup) -> bool:
    """Whether the search on the host can take the stages: the default penalty, by no solver."""
    term = setup.regularizer
    return setup.solver is None and isinstance(term, SelfIntersection) and term.is_plain


def _fit_by_cuts(setup: Setup, person: Person, on_step: OnStep | None) -> FitResult:
    """The stages of the self-intersection penalty, by the search on the host."""
    term = setup.regularizer
    assert isinstance(term, SelfIntersection)
    candidates = _searched(setup.search, person)
    searched = int(candidates.steps)
    ground = Ground(setup.body, [objective_of(setup.search, person)], term)

    def report(stage: int, vector: Float[Array, "D"]) -> None:
        if on_step is not None:
            posed = _posed(setup.search, setup.body, person, vector)
            on_step(_step(setup.body, stage, searched + ground.looks, posed))

    report(0, candidates.vectors[0])
    stages = PenaltyStages(
        ground,
        np.asarray(term.weights, np.float64),
        float(term.margin),
        setup.max_steps,
        lambda stage, place: report(stage, jnp.asarray(place.vector[0], ground.dtype)),
    )
    end = settled(stages, candidates.vectors, free=setup.free and term.folds == "ignore")
    vector, energy, converged, free = candidates.vectors[0], jnp.nan, False, True
    if end is not None:
        vector, energy = jnp.asarray(end.place.vector[0], ground.dtype), end.place.energy
        converged, free = end.converged, end.is_free or not setup.free or term.folds == "count"
    return finished(
        setup.search,
        setup.body,
        person,
        vector,
        {term.name: jnp.asarray(stages.last * energy, ground.dtype)},
        jnp.asarray(converged),
        jnp.asarray(searched + ground.looks),
        jnp.asarray(free),
    )


@program
def objective_of(search: KeypointSearch, person: Person) -> Objective:
    """The squares of one person's fit."""
    return search.objective(person)


@program
def finished(
    search: KeypointSearch,
    body: BodyModel,
    person: Person,
    vector: Float[Array, "D"],
    regularized: dict[str, Float[Array, ""]],
    converged: Bool[Array, ""],
    steps: Int[Array, ""],
    free: Bool[Array, ""],
) -> FitResult:
    """The result of one person's fit that ended at a vector; as `fit_result`."""
    objective = search.objective(person)
    return fit_result(body, objective, vector, regularized, converged, steps, free)


def _fit_one(setup: Setup, person: Person) -> FitResult:
    # Two programs: fits with different regularizers share the first, which takes longer to compile.
    return _regularize(setup, person, _searched(setup.search, person))


def _fit_in_steps(setup: Setup, person: Person, on_step: OnStep) -> FitResult:
    """`_fit_one` with a program a stage, so that each can be looked at."""
    candidates = _searched(setup.search, person)
    tracks = _tracks(setup, person, candidates)
    taken = int(candidates.steps)
    on_step(_step(setup.body, 0, taken, _posed(setup.search, setup.body, person, tracks[0])))
    ends = None
    for number, weight in enumerate(setup.regularizer.weights):
        now = dataclasses.replace(
            setup, regularizer=dataclasses.replace(setup.regularizer, weights=weight[None])
        )
        ends, best = _one_stage(now, person, tracks)
        tracks, taken = ends.vectors[:, 0], taken + int(jnp.sum(ends.steps))
        posed = _posed(setup.search, setup.body, person, tracks[best])
        on_step(_step(setup.body, number + 1, taken, posed))
    assert ends is not None  # a regularizer has a weight at least
    return _chosen(setup, person, ends, jnp.asarray(taken))


@program
def _searched(search: KeypointSearch, person: Person) -> Candidates:
    return search.candidates(search.objective(person).forgiving(), _LOOKED_AT)


@program
def _regularize(setup: Setup, person: Person, candidates: Candidates) -> FitResult:
    tracks = _tracks_of(setup, person, candidates)
    ends = _descended(setup, person, tracks)
    return _chosen_of(setup, person, ends, candidates.steps + jnp.sum(ends.steps))


def _tracks_of(setup: Setup, person: Person, candidates: Candidates) -> Float[Array, "2 D"]:
    """Where the regularized stages start.

    The best by the keypoints, and the best with the regularizer: what a graze costs to end is only
    known when both have gone through the stages.
    """
    objective, regularizer = setup.search.objective(person), setup.regularizer
    alone = _alone(objective)
    weights = regularizer.weights.astype(candidates.vectors.dtype)

    def energy(vector):
        now = unpacked(alone, vector[None])
        start = jax.tree.map(lambda leaf: leaf[None], objective.start)
        return regularizer.energy(setup.body, start, now)

    looked = candidates.vectors
    # What was searched with a more forgiving loss costs something else with its own.
    costs = candidates.costs if objective.robust is None else jax.vmap(objective.cost)(looked)
    judged = costs + weights[-1] * jax.vmap(energy)(looked)
    return jnp.stack([looked[_least(costs)], looked[_least(judged)]])


def _descended(setup: Setup, person: Person, tracks: Float[Array, "2 D"]) -> Descent:
    alone = _alone(setup.search.objective(person))

    def through_stages(vector):
        return descend(
            setup.regularizer,
            setup.body,
            alone,
            vector[None],
            setup.solver or default_solver(),
            setup.max_steps,
        )

    return jax.vmap(through_stages)(tracks)


def _chosen_of(setup: Setup, person: Person, ends: Descent, steps: Int[Array, ""]) -> FitResult:
    """The result of the track that ended with the lowest total."""
    regularizer, objective = setup.regularizer, setup.search.objective(person)
    weight = regularizer.weights.astype(ends.vectors.dtype)[-1]
    best = _least(ends.cost + weight * ends.energy)
    end = jax.tree.map(lambda leaf: leaf[best], ends)
    cost = {} if regularizer.name == "none" else {regularizer.name: weight * end.energy}
    return fit_result(setup.body, objective, end.vectors[0], cost, end.converged, steps)


_tracks, _chosen = program(_tracks_of), program(_chosen_of)


@program
def _one_stage(
    setup: Setup, person: Person, tracks: Float[Array, "2 D"]
) -> tuple[Descent, Int[Array, ""]]:
    ends = _descended(setup, person, tracks)
    weight = setup.regularizer.weights.astype(tracks.dtype)[-1]
    return ends, _least(ends.cost + weight * ends.energy)


@program
def _posed(
    search: KeypointSearch, body: BodyModel, person: Person, vector: Float[Array, "D"]
) -> tuple[Float[Array, "J 3"], Float[Array, "V 3"]]:
    found = search.objective(person).unpack(vector)
    return found.pose, body(found.pose, found.shape, found.translation).vertices


def _step(body: BodyModel, stage: int, taken: int, posed: tuple[Array, Array]) -> Step:
    pose, vertices = (np.asarray(one) for one in posed)
    return Step(stage, taken, vertices, pose, partial(_volume_and_pairs, body, vertices))


def _volume_and_pairs(body: BodyModel, vertices: Float[np.ndarray, "V 3"]) -> tuple[float, int]:
    try:
        report = intersection_report(vertices, body.faces, rest_surface=body.rest_surface)
    except Unmeasurable:
        return float("nan"), -1
    return report.volume, report.intersecting_pairs


def _alone(objective: Objective) -> Objective:
    return jax.tree.map(lambda leaf: leaf[None], objective)


def _least(costs: Float[Array, "N"]) -> Int[Array, ""]:
    return jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
