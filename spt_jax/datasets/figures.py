"""The figures of a motion as a row of the manifest has them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from spt_jax.metrics import MotionOverlap

VOLUME_EDGES = (0.0, 1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)
"""Where the bins of frames by overlap volume begin, in m^3, after that of frames without any."""
DEPTH_EDGES = (0.0, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)
"""Where the bins of frames by depth begin, in metres, after that of frames without any."""


def overlap_figures(overlap: MotionOverlap, when: str = "") -> dict[str, Any]:
    """Figures of the frames of a person.

    Args:
        overlap: of each frame.
        when: "_before" or "_after", appended to the names.
    """
    depth = overlap.largest_depth
    found = {
        "colliding_frames": int(np.count_nonzero(~overlap.is_free)),
        "rejected": bool(overlap.is_rejected),
        "mean_volume": _mean(overlap.volume),
        "largest_volume": float(overlap.volume.max(initial=0.0)),
        "mean_depth": _mean(depth),
        "largest_depth": float(depth.max(initial=0.0)),
        "mean_ratio": _mean(overlap.ratio),
        "largest_ratio": float(overlap.ratio.max(initial=0.0)),
        "frames_by_volume": _histogram(overlap.volume, VOLUME_EDGES),
        "frames_by_depth": _histogram(depth, DEPTH_EDGES),
    }
    return {name + when: value for name, value in found.items()}


def worst_frame(overlap: MotionOverlap) -> int:
    """The frame of the deepest overlap, the largest of these where several are as deep."""
    return int(np.lexsort((overlap.volume, overlap.largest_depth))[-1])


def file_figures(people: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The figures of a file of several people, from theirs: sums, means, maxima."""
    keys: Iterable[str] = dict.fromkeys(key for one in people for key in one)
    found: dict[str, Any] = {"people_count": len(people)}
    for key in keys:
        values: list[Any] = [one[key] for one in people if key in one]
        if key.startswith("largest_"):
            found[key] = max(values)
        elif key.startswith("mean_"):
            frames = [one["frames"] for one in people if key in one]
            found[key] = float(np.average(values, weights=frames))
        elif key.startswith("frames_by_"):
            found[key] = np.sum(values, axis=0).tolist()
        elif key.startswith("rejected"):
            found[key] = any(values)
        elif key.endswith("frames") or "_frames_" in key:
            found[key] = sum(values)
    return found


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else 0.0


def _histogram(values: np.ndarray, edges: Sequence[float]) -> list[int]:
    """How many are zero, and how many lie in each bin above."""
    above = values[values > 0]
    counts = np.histogram(above, [*edges, np.inf])[0]
    return [len(values) - len(above), *counts.tolist()]
