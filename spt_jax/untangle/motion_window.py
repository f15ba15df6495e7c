"""One window of a motion: frames that collide, calm ones around them, one smooth correction."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.metrics import MotionOverlap, measured_frames
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.untangle.anchors import Anchored, Anchors
from spt_jax.untangle.corrections import Corrections, faces_of, posed
from spt_jax.untangle.curved_ties import anchored_minimum
from spt_jax.untangle.frame_cuts import FrameCuts, Prior

# Rounds over a window. What a collision weighs, per cm^3 against cm^2, is first weak, so that poses
# slide along the contact rather than jump out of it, and more from round to round in frames that
# still collide; then the margin grows.
_ROUNDS = 40
_FIRST, _MORE, _LAST = 0.02, 3.0, 200.0
# At the least, so many times what ties a foot or contact in the frame: a contact that weighed 500
# held frames in collision.
_OUTWEIGHED = 10.0
_WIDER, _WIDEST = 1.5, 4.0

# Rounds after which it is first looked whether frames are free; and how many follow at the most
# once all are, as long as each of them takes away more than this part of the cost.
_UNCHECKED = 2
_POLISHING, _WORTH = 3, 0.03

# A frame's weight grows where the model said how its last step would end: at most this much of the
# root of its overlap, and this much, in cm^1.5, was not foreseen; or after so many rounds.
_FORESEEN, _CLOSE, _PATIENCE = 1.5, 0.3, 2

# How strongly a frame is held to its best place after a step that made things worse, in units of
# the smooth prior's own stiffness, how much more after the next, and how much less after one that
# did well (`contact_solver`).
_HELD, _TIGHTER, _LOOSER = 1.0, 4.0, 0.25

# A frame moved by less than this since it was measured, in cm (rms), is not measured again; and one
# that was never seen to collide, which all that is moved is looked at for in the end.
_MOVED, _CALM = 0.01, 0.1

# With so much overlap left in cm^3, the margin's own among it, a frame is not looked at: it
# collides.
_MUCH = 20.0

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
    pose: Float[np.ndarray, "T P J 3"]
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
    anchors: Anchors,
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
        anchors: what of the body is to stay.
        before: the overlap of the frames as they are given.
        exclusions: what is excluded.
        margin: how far apart colliding parts are pushed, in metres.
        tolerance: a volume that is none where nothing intersects, in m^3.
        on_round: called after each round.

    Returns:
        Of the corrections that were measured the one with the fewest frames that collide, of those
        that leave none the least, of others the one with the least overlap; none where that is no
        better than the frames given.
    """
    search = _Search(corrections, known, anchors, before, exclusions, margin, tolerance)
    vectors, best = known.mean, search.given()
    rounds, polishing = 0, _POLISHING
    for rounds in range(1, _ROUNDS + 1):
        search.learn(vectors)
        if rounds > _UNCHECKED or rounds == _ROUNDS:
            free = search.look(vectors)
            if free.all() or rounds == _ROUNDS:
                found = search.candidate(vectors)
                gain = 1.0 - found.cost / best.cost if best.free.all() else 1.0
                best = min(best, found, key=_rank)
                polishing -= best.free.all()
                if best.free.all() and (gain < _WORTH or not polishing):
                    break
            on_round(rounds, int(np.count_nonzero(~free)))
        if rounds == _ROUNDS or not search.is_known():
            break
        vectors = search.next(vectors)
    return Solved(best.vectors, best.pose, best.overlap, rounds)


class _Candidate(NamedTuple):
    vectors: Float[np.ndarray, "T N"]
    pose: Float[np.ndarray, "T P J 3"]
    overlap: MotionOverlap
    free: Bool[np.ndarray, "T"]
    cost: float


def _rank(candidate: _Candidate) -> tuple[int, float]:
    left = int(np.count_nonzero(~candidate.free))
    return left, float(candidate.overlap.volume.sum()) if left else candidate.cost


class _Search:
    """What is known of a window's frames."""

    def __init__(self, corrections, known, anchors, before, exclusions, margin, tolerance):
        self._corrections, self._known, self._before = corrections, known, before
        self._exclusions, self._tolerance = exclusions, tolerance
        count, size = len(before.volume), corrections.size
        self._margin, self._widest = np.full(count, margin), _WIDEST * margin
        self.cuts, self.weight = FrameCuts(size), np.full(count, _FIRST)
        self._anchored = Anchored(corrections, anchors)
        # Where each frame was last measured; calm frames as given, where nothing was found.
        self._active = ~self._is_free(before)
        self._place = np.zeros((count, size))
        self._place[self._active] = np.nan
        self._value = np.zeros(count)
        self._with_margin = np.zeros(count, bool)
        # Where each frame was last found to be free, without a margin.
        self._clear = np.full((count, size), np.nan)
        # The root of the overlap that the model foresaw, and rounds in which it was wrong.
        self._foreseen, self._surprised = np.zeros(count), np.zeros(count, np.int64)
        # The best place of each frame, its overlap, and how strongly it is held there.
        self._best, self._least = np.zeros((count, size)), np.full(count, np.inf)
        self._held = np.zeros(count)
        self._stiff = _HELD / np.diag(known.kernel)
        tied = anchors.weight.max(axis=1, initial=0.0)
        self._most = np.maximum(_LAST, _OUTWEIGHED * tied)

    def _is_free(self, overlap: MotionOverlap) -> Bool[np.ndarray, "T"]:
        return (overlap.intersecting_pairs == 0) & (overlap.volume <= self._tolerance)

    def is_known(self) -> bool:
        """Whether anything asks for a correction."""
        return bool(len(self.cuts.frame)) or bool(self._known.mean.any())

    def given(self) -> _Candidate:
        """The frames as they are given; with what earlier pieces of the run pass on, if any."""
        mean = self._known.mean
        if mean.any():
            return self.candidate(mean)
        pose = np.asarray(self._corrections.frames.pose)
        return _Candidate(mean, pose, self._before, self._is_free(self._before), np.inf)

    def learn(self, vectors) -> None:
        """Measure the frames that have moved."""
        far = np.where(self._active, _MOVED, _CALM)
        moved = ~(np.linalg.norm(vectors - self._place, axis=1) <= far)  # NaN has
        frame = np.flatnonzero(moved)
        if not len(frame):
            return
        place = vectors[frame]
        value, gradient = self._corrections.overlaps(frame, place, self._margin[frame])
        usable = np.isfinite(value) & np.isfinite(gradient).all(axis=1)
        value = np.where(usable, value, np.inf)
        self._place[frame], self._value[frame] = place, value
        self._with_margin[frame] = True
        self._active[frame] |= value > 0
        self.cuts.learn(frame[usable], place[usable], value[usable], gradient[usable])
        self._judge(frame, place, value)

    def _judge(self, frame, place, value) -> None:
        """Hold frames whose last step made things worse to the best place they had."""
        root = np.sqrt(value)
        wrong = root > _FORESEEN * self._foreseen[frame] + _CLOSE
        self._surprised[frame] = np.where(wrong, self._surprised[frame] + 1, 0)
        weight, best = self.weight[frame], self._best[frame]
        cost = weight * value + np.einsum("fn,fn->f", place, place)
        least = weight * self._least[frame] + np.einsum("fn,fn->f", best, best)
        worse = (cost > least) & (value > self._least[frame])
        stiff = self._stiff[frame]
        held = self._held[frame]
        tighter = np.maximum(_TIGHTER * held, stiff)
        looser = np.where(held > stiff, _LOOSER * held, 0.0)
        self._held[frame] = np.where(worse, tighter, looser)
        better = frame[~worse]
        self._best[better], self._least[better] = place[~worse], value[~worse]

    def next(self, vectors) -> Float[np.ndarray, "T N"]:
        """Where the model is least."""
        known = self._known.held(self._held, self._best)
        found = anchored_minimum(
            self.cuts, known, self.weight, self._anchored, vectors, self._stiff
        )
        self._foreseen = self.cuts.reach(found)
        return found

    def look(self, vectors) -> Bool[np.ndarray, "T"]:
        """Which frames are free; those that are not weigh more from now on."""
        doubtful = (self._value > 0) & (self._value <= _MUCH)
        free = self._value == 0
        found = self._overlap(vectors, np.flatnonzero(doubtful))
        free[doubtful] = self._is_free(found)[doubtful]
        self._press(~free)
        return free

    def _press(self, colliding: Bool[np.ndarray, "T"]) -> None:
        chosen = colliding & ~((self._surprised > 0) & (self._surprised <= _PATIENCE))
        full = chosen & (self.weight >= self._most)
        self.weight = np.where(chosen, np.minimum(self.weight * _MORE, self._most), self.weight)
        if full.any() and self._widest:
            self._margin[full] = np.minimum(self._margin[full] * _WIDER, self._widest)
            self._place[full] = np.nan
            self._least[full] = np.inf

    def candidate(self, vectors) -> _Candidate:
        """A correction, with what every frame that it moves comes to."""
        pose = np.array(self._corrections.frames.pose)
        size = np.linalg.norm(vectors, axis=1)
        vectors = np.where(size[:, None] > _NOTHING, vectors, 0.0)
        moved = np.flatnonzero(size > _NOTHING)
        overlap = self._overlap(vectors, moved)
        if len(moved):
            pose[moved] = self._corrections.poses(moved, vectors[moved])
        free = self._is_free(overlap)
        # Also one whose skin, moved outwards, does not meet: what meets there may be a fold.
        fresh = ~free & (~self._active | (self._value == 0))
        self._margin[fresh & self._active] *= _WIDER
        self._active |= fresh
        self._place[fresh] = np.nan
        self._least[fresh] = np.inf
        self._anchored.look(vectors)
        cost = self._known.cost(vectors) + self._anchored.ties().cost(vectors)
        return _Candidate(vectors, pose, overlap, free, cost)

    def _overlap(self, vectors, moved: Int[np.ndarray, "F"]) -> MotionOverlap:
        """The overlap without a margin; of frames that did not move, what it was.

        Nor is it measured where there was none, or, of a frame that never collided, near by none
        with the margin.
        """
        same = (vectors == self._clear).all(axis=1)
        kept = self._with_margin & ~self._active
        kept &= np.linalg.norm(vectors - self._place, axis=1) <= _MOVED
        known, wanted = (moved[(same | kept)[moved] == yes] for yes in (True, False))
        nothing = self._before.at(known).without_overlap()
        overlap = self._before.with_frames(known, nothing)
        if len(wanted):
            corrections = self._corrections
            pose = corrections.poses(wanted, vectors[wanted])
            frames = corrections.frames.at(wanted)._replace(pose=pose)
            found = measured_poses(corrections.body, frames, self._exclusions, depth=False)
            overlap = overlap.with_frames(wanted, found)
            free = wanted[self._is_free(found)]
            self._clear[free] = vectors[free]
        return overlap


def measured_poses(body, frames, exclusions: Exclusions, *, depth: bool) -> MotionOverlap:
    """The overlap of each frame; as `spt_jax.metrics` measures it."""
    faces = faces_of(body, frames.people)
    parts = []
    for count, batch in frames.batches():
        vertices = np.asarray(posed(body, batch))
        found = measured_frames(vertices[:count], faces, exclusions, depth=depth)
        parts.append(found.columns())
    return MotionOverlap(*(np.concatenate(column) for column in zip(*parts, strict=True)))
