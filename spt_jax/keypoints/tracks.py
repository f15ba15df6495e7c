"""Who is who from frame to frame."""

from collections.abc import Hashable, Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Float

from spt_jax.keypoints.entries import Person

# Somebody who moves by more than this share of his own size between two frames is somebody else.
_FARTHEST = 0.5
# A track that nobody continued for so many frames has ended.
_LONGEST_GAP = 10


def find_tracks(people: Sequence[Person]) -> list[list[int]]:
    """The rows of each person of a sequence, frame by frame.

    By the ids of the file where everybody has one; else a person is who was nearest in the frames
    before: pairs are matched so that the mean distances between points that both have are least in
    sum (the assignment of Kuhn and Munkres), and nobody moves by more than half of the size of the
    box around him.

    Args:
        people: in the order of the frames; those with one `image` are of one frame.

    Returns:
        The rows in `people` of each track, the tracks in the order in which they begin.

    Raises:
        ValueError: one id twice in a frame.

    Example:
        >>> import numpy as np
        >>> from spt_jax.keypoints import Person, find_tracks
        >>> at = lambda x, frame: Person(np.array([[x, 0.0], [x, 9.0]]), np.ones(2), "two", frame)
        >>> find_tracks([at(0, 0), at(50, 0), at(51, 1), at(1, 1)])
        [[0, 3], [1, 2]]
    """
    frames = [list(rows) for _, rows in groupby(range(len(people)), lambda k: people[k].image)]
    if all(person.id is not None for person in people):
        return _by_id(people, frames)
    tracks: list[list[int]] = []
    ends: list[int] = []  # the frame in which each was seen last
    for number, rows in enumerate(frames):
        open_ = [k for k, last in enumerate(ends) if number - last <= _LONGEST_GAP]
        costs = np.array(
            [[_apart(people[tracks[k][-1]], people[row]) for row in rows] for k in open_]
        )
        taken = _matched(costs.reshape(len(open_), len(rows)))
        for place, row in enumerate(rows):
            if place in taken:
                track = open_[taken[place]]
                tracks[track].append(row)
                ends[track] = number
            else:
                tracks.append([row])
                ends.append(number)
    return tracks


def _by_id(people: Sequence[Person], frames: list[list[int]]) -> list[list[int]]:
    tracks: dict[Hashable, list[int]] = {}
    for rows in frames:
        ids = [people[row].id for row in rows]
        for one in ids:
            if ids.count(one) > 1:
                raise ValueError(
                    f"ids must be unique within a frame: got {one!r} twice in "
                    f"{people[rows[0]].image!r}."
                )
        for row in rows:
            tracks.setdefault(people[row].id, []).append(row)
    return list(tracks.values())


def _apart(one: Person, other: Person) -> float:
    """The mean distance of the points that both have, in sizes of the first."""
    if one.layout != other.layout:
        return np.inf
    both = (one.confidence > 0) & (other.confidence > 0)
    if not both.any():
        return np.inf
    size = np.ptp(one.points[one.confidence > 0], axis=0).max()
    distance = np.linalg.norm(one.points[both] - other.points[both], axis=1).mean()
    return float(distance / max(size, 1.0))


def _matched(costs: Float[np.ndarray, "tracks people"]) -> dict[int, int]:
    """By person, the track; of those that are near enough."""
    from scipy.optimize import linear_sum_assignment

    # A finite cost in place of none, so that there is an assignment.
    tracks, people = linear_sum_assignment(np.minimum(costs, 1e3))
    pairs = zip(people.tolist(), tracks.tolist(), strict=True)
    return {person: track for person, track in pairs if costs[track, person] <= _FARTHEST}
