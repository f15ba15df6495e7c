"""Pictures of meshes and of their intersections, drawn without a display."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int, UInt8

from spt_jax.mesh_files import as_mesh_arrays
from spt_jax.output_files import atomic_write
from spt_jax.show.framing import View, frame
from spt_jax.show.offscreen import import_extra
from spt_jax.show.panel import draw_panel, panel_plotter

Picture = UInt8[np.ndarray, "height width 3"]
Points = Float[Array | np.ndarray, "..."]
Labels = Int[Array | np.ndarray, "..."]

_INK = "#3b3733"
_GAP = 6
_TITLE_HEIGHT = 34
_CURVES = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#3b3733")


def render_mesh(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    labels: Int[Array | np.ndarray, " V"] | None = None,
    *,
    size: tuple[int, int] = (480, 600),
    view: View = "front",
    title: str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a picture of one mesh, with its labelled triangles seen through the rest.

    A triangle is coloured when all of its vertices are labelled, or one that would otherwise not be
    seen: V_out (+1) vermillion, before V_in (-1) blue. Overlapping parts hide each other, so
    coloured triangles are drawn a second time over the finished picture: what lies inside the body
    shows as a fainter spot.

    Args:
        vertices: positions, in any unit; the picture is fitted to them.
        faces: vertex indices, counter-clockwise seen from outside.
        labels: 0, +1 or -1 for each vertex, as `classify_vertices` gives them.
        size: (width, height) of the mesh's panel in pixels; a title adds to the height.
        view: "front", "left", "back", "right", "top", (azimuth, elevation) in degrees, or "auto":
            of eight azimuths the one from which the most labelled area is near the surface.
        title: a short line above it.
        path: a .png file to write as well, atomically.

    Raises:
        ImportError: the `viz` extra is not installed.
        RenderingUnavailable: this machine cannot draw off screen.
        ValueError: arrays that do not make a mesh, an unknown view, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.
    """
    titles = None if title is None else [title]
    return render_strip([vertices], faces, [labels], titles, view=view, size=size, path=path)


def render_before_after(
    before: Points | Sequence[Points],
    after: Points | Sequence[Points],
    faces: Int[Array | np.ndarray, "F 3"],
    labels_before: Labels | Sequence[Labels | None] | None = None,
    labels_after: Labels | Sequence[Labels | None] | None = None,
    *,
    titles: tuple[str, str] = ("before", "after"),
    size: tuple[int, int] = (480, 600),
    view: View = "auto",
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return pairs of meshes side by side, each pair seen by one camera fitted on both.

    Args:
        before: vertices (V, 3), or a sequence of them, one row of the picture each.
        after: as many.
        faces: vertex indices, the same for all.
        labels_before: labels (V,) as in `render_mesh`, or a sequence of them.
        labels_after: likewise.
        titles: what stands above the two columns.
        size: (width, height) of one panel in pixels.
        view: as in `render_mesh`.
        path: as in `render_mesh`.

    Raises:
        ImportError, RenderingUnavailable, ValueError, OSError: as `render_mesh` does, and
            ValueError for lists of different lengths.
    """
    columns = []
    for meshes, labels in ((before, labels_before), (after, labels_after)):
        if hasattr(meshes, "ndim"):
            meshes, labels = [meshes], [labels]
        columns.append((list(meshes), [None] * len(meshes) if labels is None else list(labels)))
    lengths = [len(entries) for column in columns for entries in column]
    if len(set(lengths)) != 1:
        raise ValueError(
            "before, after and their labels must be of one length: got "
            f"{lengths[0]}, {lengths[2]}, {lengths[1]}, {lengths[3]}"
        )
    rows = list(zip(columns[0][0], columns[1][0], strict=True))
    labels = list(zip(columns[0][1], columns[1][1], strict=True))
    return render_strip(rows, faces, labels, titles, size=size, view=view, path=path)


def render_strip(
    meshes: Sequence[Points] | Sequence[Sequence[Points]],
    faces: Int[Array | np.ndarray, "F 3"],
    labels: Sequence[Any] | None = None,
    titles: Sequence[str] | None = None,
    *,
    row_titles: Sequence[str] | None = None,
    size: tuple[int, int] = (300, 380),
    view: View = "auto",
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a row of meshes, or rows of them, as the paper's Figures 5 to 7; one camera a row.

    Args:
        meshes: vertices (V, 3) of each panel from left to right, or a sequence of such rows.
        faces: vertex indices, the same for all.
        labels: nested like `meshes`, with labels (V,) or None for each panel.
        titles: one for each column.
        row_titles: one for each row, within its first panel.
        size: (width, height) of one panel in pixels.
        view: as in `render_mesh`; "auto" decides for each row.
        path: as in `render_mesh`.

    Raises:
        ImportError, RenderingUnavailable, ValueError, OSError: as `render_mesh` does, and
            ValueError where meshes, labels and titles do not match.
    """
    _check_png(path)
    if min(size) < 16:
        raise ValueError(f"size must be at least 16 by 16 pixels: got {size}")
    if not len(meshes):
        raise ValueError("meshes must hold at least one mesh: got none")
    if hasattr(meshes[0], "ndim"):
        meshes, labels = [meshes], None if labels is None else [labels]  # type: ignore
    if labels is None:
        labels = [[None] * len(row) for row in meshes]
    if [len(row) for row in meshes] != [len(row) for row in labels]:
        raise ValueError(
            f"labels must be nested like meshes: got rows of {[len(row) for row in labels]} for "
            f"rows of {[len(row) for row in meshes]}"
        )
    rows = [
        [as_mesh_arrays(*panel) for panel in zip(row, [faces] * len(row), classes, strict=True)]
        for row, classes in zip(meshes, labels, strict=True)
    ]
    columns = max(len(row) for row in rows)
    for name, entries, count in (
        ("titles", titles, columns),
        ("row_titles", row_titles, len(rows)),
    ):
        if entries is not None and len(entries) != count:
            raise ValueError(f"{name} must hold {count} strings: got {len(entries)}")

    width, height = size
    top = _TITLE_HEIGHT if titles is not None else 0
    canvas = np.full(
        (top + len(rows) * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3),
        255,
        np.uint8,
    )
    texts = [
        (index * (width + _GAP) + width / 2, top / 2 + 1, text, "center")
        for index, text in enumerate(titles or ())
    ]
    with panel_plotter(width, height) as plotter:
        for i, row in enumerate(rows):
            y = top + i * (height + _GAP)
            camera = frame(
                [p[0] for p in row], row[0][1], [p[2] for p in row], view, width / height
            )
            for j, panel in enumerate(row):
                x = j * (width + _GAP)
                canvas[y : y + height, x : x + width] = draw_panel(plotter, *panel, camera)
            if row_titles is not None:
                texts.append((12, y + 18, row_titles[i], "left"))
    picture = _write_texts(canvas, texts) if texts else canvas
    _save_png(picture, path)
    return picture


def plot_curves(
    series: Mapping[str, Any],
    *,
    xlabel: str,
    ylabel: str,
    log: bool = False,
    size: tuple[int, int] = (720, 440),
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a plot of named curves, each labelled in its legend.

    Args:
        series: by name, either values (N,), drawn over 0, 1, 2, ..., or points (N, 2) of x and y.
        xlabel: what the horizontal axis counts, with its unit.
        ylabel: what the vertical axis measures, with its unit.
        log: a logarithmic vertical axis; values that are not positive leave gaps.
        size: (width, height) in pixels.
        path: a .png file to write as well, atomically.

    Raises:
        ImportError: the `viz` extra is not installed.
        ValueError: no curves, a shape other than these, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.
    """
    _check_png(path)
    curves = {name: np.asarray(values, np.float64) for name, values in series.items()}
    if not curves:
        raise ValueError("series must hold at least one curve: got none")
    for name, values in curves.items():
        if values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] != 2):
            raise ValueError(
                f"series must hold (N,) or (N, 2) arrays: got {values.shape} in {name!r}"
            )
    figure, canvas = _figure(*size)
    axes = figure.add_axes((0.11, 0.14, 0.86, 0.81))
    axes.set_facecolor("white")
    drawn = 0
    for index, (name, values) in enumerate(curves.items()):
        x, y = (np.arange(len(values)), values) if values.ndim == 1 else values.T
        y = np.where(y > 0, y, np.nan) if log else y
        marker = "o" if len(y) < 30 else None
        colour = _CURVES[index % len(_CURVES)]
        axes.plot(x, y, color=colour, label=name, linewidth=2, marker=marker, markersize=4)
        drawn += int(np.isfinite(y).sum())
    if log and drawn:  # matplotlib warns of a logarithmic axis without a positive value
        axes.set_yscale("log")
    axes.set_xlabel(xlabel, color=_INK)
    axes.set_ylabel(ylabel, color=_INK)
    axes.tick_params(colors=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e2dc", linewidth=0.8)
    axes.legend(frameon=False, labelcolor=_INK)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    _save_png(picture, path)
    return picture


def _figure(width: int, height: int) -> tuple[Any, Any]:
    # matplotlib's objects without pyplot: no global state, and no backend that looks for a display.
    import_extra("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    return figure, FigureCanvasAgg(figure)


def _write_texts(picture: Picture, texts: list[tuple[float, float, str, str]]) -> Picture:
    height, width = picture.shape[:2]
    figure, canvas = _figure(width, height)
    figure.figimage(picture)
    for x, y, text, align in texts:
        style = {"fontsize": 11, "color": _INK, "parse_math": False}
        figure.text(x / width, 1 - y / height, text, ha=align, va="center", **style)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _check_png(path: str | os.PathLike[str] | None) -> None:
    if path is not None and not os.fspath(path).lower().endswith(".png"):
        raise ValueError(f"path must end in .png: got {os.fspath(path)!r}")


def _save_png(picture: Picture, path: str | os.PathLike[str] | None) -> None:
    if path is None:
        return
    from PIL import Image

    with atomic_write(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG", optimize=True)
