"""Pictures of meshes and of their intersections, drawn without a display."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int

from spt_jax.io.mesh_files import as_mesh_arrays
from spt_jax.show.framing import View, frame
from spt_jax.show.look import GAP, Picture, check_png, check_size, finished, write_texts
from spt_jax.show.panel import draw_panel, panel_plotter

Points = Float[Array | np.ndarray, "..."]
Labels = Int[Array | np.ndarray, "..."]

_TITLE_HEIGHT = 34


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

    A triangle is colored if all of its vertices are labelled, or if one is that would otherwise
    not show: penetrating (+1) vermillion, otherwise inverted (-1) blue. Overlapping parts hide each
    other, so colored triangles are drawn a second time over the finished picture: what lies inside
    the body shows as a fainter spot.

    Args:
        vertices: positions, in any unit; the picture is fitted to them.
        faces: vertex indices, counter-clockwise seen from outside.
        labels: 0, +1 or -1 for each vertex, as `classify_vertices` gives them.
        size: (width, height) of the mesh's panel in pixels; a title adds to the height.
        view: "front", "left", "back", "right", "top", (azimuth, elevation) in degrees, or "auto":
            of eight azimuths the one from which the most labelled area is near the surface.
        title: a short line above it.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, an array that a notebook shows as such.

    Raises:
        ImportError: the `viz` extra is not installed.
        ValueError: arrays that do not make a mesh, an unknown view, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> import trimesh
        >>> from spt_jax.show import render_mesh
        >>> ball = trimesh.creation.icosphere()
        >>> render_mesh(ball.vertices, ball.faces, size=(64, 48)).shape
        (48, 64, 3)
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
        ImportError, ValueError, OSError: as `render_mesh` does, and
            ValueError for lists of different lengths.

    Example:
        >>> import trimesh
        >>> from spt_jax.show import render_before_after
        >>> ball = trimesh.creation.icosphere()
        >>> flat = ball.vertices * [1.0, 0.5, 1.0]
        >>> picture = render_before_after(ball.vertices, flat, ball.faces, size=(64, 64))
        >>> picture.shape  # two panels with a gap of 6 pixels, below their titles
        (98, 134, 3)
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
        ImportError, ValueError, OSError: as `render_mesh` does, and
            ValueError where meshes, labels and titles do not match.

    Example:
        >>> import trimesh
        >>> from spt_jax.show import render_strip
        >>> ball = trimesh.creation.icosphere()
        >>> shrinking = [ball.vertices, 0.7 * ball.vertices, 0.4 * ball.vertices]
        >>> render_strip(shrinking, ball.faces, size=(32, 32)).shape
        (32, 108, 3)
    """
    check_png(path)
    check_size(size)
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
        [as_mesh_arrays(*panel) for panel in zip(row, [faces] * len(row), label, strict=True)]
        for row, label in zip(meshes, labels, strict=True)
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
        (top + len(rows) * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3),
        255,
        np.uint8,
    )
    texts = [
        (index * (width + GAP) + width / 2, top / 2 + 1, text, "center")
        for index, text in enumerate(titles or ())
    ]
    with panel_plotter(width, height) as plotter:
        for i, row in enumerate(rows):
            y = top + i * (height + GAP)
            camera = frame(
                [p[0] for p in row], row[0][1], [p[2] for p in row], view, width / height
            )
            for j, panel in enumerate(row):
                x = j * (width + GAP)
                canvas[y : y + height, x : x + width] = draw_panel(plotter, *panel, camera)
            if row_titles is not None:
                texts.append((12, y + 18, row_titles[i], "left"))
    picture = write_texts(canvas, texts) if texts else canvas
    return finished(picture, path)
