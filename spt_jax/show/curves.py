"""Named curves in one plot: convergence, sweeps, values along a line."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from spt_jax.show.look import CURVES, INK, Picture, blank_figure, check_png, drawn, dress, finished

# Past the colors, curves differ by their dashes.
_DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)))


def plot_curves(
    series: Mapping[str, Any],
    *,
    xlabel: str,
    ylabel: str,
    log: bool = False,
    title: str | None = None,
    size: tuple[int, int] = (720, 440),
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a plot of named curves, each labelled in its legend.

    Args:
        series: by name, either values (N,), drawn over 0, 1, 2, ..., or points (N, 2) of x and y.
        xlabel: what the horizontal axis counts, with its unit.
        ylabel: what the vertical axis measures, with its unit.
        log: a logarithmic vertical axis; values that are not positive leave gaps.
        title: a short line above it.
        size: (width, height) in pixels.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, an array that a notebook shows as such.

    Raises:
        ImportError: the `viz` extra is not installed.
        ValueError: no curves, a shape other than these, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> from spt_jax.show import plot_curves
        >>> falling = {"BFGS": [1.0, 1e-2, 1e-6], "gradient descent": [1.0, 0.5, 0.3]}
        >>> plot_curves(falling, xlabel="step", ylabel="volume, cm^3", log=True).shape
        (440, 720, 3)
    """
    check_png(path)
    curves = {name: np.asarray(values, np.float64) for name, values in series.items()}
    if not curves:
        raise ValueError("series must hold at least one curve: got none")
    for name, values in curves.items():
        if values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] != 2):
            raise ValueError(
                f"series must hold (N,) or (N, 2) arrays: got {values.shape} in {name!r}"
            )
    figure, canvas = blank_figure(*size)
    figure.set_layout_engine("constrained")
    axes = figure.add_subplot()
    dress(axes)
    seen = 0
    for index, (name, values) in enumerate(curves.items()):
        x, y = (np.arange(len(values)), values) if values.ndim == 1 else values.T
        y = np.where(y > 0, y, np.nan) if log else y
        style = {
            "color": CURVES[index % len(CURVES)],
            "linestyle": _DASHES[index // len(CURVES) % len(_DASHES)],
            "marker": "o" if len(y) < 30 else None,
        }
        axes.plot(x, y, label=name, linewidth=2, markersize=4, **style)
        seen += int(np.isfinite(y).sum())
    if log and seen:  # matplotlib warns of a logarithmic axis without a positive value
        axes.set_yscale("log")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    if title is not None:
        axes.set_title(title, color=INK, fontsize=11, parse_math=False)
    axes.legend(frameon=False, labelcolor=INK)
    return finished(drawn(canvas), path)
