"""Freeing a motion of its collisions as a whole, so that what was smooth stays smooth."""

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from spt_jax._exclusions import as_fold_surface
from spt_jax._query import as_margin
from spt_jax._result import Result, plain
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax.body import AbstractBody
from spt_jax.metrics import MotionOverlap
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.untangle.anchors import anchors_of
from spt_jax.untangle.feet import standing_feet
from spt_jax.untangle.kept_windows import KeptWindows
from spt_jax.untangle.motion_contacts import as_motion_contacts, kept_contacts
from spt_jax.untangle.motion_input import as_frames, as_positive, as_up
from spt_jax.untangle.motion_run import MotionStep, Run, reach_of


class MotionResult(Result):
    """What `untangle_motion` found.

    Attributes:
        pose: the motion; frames that were not moved are those given, to the bit.
        before, after: the overlap of each frame of the motion given and of what was found.
        moved: which frames were moved.
        rounds: over all windows, how often a correction was tried.
        status: of each frame, how it ended, one of `spt_jax.RESULTS`.
        within, between: of several people, the overlap of each with themselves, and between them,
            each before and after; volumes and pairs of both add up to all. None of one person.
    """

    pose: Float[Array, "T *people J 3"]
    before: MotionOverlap
    after: MotionOverlap
    moved: Bool[np.ndarray, "T"]
    rounds: int
    status: RESULTS
    within: tuple[MotionOverlap, MotionOverlap] | None = None
    between: tuple[MotionOverlap, MotionOverlap] | None = None

    @property
    def is_free(self) -> Bool[Array, "T"]:
        """Of each frame, whether no parts collide any more."""
        return self.status == RESULTS.successful

    @property
    def reason(self) -> list[str]:
        """The status of each frame in words."""
        return in_words(self.status, {"successful": "collision-free"})

    def as_dict(self) -> dict[str, Any]:
        """All but the poses, as JSON types."""
        apart = {
            f"{name}_{when}": overlap.as_dict()
            for name, both in (("within", self.within), ("between", self.between))
            if both is not None
            for when, overlap in zip(("before", "after"), both, strict=True)
        }
        return {
            "frames": len(self.moved),
            "free_frames": int(np.count_nonzero(np.asarray(self.is_free))),
            "moved_frames": int(np.count_nonzero(self.moved)),
            "rounds": self.rounds,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "status": names_of(self.status),
            "moved": plain(self.moved),
            **apart,
        }


def untangle_motion(
    body: AbstractBody,
    poses: Float[Array, "T *people J 3"] | Float[np.ndarray, "T *people J 3"],
    *,
    shape: Float[Array, "*T B"] | Float[np.ndarray, "*T B"] | None = None,
    translation: Float[Array, "*T 3"] | Float[np.ndarray, "*T 3"] | None = None,
    frames_per_second: float = 30.0,
    fade: float = 0.02,
    fold_distance: float | None = None,
    margin: float = 0.002,
    feet: float = 20.0,
    contacts: Any = None,
    contact_distance: float = 0.02,
    contact_weight: float = 20.0,
    up: Any = (0.0, 1.0, 0.0),
    tolerance: float = 1e-9,
    resume: str | os.PathLike[str] | None = None,
    on_step: Callable[[MotionStep], None] | None = None,
) -> MotionResult:
    """The motion nearest to the one given in which no body parts collide, as smooth as it was.

    Frames that collide are freed together with calm ones around them. With d_t the mean squared
    displacement of the skin by a correction of frame t's joints, to first order, and V_t what is
    left of the overlap, the sum over frames of

        d_t + 2 s^2 d(first difference of the correction) + s^4 d(second difference) + w_t V_t

    is made small, s a time in frames, with weights w_t that grow where frames collide
    until they do so no more; what feet and contacts
    ask for is added. How long s is, follows from `fade` and from how fast the motion is there: slow
    ones would be seen to shake, fast ones need not be moved long before they collide. The
    correction is a turn of every joint but the root, in the axes of
    its own part, so that it moves along with the limb. Frames farther than five times `fade` from
    any collision come back unchanged to the bit; folds, the creases that skinning makes at
    armpits, elbows and groins, are left as they are.

    Args:
        body: a `BodyModel`, a `RigModel`, or what `spt_jax.body.adapt` makes of a body with joints;
            of several people, that of all of them.
        poses: axis-angle of each frame, in radians; (frames, people, J, 3) is a scene of several
            people, who are freed of themselves and of each other together.
        shape: shape coefficients, one vector or one a frame; of several people one for all, one a
            person, or one for each person in each frame. Held fixed.
        translation: in metres, likewise; several people must have one.
        frames_per_second: the motion's rate.
        fade: the time in which a correction comes and goes, in seconds, where the fastest vertex
            accelerates by 45 m/s^2, as in a kick; up to 2.5 times as long where the motion is
            slower, down to a quarter where it is faster. Longer is smoother and moves more.
        fold_distance: as in `untangle_pose`.
        margin: how far apart colliding parts are pushed, in metres.
        feet: what the squared displacement in cm^2 of the middle of a foot that stands on the
            ground weighs in a frame, against that of the whole skin; 0 lets feet go. A foot stands
            where it is within 5 cm of the lowest place of the motion and slower than 0.3 m/s;
            without a translation, which says neither, where it is within 5 cm of the frame's lowest
            vertex.
        contacts: contact that is wanted: "found", the parts that come near each other and are no
            fold, as `find_contacts` finds them; pairs of patches as `contact_penalty` takes them;
            or pairs of vertices, (contacts, 2), such as of a palm and a hip; of several people
            numbered through, person * body.num_vertices + vertex. In frames in which two vertices
            are within `contact_distance` of each other in the motion given, the squared change of
            their difference in cm^2 weighs `contact_weight`. Of parts and patches, those vertices
            are tied that are nearest to each other while the two touch.
        contact_distance: in metres.
        contact_weight: 0 lets contacts go; however much it is, collisions outweigh it.
        up: the direction that is up.
        tolerance: an overlap of this volume or less, in m^3, is none where nothing intersects.
        resume: a folder in which what is done is kept, window by window, made where missing. A
            call with the same arguments goes on there and comes to the same result to the bit,
            however the one before ended; the folder stays, for you to remove.
        on_step: called with a `MotionStep` after each round over a window, and after every 256
            frames that are measured; what it raises ends the search.

    Returns:
        The poses with the fewest frames that collide of those measured in each window, never more
        than in the motion given, and figures of each frame. Long runs of collisions are freed in
        windows that overlap, one after the other. Frames are measured eight at a time:
        `spt_jax.config.processes = "auto"` shares them among the cores.

    Raises:
        ValueError: poses that are not (frames, J, 3) or (frames, people, J, 3), or not finite (the
            first such frame is named); several people without a translation; shape or translation
            that is not finite or does not fit; a rate or fade that is not positive and finite; a
            margin, fold_distance, distance or weight that is negative or not finite; no direction
            up; contacts that are no pairs of vertices or patches; a folder to resume in of another
            motion; a frame in which the body has no surface that could be measured.
        TypeError: poses traced; options that are no numbers.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> from spt_jax import load_body, load_mocap, untangle_motion
        >>> body, mocap = load_body(), load_mocap()
        >>> frame = mocap.names.index("cartwheel/0102")
        >>> result = untangle_motion(body, body.pose_from_smpl(mocap.pose[frame : frame + 3]))
        >>> int(result.before.is_free.sum()), int(result.after.is_free.sum())
        (1, 3)
    """
    frames = as_frames(body, poses, shape, translation)
    wanted = as_motion_contacts(contacts, body, frames.people)
    asked = _Asked(
        rate=as_positive("frames_per_second", frames_per_second),
        fade=as_positive("fade", fade),
        margin=as_margin(margin),
        feet=as_positive("feet", feet, zero=True),
        contact_distance=as_positive("contact_distance", contact_distance, zero=True),
        contact_weight=as_positive("contact_weight", contact_weight, zero=True),
        tolerance=float(tolerance),
    )
    direction = as_up(up)
    rest = as_fold_surface(body, fold_distance)
    rest = rest if frames.people == 1 else rest.copies(frames.people)
    made_from = [*asked, direction, rest.distances, *frames, *jax.tree.leaves(body)]
    made_from += [str(jax.tree.structure(body)), translation is None, *jax.tree.leaves(wanted)]
    kept = KeptWindows(resume, made_from)
    run = Run(body, frames, Exclusions(rest=rest), kept, on_step or _nothing)
    before = run.measured(
        "before", "measuring", np.arange(len(frames.pose)), np.asarray(frames.pose)
    )
    colliding = (before.intersecting_pairs > 0) | (before.volume > asked.tolerance)
    pose, turns, rounds = np.array(frames.pose), None, 0
    if colliding.any():
        standing = standing_feet(
            body, frames, asked.rate, direction, on_ground=translation is not None
        )
        reach = reach_of(asked.fade, asked.rate)
        pairs, touching = kept_contacts(
            body, frames, wanted, asked.contact_distance, rest, colliding, reach
        )
        weights = asked.feet * standing.share, asked.contact_weight * touching
        anchors = anchors_of(body, frames, standing.feet, weights[0], pairs, weights[1])
        pose, turns, rounds = run.freed(before, colliding, anchors, asked)
    moved = np.zeros(len(pose), bool) if turns is None else np.any(turns != 0, axis=(1, 2, 3))
    after = before
    if moved.any():
        at = np.flatnonzero(moved)
        after = before.with_frames(at, run.measured("after", "checking", at, pose[at]))
    free = (after.intersecting_pairs == 0) & (after.volume <= asked.tolerance)
    return MotionResult(
        pose=jnp.asarray(pose).reshape(jnp.shape(poses)),
        before=before,
        after=after,
        moved=moved,
        rounds=rounds,
        status=jax.vmap(_status)(jnp.asarray(free)),
        **({} if frames.people == 1 else run.counted_apart(pose, before, after)),
    )


class _Asked(NamedTuple):
    """Numbers of `untangle_motion`, checked; `fade` in seconds."""

    rate: float
    fade: float
    margin: float
    feet: float
    contact_distance: float
    contact_weight: float
    tolerance: float


def _status(free: Bool[Array, ""]) -> Any:
    found: Any = RESULTS.successful
    return RESULTS.where(free, found, RESULTS.intersections_left)


def _nothing(step: MotionStep) -> None:
    pass
