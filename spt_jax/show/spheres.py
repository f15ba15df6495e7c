"""Pictures of the spheres that stand for a body."""

import os
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, UInt8

from spt_jax.body import BodyModel
from spt_jax.fit.spheres.model import BodySpheres
from spt_jax.fit.spheres.penalty import sphere_depths
from spt_jax.io.mesh_files import PENETRATING_COLOR
from spt_jax.show.framing import View, frame
from spt_jax.show.look import GAP, MATERIAL, Picture, check_png, check_size, finished
from spt_jax.show.offscreen import import_extra
from spt_jax.show.panel import draw_panel, panel_plotter

# By part in turn: neighbors differ, and none is near the red of collisions.
_COLOURS = np.array(
    [(86, 140, 178), (226, 178, 92), (110, 168, 130), (150, 134, 190), (196, 190, 176)], np.uint8
)
# How much of the skin lies over the spheres, and how much of a hidden collision shows through.
_GHOST, _SEEN_THROUGH = 0.22, 0.6


def render_spheres(
    body: BodyModel,
    spheres: BodySpheres,
    pose: Float[Array | np.ndarray, "J 3"] | None = None,
    shape: Float[Array | np.ndarray, "B"] | None = None,
    *,
    size: tuple[int, int] = (480, 600),
    view: View = "front",
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a picture of a body, and beside it of its spheres under its translucent skin.

    Spheres are colored by part, and red where they collide; a hidden collision shines through.

    Args:
        body: what the spheres were fitted to.
        spheres: from `BodySpheres.fit`.
        pose: axis-angle of each joint; None is the zero pose.
        shape: coefficients; None is the mean shape.
        size: (width, height) of each of the two panels in pixels.
        view: as in `render_mesh`, but for "auto", which has nothing to turn to.
        path: a .png file to write as well, atomically.

    Raises:
        ImportError: the `viz` extra is not installed.
        TypeError, ValueError: pose or shape as the body raises them; an unknown view, a size below
            16 pixels, or a path not ending in .png.
        OSError: the file's folder is missing or cannot be written.

    Example:
        >>> from spt_jax import load_body
        >>> from spt_jax.fit.spheres.model import BodySpheres
        >>> from spt_jax.show.spheres import render_spheres
        >>> body = load_body()
        >>> render_spheres(body, BodySpheres.fit(body), size=(60, 80)).shape
        (80, 126, 3)
    """
    check_png(path)
    check_size(size)
    if pose is None:
        pose = jnp.zeros((body.num_joints, 3), body.template.dtype)
    skin = np.asarray(body(pose, shape).vertices, np.float64)
    faces = np.asarray(body.faces, np.int64)
    depths = np.asarray(sphere_depths(spheres, body, pose, shape))
    colliding = np.maximum(depths.max(axis=0), depths.max(axis=1)) > 0
    centers, radii = (np.asarray(x, np.float64) for x in spheres.posed(body, pose, shape))

    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = np.tile(ball.vertices, (len(radii), 1))
    points = (centers[:, None] + radii[:, None, None] * ball.vertices).reshape(-1, 3)
    triangles = (np.arange(len(radii))[:, None, None] * len(ball.vertices) + ball.faces).reshape(
        -1, 3
    )
    # By the part's place in the order of parts, so that parent and child differ mostly.
    _, place = np.unique(spheres.part, return_inverse=True)
    colors = np.where(
        colliding[:, None], np.array(PENETRATING_COLOR, np.uint8), _COLOURS[place % len(_COLOURS)]
    )
    owner = np.repeat(np.arange(len(radii)), len(ball.faces))

    unlabelled = [np.zeros(len(skin), np.int8), np.zeros(len(points), np.int8)]
    camera = frame([skin, points], faces, unlabelled, view, size[0] / size[1])
    with panel_plotter(*size) as plotter:
        # It also lights the scene and aims the camera for the spheres after it.
        shown = draw_panel(plotter, skin, faces, unlabelled[0], camera)
        plotter.clear_actors()
        scene = import_extra("pyvista").PolyData.from_regular_faces(points, triangles)
        scene.point_data.active_normals = normals
        scene.cell_data["color"] = colors[owner]
        drawn = _draw(plotter, scene, size)[..., :3]
        picture = drawn + _GHOST * (shown - drawn)
        if colliding.any():
            plotter.clear_actors()
            spots = _draw(plotter, _only(scene, normals, points, triangles, colliding[owner]), size)
            picture += _SEEN_THROUGH * (spots[..., 3:] / 255) * (spots[..., :3] - picture)
    gap = np.full((size[1], GAP, 3), 255.0)
    both = np.concatenate([shown, gap, picture], axis=1)
    return finished(np.round(both).astype(np.uint8), path)


def _only(
    scene: Any,
    normals: Float[np.ndarray, "N 3"],
    points: Float[np.ndarray, "N 3"],
    triangles: np.ndarray,
    kept: Bool[np.ndarray, "T"],
) -> Any:
    part = import_extra("pyvista").PolyData.from_regular_faces(points, triangles[kept])
    part.point_data.active_normals = normals
    part.cell_data["color"] = np.asarray(scene.cell_data["color"])[kept]
    return part


def _draw(plotter: Any, scene: Any, size: tuple[int, int]) -> Float[np.ndarray, "h w 4"]:
    # render=False: a first drawing before the interpolation is set leaves the normals out for good.
    options = {"scalars": "color", "rgb": True, "reset_camera": False, "render": False}
    plotter.add_mesh(scene, **options, **MATERIAL).prop.interpolation = "Phong"
    plotter.render()
    solid: UInt8[np.ndarray, "H W 3"] = plotter.screenshot(return_img=True)
    mask = plotter.screenshot(return_img=True, transparent_background=True)[..., 3:]
    drawn = np.concatenate([solid, mask], axis=2).astype(np.float64)
    width, height = size
    across, down = drawn.shape[1] // width, drawn.shape[0] // height
    return drawn.reshape(height, down, width, across, 4).mean(axis=(1, 3))
