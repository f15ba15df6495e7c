"""Keypoints drawn over a picture: dots where they were seen, rings where a body has them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from spt_jax.keypoints.layout import Layout, edge_side, side
from spt_jax.keypoints.layouts import as_layout
from spt_jax.show.look import CURVES, INK, PAPER, blank_figure, drawn

# Okabe and Ito's blue and orange, which every kind of color vision can distinguish.
_SIDES = {"left": CURVES[1], "right": CURVES[4], "middle": INK}
_FAINTEST = 0.45  # of a point of confidence 0.01; one of 1 is opaque


class StickFigure(NamedTuple):
    """One person's keypoints, where the body has them, and what they are."""

    points: Float[np.ndarray, "K 2"]
    confidence: Float[np.ndarray, "K"]
    fitted: Float[np.ndarray, "K 2"] | None
    layout: Layout | None


def as_figures(keypoints: Any, confidence: Any, fitted: Any, skeleton: Any) -> list[StickFigure]:
    """One figure a person of what `render_overlay` was given; none without keypoints.

    Raises:
        ValueError: numbers of people, keypoints or confidences that do not match.
        TypeError: a skeleton that is no layout.
    """
    if keypoints is None:
        for name, value in (("confidence", confidence), ("fitted", fitted)):
            if value is not None:
                raise ValueError(f"{name} must come with keypoints: got it without.")
        return []
    # Rows of two numbers are one person; rows of such rows are several.
    alone = len(keypoints) > 0 and np.ndim(keypoints[0]) == 1
    count = 1 if alone else len(keypoints)

    def each(name: str, value: Any) -> list[Any]:
        rows = [None] * count if value is None else [value] if alone else list(value)
        if len(rows) != count:
            raise ValueError(f"{name} must be of {count} people, as keypoints: got {len(rows)}.")
        return rows

    if skeleton is None or isinstance(skeleton, (str, Layout)):
        skeleton = [skeleton] * count
    layouts = list(skeleton)
    if len(layouts) != count:
        raise ValueError(f"skeleton must be one, or of {count} people: got {len(layouts)}.")
    columns = (each("keypoints", keypoints), each("confidence", confidence), each("fitted", fitted))
    return [_as_figure(*row) for row in zip(*columns, layouts, strict=True)]


def _as_figure(keypoints: Any, confidence: Any, fitted: Any, layout: Any) -> StickFigure:
    points = np.asarray(keypoints, np.float64)
    trust = np.ones(points.shape[:1]) if confidence is None else np.asarray(confidence, np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or trust.shape != points.shape[:1]:
        raise ValueError(
            "keypoints must be (K, 2) pixels with confidence (K,), for each person: got "
            f"{points.shape} and {trust.shape}."
        )
    found = None if fitted is None else np.asarray(fitted, np.float64)
    if found is not None and found.shape != points.shape:
        raise ValueError(f"fitted must be like keypoints, {points.shape}: got {found.shape}.")
    if layout is not None:
        layout = layout if isinstance(layout, Layout) else as_layout(layout, len(points))
        if len(layout.names) != len(points):
            raise ValueError(
                f"skeleton must have {len(points)} keypoints: got {layout.name}, which has "
                f"{len(layout.names)}."
            )
    # What is not seen may be NaN.
    trust = np.where(np.isfinite(points).all(axis=1), np.clip(np.nan_to_num(trust), 0, 1), 0)
    return StickFigure(points, trust, found, layout)


def draw_figures(
    picture: UInt8[np.ndarray, "height width 3"], figures: Sequence[StickFigure]
) -> UInt8[np.ndarray, "height width 3"]:
    """Return the picture with the figures drawn over it.

    Raises:
        ImportError: the `viz` extra is not installed.
    """
    height, width = picture.shape[:2]
    figure, canvas = blank_figure(width, height)
    figure.figimage(picture)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(zorder=1)  # over the picture, which is drawn last of what has one zorder
    axes.set_axis_off()
    # Coordinates count from the corner of the first pixel, as the camera's do.
    axes.set(xlim=(0, width), ylim=(height, 0))
    for person in figures:
        _draw(axes, person, _dot_radius(person, max(width, height)))
    return drawn(canvas)


def _dot_radius(person: StickFigure, side_length: int) -> float:
    """In pixels: in proportion to the person, and to be seen where the picture is made small."""
    seen = person.points[person.confidence > 0]
    extent = np.ptp(seen, axis=0).max() if len(seen) else 0.0
    return float(max(np.clip(extent / 75, side_length / 240, side_length / 130), 2.0))


def _draw(axes: Any, person: StickFigure, radius: float) -> None:
    points, trust, fitted, layout = person
    unit = radius * 72 / axes.figure.dpi  # matplotlib counts widths in points of type
    seen = trust > 0
    colors = [_SIDES[side(name)] for name in layout.names] if layout else [INK] * len(points)
    strength = _FAINTEST + (1 - _FAINTEST) * trust
    # For each line its two keypoints and its side.
    lines = [(*edge, edge_side(layout, edge)) for edge in layout.edges] if layout else []
    for a, b, where in lines:
        if seen[a] and seen[b]:
            line = {"alpha": min(strength[a], strength[b]), "solid_capstyle": "round", "zorder": 2}
            x, y = points[[a, b]].T
            axes.plot(x, y, color=PAPER, linewidth=1.3 * unit, **line)
            axes.plot(x, y, color=_SIDES[where], linewidth=0.75 * unit, **line)
    for k in np.flatnonzero(seen):
        _circle(axes, points[k], radius, 0.35 * unit, PAPER, facecolor=colors[k], alpha=strength[k])
    if fitted is None:
        return
    for k in np.flatnonzero(np.isfinite(fitted).all(axis=1)):
        size = radius * (1.7 if seen[k] else 1.1)
        way = points[k] - fitted[k]
        length = np.hypot(*way)
        if seen[k] and length > size:
            x, y = np.stack([points[k], fitted[k] + way * (size / length)]).T
            axes.plot(x, y, color=INK, linewidth=0.35 * unit, zorder=3)
        # A light ring under the dark one: to be seen on dark clothes too.
        _circle(axes, fitted[k], size, 0.7 * unit, PAPER, fill=False, alpha=0.7)
        _circle(axes, fitted[k], size, 0.3 * unit, INK, fill=False)


def _circle(
    axes: Any, center: np.ndarray, radius: float, width: float, edge: str, **style: Any
) -> None:
    # Not matplotlib's markers, which it moves to whole pixels.
    from matplotlib.patches import Circle

    axes.add_patch(
        Circle((center[0], center[1]), radius, linewidth=width, edgecolor=edge, zorder=4, **style)
    )
