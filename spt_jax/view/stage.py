"""The 3D side of the live view: the surface in the colors of its labels, and the handles."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from spt_jax.io.mesh_files import BODY_COLOR, INVERTED_COLOR, PENETRATING_COLOR
from spt_jax.overlap.labels import PENETRATING
from spt_jax.show.framing import frame, marked_triangles
from spt_jax.show.look import BACKGROUND
from spt_jax.view.scene import Reading, Scene

_OPACITY = 0.7
# Of the body's height; fingers stand closer together than other joints.
_HANDLE, _SMALL_HANDLE = 0.1, 0.022
_FLOOR_COLOUR, _LINE_COLOUR = (238, 235, 229), (226, 221, 213)
# A narrow view, from as far as it takes: limbs near the camera look no larger than they are.
_FIELD_OF_VIEW = 0.5  # radians, of the height

_SURFACE, _BESIDE = "/surface", "/beside"
_CLEAR, _PENETRATING, _INVERTED = "clear", "penetrating", "inverted"
# Drawn first, in no color at all, it hides all but the surface's front layer: transparent
# triangles are not sorted, and those behind would show through in patches.
_VEIL = "veil"
# How far apart two bodies stand, in sizes of the first.
_APART = 0.6

Turned = Callable[[int, tuple[float, ...]], None]


class Stage:
    """The surface and its handles on a viser server."""

    def __init__(self, server: Any):
        self._server = server
        self._meshes: dict[str, Any] = {}
        self._handles: dict[int, Any] = {}
        self._aside = np.zeros(3)
        self.see_through = True

    def begin(self, scene: Scene, reading: Reading, *, pair: bool = False) -> None:
        """Clear the stage for another scene, or for two side by side, and look at it."""
        api = self._server.scene
        api.reset()
        api.set_up_direction("+y")
        api.set_background_image(np.full((1, 1, 3), BACKGROUND, np.uint8))
        self._meshes, self._handles = {}, {}
        self._look_at(reading, scene.faces, pair)

    def _look_at(self, reading: Reading, faces: Int[np.ndarray, "F 3"], pair: bool) -> None:
        # From where the pictures of `spt_jax.show` would look: most of the overlap is seen.
        points = reading.vertices.astype(np.float64)
        towards = frame([points], faces, [reading.labels], "auto", 1.0).axes[2]
        low, high = points.min(axis=0), points.max(axis=0)
        middle, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        self._aside = np.zeros(3)
        if pair:  # to the right of the first, as seen from there
            right = np.cross([0.0, 1.0, 0.0], towards)
            self._aside = _APART * size * right / max(float(np.linalg.norm(right)), 1e-6)
            middle, size = middle + self._aside / 2, (1 + _APART) * size
        cell = 10.0 ** np.floor(np.log10(size)) / 4
        self._server.scene.add_grid(
            "/floor",
            width=3 * size,
            height=3 * size,
            plane="xz",
            cell_color=_FLOOR_COLOUR,
            section_color=_LINE_COLOUR,
            cell_size=cell,
            section_size=4 * cell,
            position=(middle[0], low[1], middle[2]),
        )
        position = middle + towards * 0.6 * size / np.tan(_FIELD_OF_VIEW / 2)
        cameras = [client.camera for client in self._server.get_clients().values()]
        for camera in (self._server.initial_camera, *cameras):
            camera.fov = _FIELD_OF_VIEW
            camera.position, camera.look_at = position, middle

    def show(
        self, reading: Reading, faces: Int[np.ndarray, "F 3"], beside: Reading | None = None
    ) -> None:
        """Draw the surface that was measured, and the one that stands beside it, if any."""
        with self._server.atomic():
            self._show(reading, faces, _SURFACE, np.zeros(3))
            if beside is not None and beside.error is None:
                self._show(beside, faces, _BESIDE, self._aside)
            else:
                for name, mesh in self._meshes.items():
                    mesh.visible = mesh.visible and not name.startswith(_BESIDE)
            self.set_see_through(self.see_through)

    def _show(self, reading: Reading, faces, root: str, offset: Float[np.ndarray, "3"]) -> None:
        marked = marked_triangles(reading.labels, faces)
        penetrating = marked & (reading.labels[faces] == PENETRATING).any(axis=1)
        vertices = reading.vertices + offset.astype(reading.vertices.dtype)
        for chosen, color, names in (
            (~marked, BODY_COLOR, (_VEIL, _CLEAR)),
            (penetrating, PENETRATING_COLOR, (_PENETRATING,)),
            (marked & ~penetrating, INVERTED_COLOR, (_INVERTED,)),
        ):
            self._draw(vertices, faces[chosen], color, [f"{root}/{name}" for name in names])

    def set_see_through(self, wanted: bool) -> None:
        """Whether what is in another part shines through it."""
        self.see_through = wanted
        for root in (_SURFACE, _BESIDE):
            if f"{root}/{_CLEAR}" not in self._meshes:
                continue
            clear, veil, *others = (
                self._meshes[f"{root}/{name}"] for name in (_CLEAR, _VEIL, _PENETRATING, _INVERTED)
            )
            # Without overlap there is nothing to see, and an opaque surface is crisper.
            veiled = wanted and any(mesh.visible for mesh in others)
            veil.visible = veiled and clear.visible
            clear.opacity = _OPACITY if veiled else None

    def set_handles(self, scene: Scene, joints: Sequence[int], turned: Turned) -> None:
        """Rings to turn these joints by, in place of those that were there."""
        for handle in self._handles.values():
            handle.remove()
        self._handles = {}
        height = float(np.ptp(scene.vertices, axis=0).max()) or 1.0
        for joint in joints:
            handle = self._server.scene.add_transform_controls(
                f"/handles/{joint}",
                scale=height * (_SMALL_HANDLE if len(joints) > 8 else _HANDLE),
                line_width=2.0,
                disable_axes=True,
                disable_sliders=True,
                depth_test=False,
                opacity=0.85,
            )
            handle.on_update(_listener(joint, turned))
            self._handles[joint] = handle
        self.place_handles(scene)

    def place_handles(self, scene: Scene, but: Sequence[int] = ()) -> None:
        """Move the handles to their joints, except those that are being dragged."""
        if not self._handles:
            return
        joints, orientations = scene.joints, scene.orientations()
        for joint, handle in self._handles.items():
            handle.position = joints[joint]
            if joint not in but:
                handle.wxyz = orientations[joint]

    def _draw(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        color: tuple[int, int, int],
        names: Sequence[str],
    ) -> None:
        # Only what the triangles use is sent: a few hundred vertices for a spot.
        used, triangles = np.unique(faces, return_inverse=True)
        points = vertices[used].astype(np.float32)
        triangles = triangles.reshape(-1, 3).astype(np.uint32)
        any_face = bool(len(faces))
        if not any_face:  # a mesh has to have one
            points, triangles = np.zeros((3, 3), np.float32), np.zeros((1, 3), np.uint32)
        for name in names:
            known = self._meshes.get(name)
            if known is None:
                self._meshes[name] = self._server.scene.add_mesh_simple(
                    name,
                    points,
                    triangles,
                    color=color,
                    opacity=0.0 if name.endswith(_VEIL) else None,
                    visible=any_face,
                    cast_shadow=False,
                    receive_shadow=False,
                )
                continue
            known.visible = any_face
            if any_face:
                known.vertices, known.faces = points, triangles


def _listener(joint: int, turned: Turned) -> Any:
    # async: viser keeps the order of such events, and posting does not wait.
    async def on_update(event: Any) -> None:
        if event.client is not None and event.phase != "start":
            turned(joint, tuple(event.target.wxyz))

    return on_update
