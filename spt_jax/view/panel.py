"""The panel of the live view: figures, buttons and sliders. It only posts what users do."""

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np

from spt_jax.io.mesh_files import INVERTED_COLOR, PENETRATING_COLOR
from spt_jax.view.files import Frames
from spt_jax.view.scene import Reading, Scene, body_parts

_CUBIC_CENTIMETRES = 1e6  # in a cubic metre
_AXES = ("x", "y", "z")
_FIRST_PART = "right arm"
MEASURES = ("volume", "paper's ratio")


class Panel:
    """Everything that can be pressed, for one scene.

    Args:
        server: viser's, whose panel is cleared.
        scene: what is shown; read here, and changed by nobody but the worker.
        motions: frames to choose from, by name.
        first: the motion and the frame that are shown.
        do: do(key, name, *arguments, client=None) has the view's worker do something.
    """

    def __init__(
        self,
        server: Any,
        scene: Scene,
        motions: dict[str, Frames],
        first: tuple[str, int] | None,
        do: Callable[..., None],
    ):
        self._gui, self._scene, self._motions, self._do = server.gui, scene, motions, do
        self._parts = body_parts(scene.body.joint_names) if scene.body else {}
        self.free_motion: Any = None
        self._gui.reset()
        self._gui.configure_theme(
            show_logo=False,
            show_share_button=False,
            brand_color=PENETRATING_COLOR,
            control_width="medium",
        )
        self._gui.set_panel_label("spt-jax view")
        self._gui.main_panel.dock_right()
        self._figures = self._gui.add_html("")
        self._beside = self._gui.add_html("")
        self._buttons()
        if scene.body is not None:
            self._pose_widgets(first)
            self._shape_widgets()
        self._file_widgets()

    # What the worker calls.

    def show_figures(self, reading: Reading, status: str) -> None:
        """Write what was measured."""
        self._figures.content = figures(reading, self._scene, status)

    def show_beside(self, reading: Reading | None, scene: Scene | None) -> None:
        """Write what was measured of what stands beside, if anything does."""
        content = ""
        if reading is not None and scene is not None:
            content = figures(reading, scene, "", "spt-figures-beside")
        if self._beside.content != content:
            self._beside.content = content

    def show_frame(self, row: int) -> None:
        """Move the frame slider along with what plays."""
        self.frame.value = row

    def show_busy(self, busy: bool) -> None:
        """Only `stop` can be pressed while the scene is untangled."""
        self.untangle.disabled = busy
        if self.free_motion is not None:
            self.free_motion.disabled = busy
        self.stop.visible = busy

    def show_state(self) -> None:
        """Set the sliders to the scene."""
        if self._scene.body is None:
            return
        degrees = np.degrees(self._scene.pose[self.joint])
        for slider, value in zip(self.axes, degrees, strict=True):
            slider.value = _within(slider, float(value))
        for slider, value in zip(self.shape, self._scene.shape, strict=True):
            slider.value = _within(slider, float(value))

    def choose_part(self, part: str) -> None:
        """Offer the joints of another part."""
        names = [self._scene.body.joint_names[joint] for joint in self._parts[part]]  # type: ignore
        self._joint.options = names
        self._joint.value = names[min(1, len(names) - 1)]

    def choose_joint(self, joint: int) -> None:
        """Show another joint of the part in the sliders."""
        self._joint.value = self._scene.body.joint_names[joint]  # type: ignore

    def choose_motion(self, motion: str) -> None:
        """Let the frame slider run through another motion."""
        self.frame.value = 0
        self.frame.max = max(1, len(self._motions[motion].names) - 1)
        self.frame.disabled = len(self._motions[motion].names) < 2

    @property
    def joint(self) -> int:
        """The joint of the sliders."""
        return self._scene.body.joint_names.index(self._joint.value)  # type: ignore

    @property
    def joints(self) -> tuple[int, ...]:
        """The joints of the part that is shown."""
        return self._parts[self._part.value] if self._parts else ()

    # Widgets.

    def _buttons(self) -> None:
        gui = self._gui
        hint = "Move it apart, step by step: a pose by untangle_pose, a mesh by untangle_mesh"
        self.untangle = gui.add_button("Untangle", hint=hint)
        self.stop = gui.add_button("Stop", visible=False, color="gray")
        reset = gui.add_button("Reset", color="gray", hint="Back to what was loaded")
        hint = "Measure the exact volume, or as the paper does: 512 rays, the triangle rule"
        measure = gui.add_dropdown("Measure", MEASURES, initial_value=MEASURES[0], hint=hint)
        if self._scene.body is not None:
            hint = "Folds of skin where a joint bends are measured and untangled, too"
            folds = gui.add_checkbox("Count folds", self._scene.count_folds, hint=hint)
            self._on(folds, "folds", "count_folds")
        through = gui.add_checkbox("See through", True, hint="Show what lies within another part")
        self._on(through, "through", "see_through")
        self._on(measure, "measure", "measure_by")
        self._on(self.untangle, "untangle", "untangle", click=True, value=False)
        self._on(self.stop, "stop", "stop", click=True, value=False)
        self._on(reset, "reset", "reset", click=True, value=False)

    def _pose_widgets(self, first: tuple[str, int] | None) -> None:
        gui, names = self._gui, self._scene.body.joint_names  # type: ignore
        with gui.add_folder("Pose"):
            if self._motions:
                motion, row = first or (next(iter(self._motions)), 0)
                choice = gui.add_dropdown("Motion", tuple(self._motions), initial_value=motion)
                last = max(1, len(self._motions[motion].names) - 1)
                self.frame = gui.add_slider("Frame", 0, last, 1, row)
                self.motion = choice
                hint = "Run through the frames, at the motion's rate where that can be shown"
                self.play = gui.add_checkbox("Play", False, hint=hint)
                hint = "Move all frames apart by untangle_motion, and show the result beside"
                self.free_motion = gui.add_button("Untangle motion", hint=hint)
                self._on(self.play, "play", "set_playing")
                self._on(self.free_motion, "untangle", "untangle_motion", click=True, value=False)
                self._on(choice, "motion", "choose_motion")
                self._on(self.frame, "frame", "choose_frame")
            part = _FIRST_PART if _FIRST_PART in self._parts else next(iter(self._parts))
            self._part = gui.add_dropdown("Part", tuple(self._parts), initial_value=part)
            joints = self._parts[part]
            options = tuple(names[joint] for joint in joints)
            hint = "Or turn the joint by its rings"
            second = options[min(1, len(options) - 1)]
            self._joint = gui.add_dropdown("Joint", options, initial_value=second)
            self.axes = [
                gui.add_slider(f"{axis} (degrees)", -180.0, 180.0, 0.5, 0.0, hint=hint)
                for axis in _AXES
            ]
            self._on(self._part, "part", "choose_part")
            self._on(self._joint, "joint", "choose_joint")
            for axis, slider in enumerate(self.axes):
                slider.on_update(self._slider_listener(axis))

    def _slider_listener(self, axis: int) -> Any:
        # The joint is that of the moment: by the time the worker comes to it another may be shown.
        async def on_update(event: Any) -> None:
            if event.client is not None:
                joint = self.joint
                self._do(("slider", joint, axis), "turn_axis", joint, axis, event.target.value)

        return on_update

    def _shape_widgets(self) -> None:
        with self._gui.add_folder("Shape", expand_by_default=False):
            self.shape = [
                self._gui.add_slider(f"Shape {k + 1}", -4.0, 4.0, 0.05, 0.0)
                for k in range(len(self._scene.shape))
            ]
        for component, slider in enumerate(self.shape):
            self._on(slider, ("shape", component), "set_shape", component)

    def _file_widgets(self) -> None:
        with self._gui.add_folder("Files"):
            hint = "Poses (.npz), a mesh (.ply, .obj, .stl, .off, .glb), an SMPL model (.npz, .pkl)"
            # What comes of it goes to the view's own `Uploads`.
            self._gui.add_upload_button("Open a file", hint=hint)
            if self._scene.body is None:
                embedded = self._gui.add_button("Embedded body", color="gray")
                self._on(embedded, "open", "open_embedded", click=True, value=False)
            save_mesh = self._gui.add_button("Save GLB", color="gray")
            self._on(save_mesh, "save_mesh", "save_mesh", click=True, value=False, client=True)
            if self._scene.body is not None:
                save_pose = self._gui.add_button("Save pose", color="gray")
                self._on(save_pose, "save_pose", "save_pose", click=True, value=False, client=True)

    def _on(
        self,
        widget: Any,
        key: Any,
        action: str,
        *first: Any,
        click: bool = False,
        value: bool = True,
        client: bool = False,
    ) -> None:
        # async: viser keeps the order of such events, and posting does not wait.
        async def on_event(event: Any) -> None:
            # What the worker itself sets comes without a client.
            if event.client is None:
                return
            values = (event.target.value,) if value else ()
            who = {"client": event.client} if client else {}
            self._do(key, action, *first, *values, **who)

        widget.on_click(on_event) if click else widget.on_update(on_event)


def _within(slider: Any, value: float) -> float:
    # Rounded, and never -0.0, which would be shown.
    return round(float(np.clip(value, slider.min, slider.max)), 2) + 0.0


def figures(reading: Reading, scene: Scene, status: str, name: str = "spt-figures") -> str:
    """What was measured, as HTML in a box of this name."""
    volume, ratio = volume_text(reading.volume, scene), f"{reading.counts.ratio:.2%}"
    if reading.error is not None:
        volume = ratio = "not measured"
    large, small = (ratio, volume) if scene.paper else (volume, ratio)
    large_name, small_name = ("ratio (Eq. 11)", "overlap volume")[:: 1 if scene.paper else -1]
    rows = [
        (small_name, small),
        (f"{_dot(PENETRATING_COLOR)} penetrating", f"{reading.counts.penetrating}"),
        (f"{_dot(INVERTED_COLOR)} inverted", f"{reading.counts.inverted}"),
        ("intersecting pairs", f"{reading.intersecting_pairs}"),
        ("measured in", f"{reading.milliseconds:.0f} ms"),
    ]
    table = "".join(
        f'<tr><td>{name}</td><td style="text-align:right;font-weight:600">{value}</td></tr>'
        for name, value in rows
    )
    return (
        f'<div id="{name}" style="padding:0.2em 1em 0.4em 1em;font-size:0.8em;'
        f'font-variant-numeric:tabular-nums" data-volume="{reading.volume!r}" '
        f'data-status="{escape(status)}">'
        f'<div style="font-size:2.3em;font-weight:650;line-height:1.25">{large}</div>'
        f'<div style="opacity:0.7;margin-bottom:0.5em">{large_name} of {escape(scene.name)}</div>'
        f'<table style="width:100%;border-spacing:0">{table}</table>'
        f'<div style="opacity:0.7;margin-top:0.5em">{escape(status) or "&nbsp;"}</div></div>'
    )


def volume_text(volume: float, scene: Scene) -> str:
    """The volume with its unit: a mesh does not say what its own is."""
    if scene.body is None:
        return f"{volume:.4g} unit³"
    return f"{volume * _CUBIC_CENTIMETRES:.2f} cm³"


def _dot(color: tuple[int, int, int]) -> str:
    style = "display:inline-block;width:0.75em;height:0.75em;border-radius:50%"
    return f'<span style="{style};background:rgb{color}"></span>'
