"""How `spt-jax fit` fits the people that it has gathered: one by one, or a scene together."""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from spt_jax.cli.annotated import Annotated
from spt_jax.cli.fitted import Fitted, as_fitted
from spt_jax.cli.kept import people_arrays, people_of
from spt_jax.cli.terminal import State, user_errors
from spt_jax.keypoints.mistakes import Robust, robust_scale

if TYPE_CHECKING:
    from spt_jax.body import BodyModel
    from spt_jax.cli.unfinished import UnfinishedRun

# How much an angle changes from frame to frame of a sequence, in radians: as `fit_motion` has it.
_SPEED = 0.15


def scenes_of(people: Sequence[Annotated]) -> list[list[Annotated]]:
    """The people of each image, to be fitted together.

    Raises:
        ValueError: people of one image have keypoints of several layouts.
    """
    # People of one image may stand apart in the file.
    groups: dict[str, list[Annotated]] = {}
    for one in people:
        groups.setdefault(one.image, []).append(one)
    for image, group in groups.items():
        layouts = {one.person.layout for one in group}
        if len(layouts) > 1:
            raise ValueError(
                f"people of one scene must share a layout: got {sorted(layouts)} in {image}; "
                "leave --together out, or choose --people."
            )
    return list(groups.values())


def made_from(groups: Sequence[Sequence[Annotated]]) -> list[tuple[str, list[Any]]]:
    """The name of each group, and all that its fit is made from."""
    found = []
    for group in groups:
        given: list[Any] = [group[0].image, group[0].size]
        for one in group:
            given += [one.name, one.person.layout, one.person.points, one.person.confidence]
        given += [*jax.tree.leaves(group[0].camera), group[0].camera.near]
        found.append((group[0].name if len(group) == 1 else group[0].image, given))
    return found


def fit_everyone(
    body: "BodyModel",
    groups: Sequence[Sequence[Annotated]],
    *,
    regularizer: str,
    fold_distance: float | None = None,
    robust: Robust,
    fit_shape: bool,
    state: State,
    run: "UnfinishedRun",
    tracks: Mapping[str, int] | None = None,
) -> tuple[list[Fitted], list[dict[str, Any]]]:
    """Fit everyone, and measure the bodies' overlaps.

    Group by group, so that each may have a camera and the bar moves on; it compiles once a layout
    and size of a group. A group of one is fitted alone, one of several as a scene. `run` keeps each
    group as it is done, and has those that were done before. `tracks` has the number of each
    person's track in a sequence: somebody in a frame is near what he was in the frame before, and
    with `fit_shape` all of a track have the shape of its first frame.

    Returns:
        The people, group by group; and of each scene what report.json says.
    """
    from spt_jax._exclusions import as_fold_surface
    from spt_jax.fit import people as scenes
    from spt_jax.fit import pose as fitting
    from spt_jax.fit.motion import near_pose
    from spt_jax.fit.options import Scene, Start, Terms
    from spt_jax.fit.problem.learned_priors import pose_prior
    from spt_jax.fit.problem.priors import GaussianPosePrior
    from spt_jax.fit.regularizers import as_regularizer
    from spt_jax.fit.regularizers.spt import SelfIntersection

    term = as_regularizer(regularizer)
    if isinstance(term, SelfIntersection):
        term = dataclasses.replace(term, fold_distance=fold_distance)
    prepared = term.prepared(body, 1)
    folds = as_fold_surface(body, fold_distance)
    found, told, compiled = [], [], set()
    before: dict[int, Fitted] = {}
    usual = pose_prior(body.joint_names)
    for number, group in enumerate(groups):
        kept = run.found(number)
        if kept is not None:
            people, scene = people_of(kept, group)
            before |= _ends_of(people, tracks)
            found += people
            told += [] if scene is None else [scene]
            continue
        key = (group[0].person.layout, len(group))
        name = group[0].name if len(group) == 1 else f"{group[0].image}, {len(group)} people"
        wait = "" if key in compiled else "compiling (10 to 40 s), then "
        compiled.add(key)
        state(f"{name}: {wait}fitting", done=len(found))
        start = time.perf_counter()
        options: dict[str, Any] = {
            "layout": group[0].person.layout,
            "confidence": np.stack([one.person.confidence for one in group]).astype(np.float32),
            "regularizer": prepared,
            "start": Start(fit_shape=fit_shape),
        }
        scales = [robust_scale(one.person, robust) for one in group]  # None, all of them, if off
        last = before.get(tracks[group[0].name]) if tracks else None
        prior: GaussianPosePrior = usual
        if last is not None and last.usable:
            prior = near_pose(usual, jnp.asarray(last.pose), _SPEED)
            if fit_shape:
                options["start"] = Start(shape=last.shape)
        points = np.stack([one.person.points for one in group]).astype(np.float32)
        scene = None
        if len(group) > 1:
            options |= {
                "terms": Terms(robust=None if robust == "off" else np.array(scales)),
                "scene": Scene(fold_distance=fold_distance),
            }
            together = scenes.fit_people(body, points, group[0].camera, **options)
            results = together.people
            scene = {
                "image": group[0].image,
                "people": [one.name for one in group],
                "before": together.before.as_dict(),
                "after": together.after.as_dict(),
            }
        else:
            options |= {
                "confidence": options["confidence"][0],
                "terms": Terms(prior=prior, robust=scales[0]),
            }
            result = fitting.fit_pose(body, points[0], group[0].camera, **options)
            results = jax.tree.map(lambda leaf: leaf[None], result)
        results = jax.tree.map(np.asarray, results)
        seconds = (time.perf_counter() - start) / len(group)
        state(f"{name}: measuring")
        people = []
        for k, one in enumerate(group):
            result = jax.tree.map(lambda leaf, k=k: leaf[k], results)
            people.append(as_fitted(body, one, result, folds, seconds))
        before |= _ends_of(people, tracks)
        arrays = people_arrays(people, scene)
        with user_errors():
            run.keep(number, arrays)
        found += people
        told += [] if scene is None else [scene]
    return found, told


def _ends_of(people: Sequence[Fitted], tracks: Mapping[str, int] | None) -> dict[int, Fitted]:
    """By track, who was fitted last."""
    return {tracks[one.name]: one for one in people} if tracks else {}
