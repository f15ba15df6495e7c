"""Freeing a motion of its collisions as a whole, so that what was smooth stays smooth."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from spt_jax._exclusions import as_fold_surface
from spt_jax._query import as_margin
from spt_jax._result import Result, plain
from spt_jax._status import RESULTS, in_words, names_of
from spt_jax.body import AbstractBody
from spt_jax.metrics import MotionOverlap
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.untangle.corrections import Corrections, Frames, displacement_factor
from spt_jax.untangle.feet import standing_feet
from spt_jax.untangle.frame_cuts import prior
from spt_jax.untangle.motion_window import measured_poses, solve, windows

# Calm frames that are moved along on either side of a collision, in units of the time in which a
# correction fades: there it has come down to a twenty-fifth.
_REACH = 5.0

# The most frames for which one correction is found at once: so many of the same units, or at least
# so many frames.
_LONGEST, _SHORTEST = 60.0, 64


class MotionStep(NamedTuple):
    """One round of `untangle_motion` over a window: frames before `first` are done.

    Attributes:
        first, end: the window's first frame, and the one after its last.
        round: how many corrections of the window were tried.
        colliding: how many of its frames still collide.
        frames: how many frames the motion has.
    """

    first: int
    end: int
    round: int
    colliding: int
    frames: int


class MotionResult(Result):
    """What `untangle_motion` found.

    Attributes:
        pose: the motion; frames that were not moved are those given, to the bit.
        before, after: the overlap of each frame of the motion given and of what was found.
        moved: which frames were moved.
        rounds: over all windows, how often a correction was tried.
        status: of each frame, how it ended, one of `spt_jax.RESULTS`.
    """

    pose: Float[Array, "T J 3"]
    before: MotionOverlap
    after: MotionOverlap
    moved: Bool[np.ndarray, "T"]
    rounds: int
    status: RESULTS

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
        return {
            "frames": len(self.moved),
            "free_frames": int(np.count_nonzero(np.asarray(self.is_free))),
            "moved_frames": int(np.count_nonzero(self.moved)),
            "rounds": self.rounds,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "status": names_of(self.status),
            "moved": plain(self.moved),
        }


def untangle_motion(
    body: AbstractBody,
    poses: Float[Array, "T J 3"] | Float[np.ndarray, "T J 3"],
    *,
    shape: Float[Array, "*T B"] | Float[np.ndarray, "*T B"] | None = None,
    translation: Float[Array, "*T 3"] | Float[np.ndarray, "*T 3"] | None = None,
    frames_per_second: float = 30.0,
    fade: float = 0.05,
    fold_distance: float | None = None,
    margin: float = 0.002,
    feet: float = 1.0,
    up: Any = (0.0, 1.0, 0.0),
    tolerance: float = 1e-9,
    on_step: Callable[[MotionStep], None] | None = None,
) -> MotionResult:
    """The motion nearest to the one given in which no body parts collide, as smooth as it was.

    Frames that collide are freed together with calm ones around them. With d_t the mean squared
    displacement of the skin by a correction of frame t's joints, to first order, and V_t what is
    left of the overlap, the sum over frames of

        d_t + 2 s^2 d(first difference of the correction) + s^4 d(second difference) + w_t V_t

    is made small, s the time `fade` in frames, with weights w_t that grow where frames collide
    until they do so no more. The correction is a turn of every joint but the root, in the axes of
    its own part, so that it moves along with the limb. Frames farther than five times `fade` from
    any collision come back unchanged to the bit; folds, the creases that skinning makes at
    armpits, elbows and groins, are left as they are.

    Args:
        body: a `BodyModel`, a `RigModel`, or what `spt_jax.body.adapt` makes of a body with joints.
        poses: axis-angle of each frame, in radians.
        shape: shape coefficients, one vector or one a frame; held fixed.
        translation: in metres, one vector or one a frame; held fixed.
        frames_per_second: the motion's rate.
        fade: the time in which a correction comes and goes, in seconds. Longer is smoother and
            moves more frames.
        fold_distance: as in `untangle_pose`.
        margin: how far apart colliding parts are pushed, in metres.
        feet: what the mean squared displacement of a foot that stands on the ground weighs, against
            that of the whole skin; 0 lets feet go. A foot stands where it is within 5 cm of the
            lowest place of the motion and slower than 0.3 m/s; without a translation, which
            says neither, where it is within 5 cm of the frame's lowest vertex. A window of frames
            has one weight, its mean.
        up: the direction that is up.
        tolerance: an overlap of this volume or less, in m^3, is none where nothing intersects.
        on_step: called with a `MotionStep` after each round over a window; what it raises ends the
            search.

    Returns:
        The poses with the fewest frames that collide of those measured in each window, never more
        than in the motion given, and figures of each frame. Long runs of collisions are freed in
        windows that overlap, one after the other. Frames are measured eight at a time:
        `spt_jax.config.processes = "auto"` shares them among the cores.

    Raises:
        ValueError: poses that are not (frames, J, 3), or not finite (the first such frame is
            named); shape or translation that is not finite or does not fit; a rate or fade that
            is not positive and finite; a margin, fold_distance or weight of feet that is negative
            or not finite; no direction up; a frame in which the body has no surface that could be
            measured.
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
    frames = _as_frames(body, poses, shape, translation)
    rate = _as_positive("frames_per_second", frames_per_second)
    smoothness = _as_positive("fade", fade) * rate
    apart, weight = as_margin(margin), _as_positive("feet", feet, zero=True)
    exclusions = Exclusions(rest=as_fold_surface(body, fold_distance))
    report = on_step or _nothing
    count = len(frames.pose)
    before = measured_poses(body, frames, exclusions, depth=True)
    colliding = (before.intersecting_pairs > 0) | (before.volume > tolerance)
    pose, turns = np.array(frames.pose), np.zeros((count, body.pose_shape[0] - 1, 3))
    standing = standing_feet(body, frames, rate, _as_up(up), on_ground=translation is not None)
    reach = int(np.ceil(_REACH * smoothness))
    longest = max(int(_LONGEST * smoothness), 4 * reach, _SHORTEST)
    rounds = 0
    for first, end, kept, closed in windows(colliding, reach, longest):
        chosen = np.arange(first, end)
        part, share = frames.at(chosen), weight * standing.share[chosen]
        factor = displacement_factor(body, part, standing.feet, share)
        corrections = Corrections(body, exclusions.rest, part, factor)
        earlier = corrections.vectors(turns[max(first - 2, 0) : first])
        after = min(2, count - end) if closed else 0
        solved = solve(
            corrections,
            prior(earlier, len(chosen), after, smoothness),
            before.at(chosen),
            exclusions,
            apart,
            float(tolerance),
            lambda number, left, at=(first, end): report(MotionStep(*at, number, left, count)),
        )
        keep = slice(0, kept - first)
        pose[first:kept] = solved.pose[keep]
        turns[first:kept] = corrections.turns(solved.vectors)[keep]
        rounds += solved.rounds
    moved = np.any(turns != 0, axis=(1, 2))
    after = _after(body, frames, pose, moved, before, exclusions)
    free = (after.intersecting_pairs == 0) & (after.volume <= tolerance)
    return MotionResult(
        pose=jnp.asarray(pose),
        before=before,
        after=after,
        moved=moved,
        rounds=rounds,
        status=jax.vmap(_status)(jnp.asarray(free)),
    )


def _status(free: Bool[Array, ""]) -> Any:
    found: Any = RESULTS.successful
    return RESULTS.where(free, found, RESULTS.intersections_left)


def _after(body, frames: Frames, pose, moved, before: MotionOverlap, exclusions) -> MotionOverlap:
    """The overlap of the motion found; of frames that did not move, what it was."""
    at = np.flatnonzero(moved)
    if not len(at):
        return before
    found = measured_poses(body, frames.at(at)._replace(pose=pose[at]), exclusions, depth=True)
    return before.with_frames(at, found)


def _as_frames(body: AbstractBody, poses: Any, shape: Any, translation: Any) -> Frames:
    if isinstance(poses, Tracer):
        raise TypeError(
            "poses must be known: got a traced array; untangle_motion decides by the values that "
            "it sees, so call it outside jit, vmap and grad."
        )
    pose = jnp.asarray(poses)
    if not body.pose_is_rotations:
        raise ValueError(
            "body must have a pose that is rotations of joints, (J, 3): got one with poses of "
            f"shape {body.pose_shape}; free its frames one by one with untangle_pose."
        )
    if pose.ndim != 3 or pose.shape[1:] != body.pose_shape or not len(pose):
        raise ValueError(
            f"poses must have shape (frames, {body.pose_shape[0]}, 3), at least one frame: got "
            f"{pose.shape}; body.pose_from_smpl converts poses of other joint counts."
        )
    shapes = _per_frame("shape", shape, len(pose), body.num_shape if shape is None else None)
    places = _per_frame("translation", translation, len(pose), 3)
    _check_finite(poses=pose, shape=shapes, translation=places)
    dtype = pose.dtype
    return Frames(np.asarray(pose), np.asarray(shapes, dtype), np.asarray(places, dtype))


def _per_frame(name: str, array: Any, count: int, size: int | None) -> Float[Array, "T B"]:
    if array is None:
        return jnp.zeros((count, size or 0))
    given = jnp.asarray(array)
    if given.ndim not in (1, 2) or (given.ndim == 2 and len(given) != count):
        raise ValueError(
            f"{name} must be one vector, or one for each of {count} frames: got shape "
            f"{given.shape}."
        )
    if size is not None and given.shape[-1] != size:
        raise ValueError(f"{name} must have {size} numbers a frame: got shape {given.shape}.")
    return jnp.broadcast_to(given, (count, given.shape[-1]))


def _check_finite(**arrays: Array) -> None:
    for name, array in arrays.items():
        wrong = np.flatnonzero(~np.isfinite(np.asarray(array)).reshape(len(array), -1).all(axis=1))
        if len(wrong):
            raise ValueError(
                f"{name} must be finite: got NaN or infinity in {len(wrong)} of {len(array)} "
                f"frames, frame {wrong[0]} the first; leave such frames out, or fill them in."
            )


def _as_positive(name: str, value: Any, *, zero: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number: got {value!r}.")
    if not (0 < value < np.inf or (zero and value == 0)):
        least = "not negative" if zero else "positive"
        raise ValueError(f"{name} must be finite and {least}: got {value!r}.")
    return float(value)


def _as_up(up: Any) -> Float[np.ndarray, "3"]:
    direction = np.asarray(up, np.float64)
    if direction.shape != (3,) or not 0 < np.linalg.norm(direction) < np.inf:
        raise ValueError(f"up must be a direction, three numbers not all zero: got {up!r}.")
    return direction / np.linalg.norm(direction)


def _nothing(step: MotionStep) -> None:
    pass
