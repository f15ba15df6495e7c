"""What papers and public filters report: of motions per frame and of the whole, between meshes."""

import csv
import os
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax._between_meshes import BetweenMeshes as BetweenMeshes
from spt_jax._between_meshes import between_meshes as between_meshes
from spt_jax._exclusions import as_exclusions
from spt_jax._query import as_mesh
from spt_jax._result import Result, plain
from spt_jax.bridge.on_host import Work, measured
from spt_jax.files.outputs import atomic_write
from spt_jax.overlap.depth import penetration_depths
from spt_jax.overlap.exclusions import Exclusions
from spt_jax.overlap.measure import Sampling, Unmeasurable, measure
from spt_jax.rest.surface import RestSurface

__all__ = [
    "BetweenMeshes",
    "MotionOverlap",
    "between_meshes",
    "motion_overlap",
    "rejected",
    "write_csv",
]

# The rule by which ProtoMotions leaves motions out: one frame this deep, or more than so many this
# deep, in metres.
TOO_DEEP, DEEP, MOST_DEEP_FRAMES = 0.05, 0.03, 10


class MotionOverlap(Result):
    """How much of a surface is in self-intersection, frame by frame.

    Attributes:
        volume: of each frame, the included overlap volume, in the cube of the unit.
        ratio: the fraction of the vertices in included overlaps (paper, Eq. 11).
        intersecting_pairs: the number of face pairs that intersect and count.
        largest_depth: how far the deepest vertex lies inside another part, in the unit; parts that
            fold there are excluded, also where the region continues into a collision.
        mean_depth: the mean of that over all vertices inside another part; 0 without any.

    Example:
        >>> import numpy as np
        >>> from spt_jax.metrics import MotionOverlap
        >>> deep = np.array([0.0, 0.02, 0.06])
        >>> overlap = MotionOverlap(deep**2, deep, np.array([0, 5, 9]), deep, deep / 2)
        >>> overlap.is_free.tolist(), overlap.is_rejected
        ([True, False, False], True)
    """

    volume: Float[np.ndarray, "T"]
    ratio: Float[np.ndarray, "T"]
    intersecting_pairs: Int[np.ndarray, "T"]
    largest_depth: Float[np.ndarray, "T"]
    mean_depth: Float[np.ndarray, "T"]

    @property
    def is_free(self) -> Bool[np.ndarray, "T"]:
        """Of each frame, whether nothing intersects or overlaps, apart from what is excluded."""
        return (self.intersecting_pairs == 0) & ~(self.volume > 0)

    @property
    def is_rejected(self) -> bool:
        """Whether a public filter of motions would leave this one out.

        One frame deeper than 5 cm, or more than 10 frames deeper than 3 cm: the rule of
        ProtoMotions (https://github.com/NVlabs/ProtoMotions), for a mesh in metres.
        """
        return rejected(self.largest_depth)

    def at(self, frames: Int[np.ndarray, "N"]) -> "MotionOverlap":
        """The figures of some frames."""
        return MotionOverlap(*(column[frames] for column in self.columns()))

    def with_frames(self, frames: Int[np.ndarray, "N"], other: "MotionOverlap") -> "MotionOverlap":
        """These figures, those of some frames replaced by other ones."""
        columns = [column.copy() for column in self.columns()]
        for column, found in zip(columns, other.columns(), strict=True):
            column[frames] = found
        return MotionOverlap(*columns)

    def without_overlap(self) -> "MotionOverlap":
        """As many frames in which nothing overlaps."""
        return MotionOverlap(*(np.zeros_like(column) for column in self.columns()))

    def columns(self) -> tuple[np.ndarray, ...]:
        """All figures, in the order of the attributes."""
        return (
            self.volume,
            self.ratio,
            self.intersecting_pairs,
            self.largest_depth,
            self.mean_depth,
        )

    def as_dict(self) -> dict[str, Any]:
        """Figures of the whole, and lists over the frames, as JSON types."""
        return {
            "frames": len(self.volume),
            "colliding_frames": int(np.count_nonzero(~self.is_free)),
            "is_rejected": self.is_rejected,
            "largest_volume": float(self.volume.max(initial=0.0)),
            "largest_depth": float(self.largest_depth.max(initial=0.0)),
            "per_frame": {
                "is_free": plain(self.is_free),
                "volume": plain(self.volume),
                "ratio": plain(self.ratio),
                "intersecting_pairs": plain(self.intersecting_pairs),
                "largest_depth": plain(self.largest_depth),
                "mean_depth": plain(self.mean_depth),
            },
        }


def rejected(
    largest_depth: Float[np.ndarray, "T"],
    *,
    too_deep: float = TOO_DEEP,
    deep: float = DEEP,
    most_deep_frames: int = MOST_DEEP_FRAMES,
) -> bool:
    """Whether a filter leaves a motion out: deeper than this once, or than that too often.

    Args:
        largest_depth: of each frame, in metres.
        too_deep: no frame may be deeper, in metres.
        deep: only so many frames may be deeper than this, in metres.
        most_deep_frames: so many.

    Returns:
        Whether the motion would be left out.

    Example:
        >>> import numpy as np
        >>> from spt_jax.metrics import rejected
        >>> rejected(np.full(10, 0.04)), rejected(np.full(11, 0.04))
        (False, True)
    """
    depth = np.asarray(largest_depth)
    often = int(np.count_nonzero(depth > deep)) > most_deep_frames
    return bool((depth > too_deep).any()) or often


def motion_overlap(
    vertices: Float[Array, "T V 3"] | np.ndarray,
    faces: Int[Array, "F 3"] | np.ndarray,
    *,
    face_groups: Int[Array, "F"] | np.ndarray | None = None,
    ignore_groups: Any = (),
    rest_surface: RestSurface | None = None,
) -> MotionOverlap:
    """How much of a moving surface is in self-intersection, frame by frame, and how deep.

    The depth of a vertex inside another part is its distance to the nearest triangle of the
    surface that does not belong to the connected patch of vertices inside which it is in. It is
    measured at the vertices: parts that intersect with no vertex inside have a depth of zero.

    Args:
        vertices: positions in each frame, in any unit; the public criterion takes it for metres.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        face_groups, ignore_groups, rest_surface: what is excluded, as in
            `self_intersection_penalty`.

    Returns:
        The figures of each frame; `spt_jax.config.processes` says how many others share the work.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`, and ValueError for a frame in which
            there is no surface that could be measured.

    Differentiation: none; for use outside jit.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax.metrics import motion_overlap
        >>> box, ball = trimesh.creation.box(), trimesh.creation.icosphere(radius=0.3)
        >>> pair = trimesh.util.concatenate(box, ball)
        >>> moving = np.repeat(pair.vertices[None], 2, axis=0)
        >>> moving[1, 8:, 0] += 2.0  # the ball has left the box
        >>> overlap = motion_overlap(moving, pair.faces)
        >>> overlap.is_free.tolist(), overlap.largest_depth.round(2).tolist()
        ([False, True], [0.31, 0.0])
    """
    checked, triangles = as_mesh(vertices, faces)
    if checked.ndim != 3:
        raise ValueError(f"vertices must have shape (frames, V, 3): got {tuple(checked.shape)}.")
    exclusions = as_exclusions(face_groups, ignore_groups, rest_surface, triangles)
    # As they are given: without 64 bits JAX would round them.
    return measured_frames(np.asarray(vertices), np.asarray(triangles), exclusions)


def write_csv(
    path: str | os.PathLike[str], overlap: MotionOverlap, frames_per_second: float | None = None
) -> None:
    """Write the figures of each frame as a table that spreadsheets and pandas read.

    Args:
        path: of the file, which appears whole or not at all.
        overlap: the figures.
        frames_per_second: with it there is a column of the time, in seconds.

    Raises:
        OSError: it cannot be written.
        ValueError: a rate that is not positive.

    Example:
        >>> import numpy as np, pathlib, tempfile
        >>> from spt_jax.metrics import MotionOverlap, write_csv
        >>> deep = np.array([0.0, 0.02])
        >>> overlap = MotionOverlap(deep**2, deep, np.array([0, 5]), deep, deep / 2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_csv(pathlib.Path(folder) / "motion.csv", overlap)
        ...     print((pathlib.Path(folder) / "motion.csv").read_text())
        frame,is_free,volume,ratio,intersecting_pairs,largest_depth,mean_depth
        0,True,0.0,0.0,0,0.0,0.0
        1,False,0.0004,0.02,5,0.02,0.01
        <BLANKLINE>
    """
    if frames_per_second is not None and not 0 < frames_per_second < np.inf:
        raise ValueError(f"frames_per_second must be positive: got {frames_per_second!r}.")
    columns: dict[str, list[Any]] = {"frame": list(range(len(overlap.volume)))}
    if frames_per_second is not None:
        columns["time"] = [frame / frames_per_second for frame in columns["frame"]]
    columns |= overlap.as_dict()["per_frame"]
    with atomic_write(path) as temporary, open(temporary, "w", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))


class _Options(NamedTuple):
    exclusions: Exclusions
    rounding: float
    depth: bool


def measured_frames(
    vertices: Float[np.ndarray, "T V 3"],
    faces: Int[np.ndarray, "F 3"],
    exclusions: Exclusions,
    *,
    depth: bool = True,
) -> MotionOverlap:
    """`motion_overlap` of arrays that are known to fit each other.

    Args:
        vertices, faces, exclusions: as there.
        depth: whether ratio and depths are asked for; otherwise they are zero.

    Raises:
        ValueError: as there.
    """
    options = _Options(exclusions, float(np.finfo(vertices.dtype).eps), depth)
    work = Work(_figures_on_host, options, (((5,), "float64"),))
    (figures,) = measured(work, vertices, faces[None])
    wrong = np.flatnonzero(np.isnan(figures).any(axis=1))
    if len(wrong):
        raise ValueError(
            f"every frame must have a surface that can be measured: got none in {len(wrong)} of "
            f"{len(vertices)}, frame {wrong[0]} the first; leave such frames out."
        )
    volume, ratio, pairs, largest, mean = figures.T
    return MotionOverlap(volume, ratio, pairs.astype(np.int64), largest, mean)


def _figures_on_host(vertices, faces, options: _Options):
    """Volume, ratio, pairs, largest and mean depth; NaN where nothing can be measured."""
    points, corners = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    sampling = Sampling(None, ((0.0, 0.0, 1.0),))
    try:
        found = measure(points, corners, sampling, options.exclusions, options.rounding)
        volume, pairs = found.volume, found.intersecting_pairs
        if not options.depth or (not pairs and not volume > 0):
            return (np.array([volume, 0.0, pairs, 0.0, 0.0]),)
        inside = found.labels("vertex") != 0
    except Unmeasurable:
        return (np.full(5, np.nan),)
    depth = _depths(points, corners, inside, options.exclusions.rest)
    largest, mean = (depth.max(), depth.mean()) if len(depth) else (0.0, 0.0)
    return (np.array([volume, inside.mean(), pairs, largest, mean]),)


def _depths(points, corners, inside, rest: RestSurface | None):
    """How deep the vertices lie inside parts that are no folds of their own one."""
    depth, nearest = penetration_depths(points, corners, inside)
    at = np.flatnonzero(nearest >= 0)
    if rest is not None and len(at):
        beside = np.empty(len(points), np.int64)
        beside[corners.reshape(-1)] = np.repeat(np.arange(len(corners)), 3)
        at = at[~rest.near(beside[at], nearest[at])]
    return depth[at]
