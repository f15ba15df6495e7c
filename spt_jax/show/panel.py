"""One panel of a picture: a lit mesh with its labelled triangles shining through."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from spt_jax.io.mesh_files import BODY_COLOR, INVERTED_COLOR, PENETRATING_COLOR
from spt_jax.show.framing import Framing, marked_triangles
from spt_jax.show.look import BACKGROUND, LIGHTS, MATERIAL
from spt_jax.show.offscreen import import_extra, offscreen_plotter

OVERSAMPLING = 2
# How much of a hidden labelled triangle shows through what lies before it: enough to be found at
# thumbnail size, and still visibly behind.
_SEEN_THROUGH = 0.75


@contextmanager
def panel_plotter(width: int, height: int) -> Iterator[Any]:
    """Yield the plotter that draws panels of so many pixels; raises as `offscreen_plotter` does."""
    with offscreen_plotter(OVERSAMPLING * width, OVERSAMPLING * height) as plotter:
        plotter.set_background([channel / 255 for channel in BACKGROUND])
        yield plotter


def draw_panel(
    plotter: Any,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    labels: Int[np.ndarray, " V"],
    camera: Framing,
) -> UInt8[np.ndarray, "height width 3"]:
    """Return one mesh drawn with one camera: its body, then its labelled triangles over it.

    Args:
        plotter: from `panel_plotter`; what it drew before is cleared.
        vertices: positions.
        faces: vertex indices.
        labels: 0, +1 or -1 for each vertex.
        camera: from `frame`.
    """
    pyvista = import_extra("pyvista")
    plotter.clear_actors()
    plotter.remove_all_lights()
    for position, intensity in LIGHTS:
        light = pyvista.Light(position=position, light_type="camera light", intensity=intensity)
        plotter.add_light(light)
    _aim(plotter, camera)

    marked = marked_triangles(labels, faces)
    out = (labels[faces] > 0).any(axis=1)
    kind = marked * np.where(out, 1, 2)
    colors = np.array([BODY_COLOR, PENETRATING_COLOR, INVERTED_COLOR], np.uint8)[kind]
    normals = vertex_normals(vertices, faces)
    body = _add_surface(plotter, vertices, faces, normals, colors)
    plotter.render()  # screenshot alone would return what was drawn last
    picture = plotter.screenshot(return_img=True).astype(np.float64)
    if marked.any():
        plotter.remove_actor(body, reset_camera=False, render=False)
        _add_surface(plotter, vertices, faces[marked], normals, colors[marked], outline=True)
        plotter.render()
        spots = plotter.screenshot(return_img=True, transparent_background=True)
        opacity = _SEEN_THROUGH * (spots[..., 3:] / 255)
        picture += opacity * (spots[..., :3] - picture)
    height, width = (length // OVERSAMPLING for length in picture.shape[:2])
    blocks = picture.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _add_surface(
    plotter: Any,
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    colors: np.ndarray,
    outline: bool = False,
) -> Any:
    mesh = import_extra("pyvista").PolyData.from_regular_faces(vertices, faces)
    mesh.point_data.active_normals = normals
    mesh.cell_data["color"] = colors
    # render=False: a first drawing before the interpolation is set leaves the normals out for good.
    options = {"scalars": "color", "rgb": True, "reset_camera": False, "render": False}
    actor = plotter.add_mesh(mesh, **options, **MATERIAL)
    actor.prop.interpolation = "Phong"
    if outline:
        # Edges in the triangle's own color widen a spot by a pixel: slivers survive scaling.
        edges = {"style": "wireframe", "line_width": 1.5 * OVERSAMPLING, "lighting": False}
        plotter.add_mesh(mesh, **options, **edges)
    return actor


def _aim(plotter: Any, camera: Framing) -> None:
    # A parallel camera may stand at any distance; four depths keep both clipping planes outside.
    view = plotter.camera
    view.focal_point = camera.target
    view.position = camera.target + 4 * camera.depth * camera.axes[2]
    view.up = camera.axes[1]
    view.parallel_projection = True
    view.parallel_scale = camera.half_height
    view.clipping_range = (2 * camera.depth, 6 * camera.depth)


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit normals at the vertices, by the area of the triangles around them."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    weighted = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(normals, corner, weighted)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)
