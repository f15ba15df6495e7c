"""Bodies drawn over the photograph that they were fitted to."""

import os
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float, Int, UInt8

from spt_jax._camera import PinholeCamera
from spt_jax.files.limits import TooLargeError, as_file, check_bytes, file_errors
from spt_jax.io.mesh_files import as_mesh_arrays
from spt_jax.keypoints.layout import Layout
from spt_jax.show.look import BACKGROUND, LIGHTS, MATERIAL, Picture, check_png, finished
from spt_jax.show.offscreen import import_extra, offscreen_plotter
from spt_jax.show.panel import vertex_normals
from spt_jax.show.stick_figures import as_figures, draw_figures

# Colors of bodies in turn: light, so that keypoints stand out, and of different lightness.
_BODIES = ((213, 201, 188), (168, 196, 205), (196, 181, 209), (176, 203, 171), (222, 196, 150))
_OPACITY = 0.85  # of a body over a photograph: what lies under it still shows
_OVERSAMPLING = 2
# Above this many pixels a picture is fine enough as it is, and twice its sides too much memory.
_LARGE = 3_000_000
#: Pixels of a picture's side: what every off-screen window can do.
LARGEST = 8192


def render_overlay(
    image: Picture | str | os.PathLike[str] | tuple[int, int],
    vertices: Float[Array | np.ndarray, "..."] | Sequence[Any],
    faces: Int[Array | np.ndarray, "F 3"],
    camera: PinholeCamera,
    keypoints: Float[Array | np.ndarray, "..."] | Sequence[Any] | None = None,
    confidence: Float[Array | np.ndarray, "..."] | Sequence[Any] | None = None,
    fitted: Float[Array | np.ndarray, "..."] | Sequence[Any] | None = None,
    *,
    skeleton: str | Layout | Sequence[str | Layout] | None = None,
    opacity: float | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Picture:
    """Return a photograph with posed bodies drawn over it, as its camera would see them.

    A point of a body falls on the pixel that `camera.project` gives. Keypoints are dots: blue on
    the person's left, orange on the right, dark in the middle, joined as the skeleton says; those
    of confidence 0 are left out, and those below 1 are fainter. A thin ring marks where the body
    has each keypoint, with a line to where it was seen.

    Args:
        image: the photograph, as an array or a file, or (width, height) of a blank canvas.
        vertices: one body (V, 3), or several: (N, V, 3) or a list; in the world of the camera.
        faces: vertex indices, the same for all bodies.
        camera: what took the photograph.
        keypoints: pixels, (K, 2) of one person; of several (N, K, 2) or a list.
        confidence: (K,), (N, K) or a list; all are seen if None.
        fitted: where the bodies have them: the `keypoints` of a `FitResult`.
        skeleton: the keypoints' layout, by name or from `spt_jax.keypoints`, or one for each
            person; None draws no lines and does not distinguish left from right.
        opacity: of the bodies; 0.85 over a photograph and 1 on a canvas if None.
        path: a .png file to write as well, atomically.

    Returns:
        The picture, as large as the photograph.

    Raises:
        ImportError: the `viz` extra is not installed.
        TypeError, ValueError: an argument of another kind or shape than these, an image file that
            is none, a path not ending in .png.
        OSError: the image is missing, or the file's folder is missing or cannot be written.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import PinholeCamera, load_body
        >>> from spt_jax.show import render_overlay
        >>> body, upright = load_body(), jnp.zeros((52, 3)).at[0, 0].set(jnp.pi)
        >>> camera = PinholeCamera(100.0, (40.0, 30.0), translation=(0.0, 0.0, 4.0))
        >>> seen = camera.project(body(upright).joints[:22])
        >>> vertices = body(upright).vertices
        >>> render_overlay((80, 60), vertices, body.faces, camera, seen, skeleton="smpl").shape
        (60, 80, 3)
    """
    check_png(path)
    photograph = _as_photograph(image)
    bodies = _as_bodies(vertices, faces)
    if not isinstance(camera, PinholeCamera):
        raise TypeError(f"camera must be a PinholeCamera: got {type(camera).__name__}.")
    if opacity is None:
        opacity = 1.0 if isinstance(image, tuple) else _OPACITY
    if not 0 <= opacity <= 1:
        raise ValueError(f"opacity must be from 0 to 1: got {opacity!r}.")
    people = as_figures(keypoints, confidence, fitted, skeleton)

    drawn = _draw_bodies(bodies, camera, photograph.shape[1], photograph.shape[0])
    cover = opacity * drawn[..., 3:] / 255
    blended = photograph + cover * (drawn[..., :3] - photograph)
    picture = np.round(blended).astype(np.uint8)
    if people:
        picture = draw_figures(picture, people)
    return finished(picture, path)


def read_image(
    path: str | os.PathLike[str], *, max_bytes: int | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """A photograph as it is to be looked at: turned as its camera says, without transparency.

    Args:
        path: a file of any kind that Pillow reads by itself.
        max_bytes: what its pixels may take, three bytes each; 1 GiB where None.

    Raises:
        ImportError: Pillow is not installed.
        FileNotFoundError: there is no such file.
        OSError: the system does not let it be read.
        ValueError: it is no image, is cut or damaged, or announces more pixels than the limit.
    """
    import_extra("PIL")
    from PIL import Image, ImageOps

    file = as_file(path, "image")
    Image.init()
    # Pillow hands .eps over to Ghostscript, which runs what they say.
    formats = [name for name in Image.OPEN if name != "EPS"]
    with file_errors("image", file), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of metadata, and of a size that is checked below
        try:
            with Image.open(file, formats=formats) as image:
                width, height = image.size
                check_bytes("image", path, 3 * width * height, max_bytes)
                # Annotators saw the photograph upright, so keypoints count from its upright corner.
                ImageOps.exif_transpose(image, in_place=True)
                return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
        except (TooLargeError, MemoryError):
            raise
        except Exception as error:  # each of Pillow's readers fails in its own way
            raise ValueError(
                f"image must be a photograph that opens: got {str(path)!r} ({error})."
            ) from error


def _as_photograph(image: Any) -> Float[np.ndarray, "height width 3"]:
    if isinstance(image, tuple):
        if len(image) != 2 or not all(
            isinstance(side, (int, np.integer)) and not isinstance(side, bool) for side in image
        ):
            raise TypeError(f"image must be (width, height) in whole pixels: got {image!r}.")
        width, height = image
        photograph = np.full((max(height, 0), max(width, 0), 3), BACKGROUND, np.uint8)
    elif isinstance(image, (str, os.PathLike)):
        photograph = read_image(image)
    else:
        photograph = np.asarray(image)
    if photograph.ndim != 3 or photograph.shape[2] != 3 or photograph.dtype != np.uint8:
        raise ValueError(
            "image must be (height, width, 3) of uint8, a file or (width, height): got "
            f"{photograph.dtype} {photograph.shape}."
        )
    if not 16 <= min(photograph.shape[:2]) <= max(photograph.shape[:2]) <= LARGEST:
        raise ValueError(
            f"image must have sides of 16 to {LARGEST} pixels: got {photograph.shape[1]} by "
            f"{photograph.shape[0]}; scale it, its keypoints and the camera together."
        )
    return photograph.astype(np.float64)


def _as_bodies(vertices: Any, faces: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    several = [vertices] if getattr(vertices, "ndim", 3) == 2 else list(vertices)
    return [as_mesh_arrays(points, faces)[:2] for points in several]


def _draw_bodies(
    bodies: list[tuple[np.ndarray, np.ndarray]], camera: PinholeCamera, width: int, height: int
) -> Float[np.ndarray, "height width 4"]:
    """Color and opacity of the bodies alone."""
    pyvista = import_extra("pyvista")
    if not bodies:
        return np.zeros((height, width, 4))
    rotation, shift = np.asarray(camera.rotation, np.float64), np.asarray(camera.translation)
    # VTK's camera looks along -z with y up.
    seen = [(points @ rotation.T + shift) * [1.0, -1.0, -1.0] for points, _ in bodies]
    scale = _OVERSAMPLING if width * height <= _LARGE else 1
    with offscreen_plotter(scale * width, scale * height) as plotter:
        plotter.set_background([channel / 255 for channel in BACKGROUND])
        for position, intensity in LIGHTS:
            light = pyvista.Light(position=position, light_type="camera light", intensity=intensity)
            plotter.add_light(light)
        for index, (points, (_, faces)) in enumerate(zip(seen, bodies, strict=True)):
            mesh = pyvista.PolyData.from_regular_faces(points, faces)
            mesh.point_data.active_normals = vertex_normals(points, faces)
            actor = plotter.add_mesh(
                mesh,
                color=_BODIES[index % len(_BODIES)],
                reset_camera=False,
                render=False,
                **MATERIAL,
            )
            actor.prop.interpolation = "Phong"
        _aim(plotter, camera, width, height, -np.concatenate(seen)[:, 2])
        plotter.render()
        solid = plotter.screenshot(return_img=True)
        mask = plotter.screenshot(return_img=True, transparent_background=True)[..., 3:]
    drawn = np.concatenate([solid, mask], axis=2).astype(np.float64)
    return drawn.reshape(height, scale, width, scale, 4).mean(axis=(1, 3))


def _aim(
    plotter: Any, camera: PinholeCamera, width: int, height: int, depth: Float[np.ndarray, "V"]
) -> None:
    # The camera's own matrix, in place of an angle of view and a window center: those take one
    # focal length for both axes.
    vtk = import_extra("vtkmodules.vtkCommonMath").vtkCommonMath
    far = max(1.1 * float(depth.max()), 2e-3)
    near = max(0.9 * float(depth.min()), 1e-3 * far)
    (fx, fy), (cx, cy) = np.asarray(camera.focal, float), np.asarray(camera.center, float)
    rows = (
        (2 * fx / width, 0, 1 - 2 * cx / width, 0),
        (0, 2 * fy / height, 2 * cy / height - 1, 0),
        (0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)),
        (0, 0, -1, 0),
    )
    matrix = vtk.vtkMatrix4x4()
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            matrix.SetElement(i, j, float(value))
    view = plotter.camera
    view.position, view.focal_point, view.up = (0, 0, 0), (0, 0, -1), (0, 1, 0)
    view.parallel_projection = False
    view.clipping_range = (near, far)
    view.SetExplicitProjectionTransformMatrix(matrix)
    view.SetUseExplicitProjectionTransformMatrix(True)
