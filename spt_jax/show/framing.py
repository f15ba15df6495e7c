"""Where the camera of a picture stands, and how much it sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

View = str | tuple[float, float]
"""A name of `NAMED_VIEWS`, "auto", or (azimuth, elevation) in degrees.

Azimuth 0 looks at the body's front and 90 at its left side; elevation lifts the camera.
"""

NAMED_VIEWS: dict[str, tuple[float, float]] = {
    "front": (0.0, 6.0),
    "left": (90.0, 6.0),
    "back": (180.0, 6.0),
    "right": (-90.0, 6.0),
    "top": (0.0, 89.0),
}
_AZIMUTHS = (0.0, 45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_AUTO_ELEVATION = 10.0
_MARGIN = 1.08


@dataclass(frozen=True)
class Framing:
    """A parallel camera: what it looks at, from where, and half the height that it sees."""

    axes: Float[np.ndarray, "3 3"]
    """Rows: right, up and towards the camera."""
    target: Float[np.ndarray, "3"]
    half_height: float
    depth: float
    """Half the extent of the scene along the line of sight."""


def view_axes(azimuth: float, elevation: float) -> Float[np.ndarray, "3 3"]:
    """Return the camera's right, up and backward directions as rows; angles in degrees.

    The world has x to the body's left, y up and z forward.
    """
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    backward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    return np.stack([right, np.cross(backward, right), backward])


def frame(
    meshes: Sequence[np.ndarray],
    faces: Int[np.ndarray, "F 3"],
    labels: Sequence[np.ndarray],
    view: View,
    aspect: float,
) -> Framing:
    """Return the one camera from which all meshes are seen whole.

    Args:
        meshes: vertices (V, 3) of each mesh to be drawn with this camera.
        faces: their triangles.
        labels: per vertex (V,), which "auto" turns the camera to.
        view: see `View`.
        aspect: the picture's width over its height.

    Raises:
        ValueError: an unknown view.
    """
    if view == "auto":
        angles = (_best_azimuth(meshes, faces, labels), _AUTO_ELEVATION)
    elif isinstance(view, str):
        if view not in NAMED_VIEWS:
            raise ValueError(
                f'view must be "auto", {", ".join(map(repr, NAMED_VIEWS))} or (azimuth, elevation) '
                f"in degrees: got {view!r}"
            )
        angles = NAMED_VIEWS[view]
    else:
        if not np.isfinite(view).all():
            raise ValueError(f"view must hold two finite angles in degrees: got {view!r}")
        angles = view
    axes = view_axes(*angles)
    seen = np.concatenate(meshes) @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    half_width, half_height, depth = (high - low) / 2
    half = _MARGIN * max(half_height, half_width / aspect)
    # A mesh of one point would make a camera that sees nothing.
    return Framing(axes, (low + high) / 2 @ axes, max(half, 1e-9), max(depth, 1e-9))


def marked_triangles(
    labels: Int[np.ndarray, "V"], faces: Int[np.ndarray, "F 3"]
) -> Bool[np.ndarray, "F"]:
    """The triangles to color: all corners labelled, or one that no such triangle shows.

    The triangle rule labels every corner of a crossed triangle; coloring each triangle with one
    labelled corner would add another ring around what is already the outermost.
    """
    labelled = labels != 0
    whole = labelled[faces].all(axis=1)
    lonely = labelled.copy()
    lonely[faces[whole]] = False
    return whole | lonely[faces].any(axis=1)


def _best_azimuth(
    meshes: Sequence[np.ndarray], faces: Int[np.ndarray, "F 3"], labels: Sequence[np.ndarray]
) -> float:
    # The azimuth at which the most labelled area lies at, or just behind, the nearest surface. A
    # picture element's nearest centroid stands for the surface: no rendering is needed. Ties, and
    # gains under a third, go to the direction nearer the front.
    scores = np.zeros(len(_AZIMUTHS))
    for vertices, label in zip(meshes, labels, strict=True):
        marked = marked_triangles(label, faces)
        if not marked.any():
            continue
        corners = vertices[faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        centroids = corners.mean(axis=1)
        size = np.ptp(vertices, axis=0).max() or 1.0
        # Several triangles a cell, or the far side would be seen between the near ones.
        cells = int(np.clip(np.sqrt(len(faces)) / 2, 4, 48))
        for index, azimuth in enumerate(_AZIMUTHS):
            axes = view_axes(azimuth, _AUTO_ELEVATION)
            x, y, depth = (centroids @ axes.T).T
            column = np.floor((x - x.min()) / size * cells).astype(np.int64)
            row = np.floor((y - y.min()) / size * cells).astype(np.int64)
            pixel = row * 4 * cells + column
            nearest = np.full(pixel.max() + 1, -np.inf)
            np.maximum.at(nearest, pixel, depth)
            shown = marked & (depth > nearest[pixel] - 0.04 * size)
            scores[index] += np.abs(area[shown] @ axes[2]).sum()
    best = scores.max()
    return _AZIMUTHS[int(np.argmax(scores >= 0.75 * best))] if best > 0 else 0.0
