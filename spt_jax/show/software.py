"""What the pictures ask of a `pyvista.Plotter`, drawn by NumPy where no OpenGL can be had.

A bare machine, such as a container, has neither EGL nor OSMesa nor a display. Its pictures look the
same: lights, material and camera are those of VTK's shader, and of a posed body's picture one pixel
in 400 is off by more than 20 of 255, along outlines.

Every triangle lists the pixels of its box. Those whose centers lie in the triangle compete by
depth, and what wins is lit once for each pixel.
"""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from spt_jax.overlap.arrays.ranges import spread

# Pixels of triangles' boxes that are looked at together.
_AT_ONCE = 1 << 21


class _Light(NamedTuple):
    """Towards a light in the camera's frame, and how bright it is."""

    direction: Float[np.ndarray, "3"]
    intensity: float


@dataclass
class _Actor:
    """A mesh as it is to be drawn."""

    mesh: Any
    color: Any
    has_colors: bool
    line_width: float | None
    is_lit: bool
    material: dict[str, float]
    prop: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(interpolation="Flat"))


class SoftwareCamera:
    """The part of `pyvista.Camera` that pictures use."""

    def __init__(self):
        self.position = self.focal_point = (0.0, 0.0, 0.0)
        self.up = (0.0, 1.0, 0.0)
        self.parallel_projection = False
        self.parallel_scale = 1.0
        self.clipping_range = (0.0, 1.0)
        self._matrix: Any = None

    def SetExplicitProjectionTransformMatrix(self, matrix: Any) -> None:
        """A projection in place of the angle of view, as VTK has it."""
        self._matrix = matrix

    def SetUseExplicitProjectionTransformMatrix(self, used: bool) -> None:
        """Whether it is used; this camera has no angle of view, so it always is."""

    def frame(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """The axes right, up and backwards as rows, and where the camera stands."""
        position = np.asarray(self.position, float)
        back = position - np.asarray(self.focal_point, float)
        back = back / np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back]), position

    def project(
        self, points: Float[np.ndarray, "V 3"], width: int, height: int
    ) -> Float[np.ndarray, "V 4"]:
        """Of points in the camera's frame the pixels right and down, depth, and whether ahead."""
        if self.parallel_projection:
            scale = height / (2 * self.parallel_scale)
            x, y, depth = points[:, 0] * scale, points[:, 1] * scale, -points[:, 2]
            ahead = np.ones(len(points))
            return np.stack([width / 2 + x, height / 2 - y, depth, ahead], axis=1)
        matrix = np.array([[self._matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
        clip = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ matrix.T
        ahead = clip[:, 3] > self.clipping_range[0] / 2
        x, y, depth = (clip[:, :3] / np.where(ahead, clip[:, 3], 1.0)[:, None]).T
        return np.stack([(1 + x) * width / 2, (1 - y) * height / 2, depth, ahead], axis=1)


class SoftwarePlotter:
    """The part of `pyvista.Plotter` that pictures use."""

    def __init__(self, width: int, height: int):
        self._size = width, height
        self._background = np.ones(3)
        self._lights: list[_Light] = []
        self._actors: list[_Actor] = []
        self.camera = SoftwareCamera()

    def set_background(self, color: Any) -> None:
        """Red, green and blue from 0 to 1."""
        self._background = np.asarray(color, float)

    def add_light(self, light: Any) -> None:
        """A `pyvista.Light` that moves with the camera."""
        direction = np.asarray(light.position, float)
        self._lights.append(_Light(direction / np.linalg.norm(direction), float(light.intensity)))

    def remove_all_lights(self) -> None:
        """Leave what is lit to its ambient light."""
        self._lights = []

    def clear_actors(self) -> None:
        """Draw nothing more of what was added."""
        self._actors = []

    def remove_actor(self, actor: _Actor, **_: Any) -> None:
        """Draw one thing no more."""
        self._actors.remove(actor)

    def add_mesh(
        self,
        mesh: Any,
        *,
        color: Any = None,
        scalars: str | None = None,
        style: str = "surface",
        line_width: float = 1.0,
        lighting: bool = True,
        **options: Any,
    ) -> _Actor:
        """A `pyvista.PolyData` of one color, or with the array "color" of its triangles."""
        material = {k: v for k, v in options.items() if not isinstance(v, bool)}
        lines = line_width if style == "wireframe" else None
        self._actors.append(_Actor(mesh, color, scalars is not None, lines, lighting, material))
        return self._actors[-1]

    def render(self) -> None:
        """Nothing: every screenshot draws."""

    def close(self) -> None:
        """Nothing is held."""

    def screenshot(
        self, return_img: bool = True, transparent_background: bool = False
    ) -> UInt8[np.ndarray, "height width c"]:
        """Everything as it is seen; with opacity where the background is to be transparent."""
        width, height = self._size
        axes, position = self.camera.frame()
        depth = np.full(width * height, np.inf)
        picture = np.tile(self._background, (width * height, 1))
        for actor in self._actors:
            self._draw(actor, axes, position, depth, picture)
        shown = np.rint(255 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
        shown = shown.reshape(height, width, 3)
        if transparent_background:
            opacity = np.where(np.isfinite(depth), np.uint8(255), np.uint8(0))
            shown = np.concatenate([shown, opacity.reshape(height, width, 1)], axis=2)
        return shown

    def _draw(self, actor: _Actor, axes, position, depth, picture) -> None:
        mesh = actor.mesh if actor.mesh.is_all_triangles else actor.mesh.triangulate()
        faces = np.asarray(mesh.regular_faces)
        points = (np.asarray(mesh.points, float) - position) @ axes.T
        seen = self.camera.project(points, *self._size)
        faces_kept = np.flatnonzero(seen[faces, 3].all(axis=1))
        faces = faces[faces_kept]
        if actor.has_colors:
            colors = np.asarray(mesh.cell_data["color"], float)[faces_kept] / 255
        else:
            colors = np.tile(_rgb(actor.color), (len(faces), 1))
        corners = seen[faces, :3]
        if actor.line_width is not None:
            corners = _lines(corners, actor.line_width)
            colors = np.tile(colors, (6, 1))
        face, pixel, weights = _nearest(corners, self._size, depth)
        shown = colors[face]
        if actor.is_lit and actor.line_width is None:
            a, b, c = points[faces].transpose(1, 0, 2)
            flat = np.cross(b - a, c - a)[face]
            toward = -np.einsum("pk,pkc->pc", weights, points[faces[face]])
            if self.camera.parallel_projection:
                toward = np.broadcast_to([0.0, 0.0, 1.0], toward.shape)
            normal, normals = flat, mesh.point_data.active_normals
            if actor.prop.interpolation == "Phong" and normals is not None:
                of_corners = (np.asarray(normals, float) @ axes.T)[faces[face]]
                normal = np.einsum("pk,pkc->pc", weights, of_corners)
            # Of triangles that are seen from behind, the back is lit.
            behind = np.einsum("pc,pc->p", flat, toward) < 0
            normal = np.where(behind[:, None], -normal, normal)
            shown = self._lit(shown, _unit(normal), _unit(toward), **actor.material)
        picture[pixel] = shown

    def _lit(
        self, color, normal, toward, ambient=0.0, diffuse=1.0, specular=0.0, specular_power=1.0
    ) -> Float[np.ndarray, "N 3"]:
        found = ambient * color
        for light in self._lights:
            facing = normal @ light.direction
            found += (diffuse * light.intensity * np.maximum(facing, 0.0))[:, None] * color
            mirrored = 2 * facing[:, None] * normal - light.direction
            glint = np.maximum(np.einsum("pc,pc->p", mirrored, toward), 1e-5) ** specular_power
            found += (specular * light.intensity * np.where(facing > 0, glint, 0.0))[:, None]
        return found


def _rgb(color: Any) -> Float[np.ndarray, "3"]:
    from pyvista import Color

    return np.array(Color(color).float_rgb)


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def _lines(corners: Float[np.ndarray, "F 3 3"], width: float) -> Float[np.ndarray, "L 3 3"]:
    """The sides of triangles as strips so many pixels wide, two triangles each."""
    start = corners.transpose(1, 0, 2).reshape(-1, 3)
    end = np.roll(corners, -1, axis=1).transpose(1, 0, 2).reshape(-1, 3)
    along = end - start
    along[:, 2] = 0.0
    along = _unit(along) * width / 2
    aside = np.stack([-along[:, 1], along[:, 0], along[:, 2]], axis=1)
    start, end = start - along, end + along
    a, b, c, d = start - aside, end - aside, end + aside, start + aside
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _nearest(
    corners: Float[np.ndarray, "F 3 3"], size: tuple[int, int], depth: Float[np.ndarray, "P"]
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """The triangle that is seen at each pixel, the pixel, and where on the triangle.

    Args:
        corners: pixels right and down, and depth.
        size: of the picture.
        depth: of what was drawn before, by pixel; what is nearer is put there.
    """
    width, height = size
    limit = np.array([width - 1, height - 1])
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - 0.5), 0, limit + 1).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) - 0.5), -1, limit).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(axis=1)
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners.transpose(1, 2, 0)
    double_area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    count[double_area == 0] = 0
    face_at, bary_at = np.full(width * height, -1), np.zeros((width * height, 2))
    total = np.cumsum(count)
    begin = 0
    while begin < len(corners):
        done = total[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(total, done + _AT_ONCE, side="right")))
        place, of = spread(np.zeros(end - begin, np.int64), count[begin:end])
        f = of + begin
        down, right = np.divmod(place, np.maximum(extent[f, 0], 1))
        column, row = low[f, 0] + right, low[f, 1] + down
        x, y = column + 0.5, row + 0.5
        area = double_area[f]
        u = ((x - ax[f]) * (cy[f] - ay[f]) - (cx[f] - ax[f]) * (y - ay[f])) / area
        v = ((bx[f] - ax[f]) * (y - ay[f]) - (x - ax[f]) * (by[f] - ay[f])) / area
        inside = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1))
        f, u, v, pixel = f[inside], u[inside], v[inside], (row * width + column)[inside]
        z = az[f] + u * (bz - az)[f] + v * (cz - az)[f]
        np.minimum.at(depth, pixel, z)
        won = np.flatnonzero(z == depth[pixel])
        face_at[pixel[won]] = f[won]
        bary_at[pixel[won], 0], bary_at[pixel[won], 1] = u[won], v[won]
        begin = end
    pixel = np.flatnonzero(face_at >= 0)
    u, v = bary_at[pixel].T
    return face_at[pixel], pixel, np.stack([1 - u - v, u, v], axis=1)
