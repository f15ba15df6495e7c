"""Pictures of rays: what a beam meets pixel by pixel, and the counter along one ray."""

import os
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from spt_jax.show.framing import View
from spt_jax.show.look import (
    BACKGROUND,
    INK,
    LABEL_COLORS,
    PAPER,
    Picture,
    blank_figure,
    check_png,
    check_size,
    drawn,
    dress,
    finished,
    hex_color,
)
from spt_jax.show.rays import BeamCast, RayProfile, cast_beam, profile, ray_images

_COUNTS = ("#dfe6ea", "#7fb4d6", "#0072b2", "#003a5c", "#001a2b")
_LENGTHS = ("#f0b8a6", LABEL_COLORS[1], "#4d1005")
_BODY = "#d8d1c8"  # crossed, without overlap
_TRIPLE = "#7d1d0a"
_NAMES = {0: "crossing, $V_0$", 1: "crossing, $V_{out}$", -1: "crossing, $V_{in}$"}
_SAMPLES = 900  # along the depth of a cut


def plot_rays(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    *,
    view: View = "front",
    rays: int = 400,
    unit: str = "",
    size: tuple[int, int] = (820, 460),
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a picture of one beam: the crossings of every ray, and its length of overlap.

    Args:
        vertices: positions, in any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        view: where the rays come from, as in `ray_images`.
        rays: how many along the longer side of the mesh's outline.
        unit: the mesh's unit, for the labels, such as "m".
        size: (width, height) in pixels.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, an array that a notebook shows as such.

    Raises:
        ImportError: the `viz` extra is not installed.
        TypeError, ValueError: as `ray_images`; a path not ending in .png, a size too small.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> import trimesh
        >>> from spt_jax.show import plot_rays
        >>> box = trimesh.creation.box()
        >>> plot_rays(box.vertices, box.faces, rays=32, size=(320, 200)).shape
        (200, 320, 3)
    """
    check_png(path)
    check_size(size)
    images = ray_images(vertices, faces, view=view, rays=rays)
    figure, canvas = blank_figure(*size)
    figure.set_layout_engine("constrained")
    left, right = figure.subplots(1, 2)
    from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap

    most = max(int(images.crossings.max()), 2)
    # Closed meshes are crossed an even number of times: one color for each.
    edges = np.arange(1, most + 2, 2)
    shades = LinearSegmentedColormap.from_list("counts", _COUNTS)(np.linspace(0, 1, len(edges) - 1))
    counts = np.ma.masked_equal(images.crossings, 0)
    shown = left.imshow(
        counts, cmap=ListedColormap(shades), norm=BoundaryNorm(edges, len(shades)), **_STILL
    )
    step = max(1, (len(edges) - 1) // 8)
    bar = figure.colorbar(shown, ax=left, ticks=edges[:-1:step] + 1, **_BAR)
    _label(bar, "crossings of a ray")
    right.imshow(
        np.ma.masked_equal(images.crossings > 0, 0), cmap=ListedColormap([_BODY]), **_STILL
    )
    lengths = np.ma.masked_less_equal(images.overlap, 0)
    deepest = float(images.overlap.max()) or 1.0
    colors = LinearSegmentedColormap.from_list("lengths", _LENGTHS)
    shown = right.imshow(lengths, cmap=colors, vmin=0, vmax=deepest, **_STILL)
    _label(figure.colorbar(shown, ax=right, **_BAR), _with_unit("length in overlap", unit))
    for axes in (left, right):
        axes.set_facecolor(hex_color(BACKGROUND))
        axes.set(xticks=[], yticks=[])
        axes.set_adjustable("datalim")  # the background fills the panel
        axes.spines[:].set_visible(False)
    return finished(drawn(canvas), path)


_STILL: dict[str, Any] = {"interpolation": "nearest", "aspect": "equal"}
_BAR: dict[str, Any] = {"shrink": 0.85, "pad": 0.02}


def plot_ray(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    *,
    view: View = "front",
    rays: int = 1024,
    unit: str = "",
    size: tuple[int, int] = (820, 560),
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a picture of one ray: a cut through the mesh along it, and its counter below.

    Of the rays that lie in overlaps for at least half as long as any, or, where nothing overlaps,
    of those that cross most triangles, it is the one whose crossings are farthest apart. The
    counter rises where the ray enters the surface and falls where it leaves it: it is the winding
    number. Crossings are colored by their label.

    Args:
        vertices: positions, in any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        view: where the rays come from, as in `ray_images`.
        rays: how many along the longer side of the mesh's outline.
        unit: the mesh's unit, for the labels, such as "m".
        size: (width, height) in pixels.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, an array that a notebook shows as such.

    Raises:
        ImportError: the `viz` extra is not installed.
        TypeError, ValueError: as `ray_images`; a path not ending in .png, a size too small; a
            mesh that no ray crosses.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> import trimesh
        >>> from spt_jax.show import plot_ray
        >>> box = trimesh.creation.box()
        >>> plot_ray(box.vertices, box.faces, rays=32, size=(320, 280)).shape
        (280, 320, 3)
    """
    check_png(path)
    check_size(size)
    found = cast_beam(vertices, faces, view, rays)
    if not len(found.crossings.ray):
        raise ValueError("the mesh must be crossed by a ray: got none; raise rays.")
    ray = _telling_ray(found)
    along = profile(found, ray)

    figure, canvas = blank_figure(*size)
    figure.set_layout_engine("constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1))
    _draw_cut(above, found, ray, along, (size[1] * 0.5) / (size[0] * 0.88))
    _draw_counter(below, along)
    below.set_xlabel(_with_unit("depth along the ray", unit))
    return finished(drawn(canvas), path)


def _telling_ray(found: BeamCast) -> int:
    ray = found.crossings.ray
    if found.overlap.any():
        telling = found.overlap >= found.overlap.max() / 2
    else:
        count = np.bincount(ray, minlength=found.beam.num_rays)
        telling = count == count.max()
    chosen = np.flatnonzero(telling[ray])
    depth, of_ray = found.depths(chosen), ray[chosen]
    gaps = np.where(of_ray[1:] == of_ray[:-1], np.diff(depth), np.inf)
    narrowest = np.full(found.beam.num_rays, np.inf)
    np.minimum.at(narrowest, of_ray[1:], gaps)
    rays = np.unique(of_ray)
    return int(rays[np.argmax(narrowest[rays])])


def _draw_cut(axes: Any, found: BeamCast, ray: int, along: RayProfile, aspect: float) -> None:
    from matplotlib.colors import BoundaryNorm, ListedColormap

    row, column = (int(index[0]) for index in found.beam.locate(np.array([ray])))
    rows, columns = found.beam.locate(found.crossings.ray)
    chosen = np.flatnonzero(rows == row)
    depth = found.depths(chosen)
    low, high = depth.min(), depth.max()
    pad = 0.06 * (high - low)
    low, high = low - pad, high + pad
    place = np.ceil((depth - low) / (high - low) * _SAMPLES).astype(np.int64)
    steps = np.zeros((found.beam.shape[1], _SAMPLES + 1), np.int64)
    np.add.at(steps, (columns[chosen], place), found.crossings.sign[chosen])
    winding = np.cumsum(steps, axis=1)[:, :-1]
    pixel = found.beam.pixel[0]
    colors = [LABEL_COLORS[-1], hex_color(BACKGROUND), LABEL_COLORS[0], LABEL_COLORS[1], _TRIPLE]
    axes.imshow(
        winding,
        cmap=ListedColormap(colors),
        norm=BoundaryNorm([-99, -0.5, 0.5, 1.5, 2.5, 99], len(colors)),
        extent=(low, high, (len(winding) - column - 0.5) * pixel, (-column - 0.5) * pixel),
        interpolation="nearest",
        aspect="auto",
    )
    half = aspect * (high - low) / 2  # one scale on both axes
    axes.set(xlim=(low, high), ylim=(-half, half), yticks=[])
    axes.spines[:].set_visible(False)
    axes.tick_params(bottom=False, labelbottom=False)
    axes.set_facecolor(hex_color(BACKGROUND))
    axes.axhline(0.0, color=INK, linewidth=1.6)
    axes.annotate(
        "", (high, 0), (high - pad / 2, 0), arrowprops={"arrowstyle": "-|>", "color": INK}
    )
    _draw_crossings(axes, along.depth, np.zeros(len(along.depth)), along.label)
    from matplotlib.patches import Patch

    levels = {
        -1: ("inside out", 0),
        0: None,
        1: ("inside once", 2),
        2: ("overlap: inside twice", 3),
    }
    seen = {int(w) for w in np.unique(np.clip(winding, -1, 3))}
    levels[3] = ("more than twice", 4)
    handles = [
        Patch(facecolor=colors[entry[1]], label=entry[0])
        for level, entry in levels.items()
        if entry is not None and level in seen
    ]
    axes.legend(handles=handles, loc="upper right", **_LEGEND)


def _draw_counter(axes: Any, along: RayProfile) -> None:
    dress(axes)
    low, high = axes.get_xlim()
    x = np.concatenate([[low], along.depth, [high]])
    counter = np.concatenate([[0], along.counter, [0]])
    twice, inverted = np.maximum(counter, 1), np.minimum(counter, 0)
    axes.fill_between(x, 1, twice, step="post", color=LABEL_COLORS[1], alpha=0.35, linewidth=0)
    axes.fill_between(x, 0, inverted, step="post", color=LABEL_COLORS[-1], alpha=0.35, linewidth=0)
    axes.step(x, counter, where="post", color=INK, linewidth=1.8)
    before = counter[:-2]
    _draw_crossings(axes, along.depth, (before + along.counter) / 2, along.label)
    lowest, highest = min(int(counter.min()), 0), max(int(counter.max()), 1)
    axes.set(ylim=(lowest - 0.35, highest + 0.5), yticks=np.arange(lowest, highest + 1))
    axes.set_ylabel("counter = winding number")
    axes.legend(loc="upper right", ncols=3, **_LEGEND)


def _draw_crossings(axes: Any, x: Any, y: Any, labels: Int[np.ndarray, "N"]) -> None:
    for sign in (0, 1, -1):
        chosen = labels == sign
        if chosen.any():
            style = {"facecolor": LABEL_COLORS[sign] if sign else PAPER, "edgecolor": INK, "s": 52}
            axes.scatter(x[chosen], y[chosen], zorder=4, label=_NAMES[sign], **style)


_LEGEND: dict[str, Any] = {"labelcolor": INK, "framealpha": 0.9, "edgecolor": "none"}


def _label(bar: Any, text: str) -> None:
    bar.set_label(text, color=INK)
    bar.ax.tick_params(colors=INK)
    bar.outline.set_visible(False)
    bar.minorticks_off()


def _with_unit(text: str, unit: str) -> str:
    return f"{text}, {unit}" if unit else text
