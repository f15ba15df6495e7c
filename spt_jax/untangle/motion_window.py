"""One window of a motion: frames that collide, calm ones around them, one smooth correction."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.metrics import MotionOverlap, measured_frames
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.untangle.corrections import Corrections, posed
from spt_jax.untangle.frame_cuts import FrameCuts, Prior

# Rounds over a window. What a collision weighs, per cm^3 against cm^2, is first weak, so that poses
# slide along the contact rather than jump out of it, and more from round to round in frames that
# still collide; then the margin grows.
_ROUNDS = 24
_FIRST, _MORE, _LAST = 0.02, 3.0, 200.0
_WIDER, _WIDEST = 1.5, 4.0

# Rounds after which it is first looked whether frames are free.
_UNCHECKED = 2

# A frame moved by less than this since it was measured, in cm (rms), is not measured again.
_MOVED = 0.003

# A correction below this, in cm (rms), is none.
_NOTHING = 1e-6

# Called with the round and how many of the window's frames still collide.
OnRound = Callable[[int, int], None]


class Solved(NamedTuple):
    """What became of a window.

    Attributes:
        vectors: the correction of each frame.
        pose: the poses of all frames.
        overlap: what is left, without depths.
        rounds: how many there were.
    """

    vectors: Float[np.ndarray, "T N"]
    pose: Float[np.ndarray, "T J 3"]
    overlap: MotionOverlap
    rounds: int


def windows(
    colliding: Bool[np.ndarray, "T"], reach: int, longest: int
) -> Iterator[tuple[int, int, int, bool]]:
    """Runs of frames that collide, with calm ones around them, in pieces.

    Args:
        colliding: which frames collide.
        reach: how many calm frames are added at each end.
        longest: the most frames of a piece.

    Returns:
        Of each piece the first frame, the one after the last, the frame up to which its correction
        is kept, and whether the run ends there. Pieces of one run follow each other; the frames
        between what is kept and the piece's end are found again with the next one.
    """
    near = np.zeros(len(colliding), bool)
    for frame in np.flatnonzero(colliding):
        near[max(frame - reach, 0) : frame + reach + 1] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(np.int8)))
    for first, end in edges.reshape(-1, 2).tolist():
        while end - first > longest:
            yield first, first + longest, first + longest - reach, False
            first += longest - reach
        yield first, end, end, True


def solve(
    corrections: Corrections,
    known: Prior,
    before: MotionOverlap,
    exclusions: Exclusions,
    margin: float,
    tolerance: float,
    on_round: OnRound,
) -> Solved:
    """The least smooth correction with which no frame of the window collides, as far as found.

    Args:
        corrections: how vectors move the window's frames.
        known: what is asked of the correction but for collisions.
        before: the overlap of the frames as they are given.
        exclusions: what does not count.
        margin: how far apart colliding parts are pushed, in metres.
        tolerance: a volume that is none where nothing intersects, in m^3.
        on_round: called after each round.

    Returns:
        The correction with the fewest frames that collide, and of those with the least overlap,
        of those that were measured; none where that is no better than the frames given.
    """
    search = _Search(corrections, before, exclusions, margin, tolerance)
    vectors, best = known.mean, search.given(known)
    rounds = 0
    for rounds in range(1, _ROUNDS + 1):
        search.learn(vectors)
        if rounds > _UNCHECKED:
            free = search.look(vectors)
            if free.all() or rounds == _ROUNDS:
                best = min(best, search.candidate(vectors), key=_rank)
                if best.free.all():
                    break
            on_round(rounds, int(np.count_nonzero(~free)))
        if rounds == _ROUNDS:
            break
        vectors = search.cuts.minimum(known, search.weight)
    return Solved(best.vectors, best.pose, best.overlap, rounds)


class _Candidate(NamedTuple):
    vectors: Float[np.ndarray, "T N"]
    pose: Float[np.ndarray, "T J 3"]
    overlap: MotionOverlap
    free: Bool[np.ndarray, "T"]


def _rank(candidate: _Candidate) -> tuple[int, float]:
    return int(np.count_nonzero(~candidate.free)), float(candidate.overlap.volume.sum())


class _Search:
    """What is known of a window's frames."""

    def __init__(self, corrections, before, exclusions, margin, tolerance):
        self._corrections, self._before = corrections, before
        self._exclusions, self._tolerance = exclusions, tolerance
        count, size = len(before.volume), len(corrections.factor)
        self._margin, self._widest = np.full(count, margin), _WIDEST * margin
        self.cuts, self.weight = FrameCuts(size), np.full(count, _FIRST)
        # Where each frame was last measured; calm frames as given, where nothing was found.
        self._place = np.zeros((count, size))
        self._place[~self._is_free(before)] = np.nan
        self._value = np.zeros(count)

    def _is_free(self, overlap: MotionOverlap) -> Bool[np.ndarray, "T"]:
        return (overlap.intersecting_pairs == 0) & (overlap.volume <= self._tolerance)

    def given(self, known: Prior) -> _Candidate:
        """The frames as they are given; with what earlier pieces of the run pass on, if any."""
        if known.mean.any():
            return self.candidate(known.mean)
        pose = np.asarray(self._corrections.frames.pose)
        return _Candidate(known.mean, pose, self._before, self._is_free(self._before))

    def learn(self, vectors) -> None:
        """Measure the frames that have moved."""
        moved = ~(np.linalg.norm(vectors - self._place, axis=1) <= _MOVED)  # NaN has
        frame = np.flatnonzero(moved)
        if not len(frame):
            return
        place = vectors[frame]
        value, gradient = self._corrections.overlaps(frame, place, self._margin[frame])
        usable = np.isfinite(value) & np.isfinite(gradient).all(axis=1)
        self._place[frame], self._value[frame] = place, np.where(usable, value, np.inf)
        self.cuts.learn(frame[usable], place[usable], value[usable], gradient[usable])

    def look(self, vectors) -> Bool[np.ndarray, "T"]:
        """Which frames are free; those that are not weigh more from now on."""
        free = np.ones(len(vectors), bool)
        doubtful = np.flatnonzero(self._value > 0)
        if len(doubtful):
            pose = self._corrections.poses(doubtful, vectors[doubtful])
            free[doubtful] = self._is_free(self._measured(doubtful, pose))
        self._press(~free)
        return free

    def _press(self, colliding: Bool[np.ndarray, "T"]) -> None:
        full = colliding & (self.weight >= _LAST)
        self.weight[colliding] = np.minimum(self.weight[colliding] * _MORE, _LAST)
        if full.any() and self._widest:
            self._margin[full] = np.minimum(self._margin[full] * _WIDER, self._widest)
            self._place[full] = np.nan

    def candidate(self, vectors) -> _Candidate:
        """A correction, with every frame that it moves measured."""
        pose = np.array(self._corrections.frames.pose)
        size = np.linalg.norm(vectors, axis=1)
        vectors = np.where(size[:, None] > _NOTHING, vectors, 0.0)
        moved = np.flatnonzero(size > _NOTHING)
        overlap = self._before
        if len(moved):
            pose[moved] = self._corrections.poses(moved, vectors[moved])
            overlap = overlap.with_frames(moved, self._measured(moved, pose[moved]))
        free = self._is_free(overlap)
        self._press(~free)
        return _Candidate(vectors, pose, overlap, free)

    def _measured(self, frame: Int[np.ndarray, "F"], pose) -> MotionOverlap:
        corrections = self._corrections
        frames = corrections.frames.at(frame)._replace(pose=pose)
        return measured_poses(corrections.body, frames, self._exclusions, depth=False)


def measured_poses(body, frames, exclusions: Exclusions, *, depth: bool) -> MotionOverlap:
    """The overlap of each frame; as `spt_jax.metrics` measures it."""
    faces = np.asarray(body.faces, np.int64)
    parts = []
    for count, batch in frames.batches():
        vertices = np.asarray(posed(body, batch))
        found = measured_frames(vertices[:count], faces, exclusions, depth=depth)
        parts.append(found.columns())
    return MotionOverlap(*(np.concatenate(column) for column in zip(*parts, strict=True)))
