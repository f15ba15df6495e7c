"""The windows of a motion one after the other, and what is measured before and after them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax._groups import between_groups, within_groups
from spt_jax.body import AbstractBody
from spt_jax.metrics import MotionOverlap
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.untangle.anchors import Anchors
from spt_jax.untangle.corrections import Corrections, Frames
from spt_jax.untangle.frame_cuts import prior
from spt_jax.untangle.kept_windows import KeptWindows
from spt_jax.untangle.motion_window import measured_poses, solve, windows
from spt_jax.untangle.pace import paces

# Calm frames that are moved along on either side of a collision, in units of the time in which a
# correction fades: there it has come down to a twenty-fifth.
_REACH = 5.0

# The most frames for which one correction is found at once: so many of the same units, or at least
# so many frames.
_LONGEST, _SHORTEST = 60.0, 64

# Frames that are measured between two reports.
_REPORTED = 256


class MotionStep(NamedTuple):
    """How far `untangle_motion` has come.

    Attributes:
        stage: "measuring" the motion given, "freeing" its windows, "checking" what was moved.
        done: how many frames the stage is through with.
        frames: how many frames the motion has.
        first, end: the window's first frame, and the one after its last.
        round: how many corrections of the window were tried.
        colliding: how many of its frames still collide; of "measuring" and "checking", of all
            that were measured.
    """

    stage: str
    done: int
    frames: int
    first: int
    end: int
    round: int
    colliding: int


def reach_of(fade: float, rate: float) -> int:
    """How many frames from a collision a correction reaches; frames farther off do not move."""
    return int(np.ceil(_REACH * fade * rate))


class Run:
    """A motion that is worked on.

    Args:
        body, frames: the motion.
        exclusions: what is excluded.
        kept: what was done before, and where what is done goes.
        report: called with the progress.
    """

    def __init__(
        self,
        body: AbstractBody,
        frames: Frames,
        exclusions: Exclusions,
        kept: KeptWindows,
        report: Callable[[MotionStep], None],
    ):
        self._body, self._frames, self._exclusions = body, frames, exclusions
        self._kept, self._report = kept, report

    def measured(
        self, name: str, stage: str, at: Int[np.ndarray, "F"], pose: Float[np.ndarray, "F P J 3"]
    ) -> MotionOverlap:
        """The overlap of some frames in other poses, with depths."""
        return self._measured(name, stage, at, pose, self._exclusions)

    def _measured(self, name, stage, at, pose, exclusions: Exclusions) -> MotionOverlap:
        parts, colliding = [], 0
        for start in range(0, len(at), _REPORTED):
            chosen = slice(start, start + _REPORTED)
            known = self._kept.found(f"{name}_{start:06d}")
            if known is None:
                frames = self._frames.at(at[chosen])._replace(pose=pose[chosen])
                found = measured_poses(self._body, frames, exclusions, depth=True)
                known = {str(k): column for k, column in enumerate(found.columns())}
                self._kept.keep(f"{name}_{start:06d}", known)
            parts.append(MotionOverlap(*(known[str(k)] for k in range(len(known)))))
            colliding += int(np.count_nonzero(~parts[-1].is_free))
            done, count = min(start + _REPORTED, len(at)), len(self._frames.pose)
            self._report(MotionStep(stage, done, count, 0, count, 0, colliding))
        columns = zip(*(part.columns() for part in parts), strict=True)
        return MotionOverlap(*(np.concatenate(column) for column in columns))

    def freed(
        self, before: MotionOverlap, colliding: Bool[np.ndarray, "T"], anchors: Anchors, asked: Any
    ) -> tuple[Float[np.ndarray, "T P J 3"], Float[np.ndarray, "T P K 3"], int]:
        """The poses, the turns that led there, and how often corrections were tried.

        Args:
            before: the overlap of the motion given.
            colliding: which frames collide.
            anchors: what is to stay.
            asked: rate, fade, margin and tolerance.
        """
        frames, count = self._frames, len(self._frames.pose)
        smoothness = asked.fade * asked.rate
        reach = reach_of(asked.fade, asked.rate)
        pace = paces(self._body, frames, asked.rate, asked.fade) * asked.rate
        longest = max(int(_LONGEST * smoothness), 4 * reach, _SHORTEST)
        pose = np.array(frames.pose)
        turns = np.zeros((count, frames.people, frames.pose.shape[2] - 1, 3))
        rounds = 0
        for first, end, kept, closed in windows(colliding, reach, longest):
            part = slice(first, kept)
            known = self._kept.found(f"window_{first:06d}")
            if known is None:
                chosen = np.arange(first, end)
                corrections = Corrections.of(self._body, self._exclusions.rest, frames.at(chosen))
                earlier = corrections.vectors(turns[max(first - 2, 0) : first])
                after = min(2, count - end) if closed else 0
                solved = solve(
                    corrections,
                    prior(earlier, len(chosen), after, pace[first - len(earlier) : end + after]),
                    anchors.at(chosen),
                    before.at(chosen),
                    self._exclusions,
                    asked.margin,
                    asked.tolerance,
                    lambda number, left, at=(first, end): self._report(
                        MotionStep("freeing", at[0], count, *at, number, left)
                    ),
                )
                keep = slice(0, kept - first)
                known = {
                    "pose": solved.pose[keep],
                    "turns": corrections.turns(solved.vectors)[keep],
                    "rounds": np.array(solved.rounds),
                }
                self._kept.keep(f"window_{first:06d}", known)
            pose[part], turns[part] = known["pose"], known["turns"]
            rounds += int(known["rounds"])
        return pose, turns, rounds

    def counted_apart(
        self, pose: Float[np.ndarray, "T P J 3"], before: MotionOverlap, after: MotionOverlap
    ) -> dict[str, tuple[MotionOverlap, MotionOverlap]]:
        """The overlap of people with themselves, and between them, before and after."""
        people, found = self._frames.people, {}
        groups = np.repeat(np.arange(people), len(self._body.faces)).astype(np.int64).tobytes()
        ways = {"within": between_groups(people), "between": within_groups(people)}
        for name, ignored in ways.items():
            exclusions = Exclusions(groups, ignored, self._exclusions.rest)
            both = []
            for when, whole, at_pose in (
                ("before", before, self._frames.pose),
                ("after", after, pose),
            ):
                overlap, at = whole.without_overlap(), np.flatnonzero(~whole.is_free)
                if len(at):
                    part = f"{name}_{when}"
                    overlap = overlap.with_frames(
                        at, self._measured(part, "checking", at, at_pose[at], exclusions)
                    )
                both.append(overlap)
            found[name] = (both[0], both[1])
        return found
