"""Vectors at a mesh's vertices, such as the penalty's gradient, drawn as arrows."""

import os
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from spt_jax.io.mesh_files import as_mesh_arrays
from spt_jax.show.framing import Framing, View, frame
from spt_jax.show.look import INK, Picture, check_png, check_size, finished
from spt_jax.show.offscreen import import_extra
from spt_jax.show.panel import OVERSAMPLING, draw_panel, panel_plotter

_LONGEST = 0.2  # an arrow, as a part of the picture's height
_SAME_WAY = 0.5  # cosine: arrows more different than this are never left out for each other


def render_arrows(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    vectors: Float[Array | np.ndarray, "V 3"],
    labels: Int[Array | np.ndarray, " V"] | None = None,
    *,
    most: int = 90,
    close_up: bool = False,
    size: tuple[int, int] = (480, 600),
    view: View = "auto",
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a picture of a mesh with an arrow at every vertex that has a vector.

    Pass the negative of a gradient to see where descent pushes the vertices. The longest vector is
    a fifth of the picture's height, the others in proportion. Arrows are seen through the mesh.

    Args:
        vertices: positions, in any unit.
        faces: vertex indices, counter-clockwise seen from outside.
        vectors: one for each vertex; where it is zero there is no arrow.
        labels: 0, +1 or -1 for each vertex, colored as in `render_mesh`.
        most: about how many arrows at most: of those near each other that point the same way the
            longest stays.
        close_up: look at the vertices with arrows, not at the whole mesh.
        size: (width, height) in pixels.
        view: as in `render_mesh`.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, an array that a notebook shows as such.

    Raises:
        ImportError: the `viz` extra is not installed.
        ValueError: arrays that do not make a mesh, vectors of another shape or not finite, most
            under 1, an unknown view, a size too small, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax.show import render_arrows
        >>> ball = trimesh.creation.icosphere()
        >>> outwards = np.where(ball.vertices[:, 2:] > 0.8, ball.vertices, 0.0)
        >>> render_arrows(ball.vertices, ball.faces, outwards, size=(64, 48)).shape
        (48, 64, 3)
    """
    check_png(path)
    check_size(size)
    points, triangles, label = as_mesh_arrays(vertices, faces, labels)
    given = np.asarray(vectors, np.float64)
    if given.shape != points.shape or not np.isfinite(given).all():
        raise ValueError(
            f"vectors must be {points.shape}, finite, one for each vertex: got {given.shape}"
            f"{'' if np.isfinite(given).all() else ', not finite'}."
        )
    if most < 1:
        raise ValueError(f"most must be at least 1: got {most!r}.")
    aspect = size[0] / size[1]
    camera = frame([points], triangles, [label], view, aspect)
    pointed = given.any(axis=1)
    if close_up and pointed.any():
        camera = _closer(camera, points[pointed], aspect)
    kept = _spread_out(points, given, most)
    with panel_plotter(*size) as plotter:
        picture = draw_panel(plotter, points, triangles, label, camera)
        if kept.any():
            over = _draw_arrows(plotter, points[kept], given[kept], camera, size)
            opacity = over[..., 3:] / 255
            picture = np.round(picture + opacity * (over[..., :3] - picture)).astype(np.uint8)
    return finished(picture, path)


def _closer(camera: Framing, points: Float[np.ndarray, "N 3"], aspect: float) -> Framing:
    seen = points @ camera.axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    half_width, half_height, _ = (high - low) / 2
    half = min(1.5 * max(half_height, half_width / aspect, 1e-9), camera.half_height)
    target = (low + high) / 2
    target[2] = camera.target @ camera.axes[2]  # the clipping planes stay outside the whole mesh
    return Framing(camera.axes, target @ camera.axes, half, camera.depth)


def _spread_out(
    points: Float[np.ndarray, "V 3"], vectors: Float[np.ndarray, "V 3"], most: int
) -> Bool[np.ndarray, "V"]:
    """Which arrows to draw: the longest first, none beside a longer one that points its way."""
    length = np.linalg.norm(vectors, axis=1)
    order = np.argsort(-length, kind="stable")[: np.count_nonzero(length)]
    kept = np.zeros(len(points), bool)
    if len(order) <= most:
        kept[order] = True
        return kept
    place, way = points[order], vectors[order] / length[order, None]
    extent = np.ptp(place, axis=0).max()
    room, chosen = extent / (4 * np.sqrt(most)), list(range(len(order)))
    while len(chosen) > most and room <= 2 * extent:
        left = np.ones(len(order), bool)
        chosen = []
        for index in range(len(order)):
            if left[index]:
                chosen.append(index)
                near = np.square(place - place[index]).sum(axis=1) <= room**2
                left &= ~(near & (way @ way[index] > _SAME_WAY))
        room *= 1.25
        if not room:
            break
    chosen = chosen[:most]  # too many that all point different ways
    kept[order[chosen]] = True
    return kept


def _draw_arrows(
    plotter: Any,
    points: Float[np.ndarray, "N 3"],
    vectors: Float[np.ndarray, "N 3"],
    camera: Framing,
    size: tuple[int, int],
) -> Float[np.ndarray, "height width 4"]:
    pyvista = import_extra("pyvista")
    longest = np.linalg.norm(vectors, axis=1).max()
    cloud = pyvista.PolyData(points)
    cloud.point_data["vectors"] = vectors / longest
    arrow = pyvista.Arrow(tip_length=0.28, tip_radius=0.065, shaft_radius=0.018)
    scale = 2 * camera.half_height * _LONGEST
    glyphs = cloud.glyph(orient="vectors", scale="vectors", factor=scale, geom=arrow)
    plotter.clear_actors()
    plotter.add_mesh(glyphs, color=INK, lighting=False, reset_camera=False, render=False)
    plotter.render()
    drawn = plotter.screenshot(return_img=True, transparent_background=True).astype(np.float64)
    width, height = size
    blocks = drawn.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 4)
    # Colors weighed by their opacity, or edges would take on the color of nothing.
    weight = blocks[..., 3:]
    total = weight.sum(axis=(1, 3))
    color = (blocks[..., :3] * weight).sum(axis=(1, 3)) / np.where(total > 0, total, 1)
    return np.concatenate([color, total / OVERSAMPLING**2], axis=2)
