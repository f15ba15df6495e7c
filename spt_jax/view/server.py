"""The live view: viser's server, its panel and stage, and the worker that serves them."""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

from spt_jax.io.pose_files import MotionFile
from spt_jax.view import files
from spt_jax.view.access import access_for, free_port
from spt_jax.view.beside import Beside, Player
from spt_jax.view.guarded import (
    PATIENCE,
    drop_removed_nodes,
    drop_who_does_not_read,
    import_viser,
    start_guarded,
    stop_quietly,
)
from spt_jax.view.notices import tell_error, tell_notes
from spt_jax.view.opened import as_beside, as_shown, embedded_body
from spt_jax.view.panel import MEASURES, Panel
from spt_jax.view.scene import Reading, Scene
from spt_jax.view.searches import Searches
from spt_jax.view.stage import Stage
from spt_jax.view.uploads import UPLOAD_LIMIT, Uploads
from spt_jax.view.worker import Worker

# What ends a search under way: the newest request has priority.
_EDITS = frozenset(
    {"choose_motion", "choose_frame", "turn_axis", "turn_in_world", "set_shape"}
    | {"reset", "open_upload", "open_embedded"}
)


class View:
    """A scene in the browser.

    Methods whose names do not start with an underscore, `start`, `stop_serving` and the addresses
    aside, are what the panel asks for; they run on the worker's thread.

    Args:
        file: poses, a mesh or an SMPL model to begin with; the embedded body if None.
        beside: poses of the same people and frames, such as those of `file` untangled, that are
            shown beside them.
        host: address to serve on; who can reach it still needs the token of `url`.
        port: the next free one is taken where it is in use.
        upload_limit: of a file that a browser sends, in megabytes.
        max_bytes: what a file and its arrays may take once unpacked; 1 GiB where None.
        patience: seconds that a browser has for an answer; one that gives none is let go.

    Raises:
        ImportError: viser is not installed, or is one that cannot be guarded.
        OSError, ValueError: the file cannot be read, holds nothing that could be measured, or the
            host is no address of this machine; nothing is served then.
    """

    def __init__(
        self,
        file: Path | None = None,
        *,
        beside: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        upload_limit: int = UPLOAD_LIMIT,
        max_bytes: int | None = None,
        patience: float = PATIENCE,
    ):
        viser = import_viser()
        self.access, numeric = access_for(host)
        opened = None if file is None else files.open_file(file, max_bytes=max_bytes)
        other = None if beside is None else files.open_file(beside, max_bytes=max_bytes)
        if other is not None and not (
            isinstance(other, MotionFile) and isinstance(opened, MotionFile)
        ):
            raise ValueError("beside must be poses, beside a file of poses: got another kind.")
        self._max_bytes = max_bytes
        port = free_port(numeric, port)
        self.server = start_guarded(viser, self.access, numeric, port, patience)
        self._searches = Searches()
        self._notes: list[str] = []
        self._stage = Stage(self.server)
        self._status = "ready"
        self._motions: dict[str, files.Frames] = {}
        self._embedded = True
        self._beside: Beside | None = None
        self.worker = Worker(self._refresh, self._report)
        self._player = Player(self.worker, self._advance, self._rate)
        try:
            name = None if file is None else file.name
            self._take(opened if opened is not None else embedded_body(), name, first=True)
            if isinstance(other, MotionFile) and isinstance(opened, MotionFile):
                self._put_beside(self._matched(opened, other, beside.name))  # type: ignore
        except Exception:
            stop_quietly(self.server)
            raise
        Uploads(self.server, upload_limit, self._take_upload)
        self.server.on_client_connect(self._say_notes)

    @property
    def url(self) -> str:
        """The address that opens the view, with its token."""
        return self.access.url(self.server.get_port())

    @property
    def url_elsewhere(self) -> str:
        """The same for another machine, where it can reach this one."""
        return self.access.url_elsewhere(self.server.get_port())

    def start(self) -> None:
        """Begin to work."""
        self.worker.post("start", lambda: None)
        self.worker.start()

    def stop_serving(self, timeout: float = 5.0) -> bool:
        """End the server; whether the work under way ended too."""
        self._searches.stop()
        self._player.play(False)
        ended = self.worker.stop(timeout)
        drop_who_does_not_read(self.server)
        stop_quietly(self.server)
        return ended

    # What the panel asks for.

    def choose_motion(self, motion: str) -> None:
        """Show the first frame of another motion."""
        self.panel.choose_motion(motion)
        self.choose_frame(0)

    def choose_frame(self, row: int) -> None:
        """Show a frame of the motion."""
        frames = self._motions[self.panel.motion.value]
        row = min(int(row), len(frames.names) - 1)
        frames.load_into(self.scene, row)
        if self._beside is not None:
            self._beside.load(self.panel.motion.value, row)
        self._status = frames.names[row]

    def set_playing(self, wanted: bool) -> None:
        """Run through the frames of the motion, or stand still."""
        self._player.play(wanted)

    def choose_part(self, part: str) -> None:
        """Put the handles on another part of the body."""
        self.panel.choose_part(part)
        self._stage.set_handles(self.scene, self.panel.joints, self._turned)

    def choose_joint(self, _: str) -> None:
        """The sliders follow by themselves."""

    def turn_axis(self, joint: int, axis: int, degrees: float) -> None:
        """Turn a joint by a slider."""
        self.scene.turn(joint, axis, degrees)
        self._status = ""

    def turn_in_world(self, joint: int, wxyz: tuple[float, ...]) -> None:
        """Turn a joint by its handle."""
        self.panel.choose_joint(joint)
        self.scene.turn_in_world(joint, wxyz)
        self._status = ""

    def set_shape(self, component: int, value: float) -> None:
        """Set a shape coefficient."""
        self.scene.set_shape(component, value)
        self._status = ""

    def count_folds(self, wanted: bool) -> None:
        """Whether folds count."""
        self.scene.count_folds = wanted
        self._status = ""

    def measure_by(self, way: str) -> None:
        """Measure the volume, or as the paper does."""
        self.scene.paper = way == MEASURES[1]
        self._status = ""

    def see_through(self, wanted: bool) -> None:
        """Whether hidden overlaps are seen."""
        self._stage.set_see_through(wanted)

    def reset(self) -> None:
        """Back to what was loaded."""
        self.scene.reset()
        self._status = "ready"

    def untangle(self) -> None:
        """Untangle the scene and show every step."""
        self._status = self._searches.of_scene(self.scene, self.panel, self._show)

    def untangle_motion(self) -> None:
        """Untangle all frames of the motion as one, and show what comes of it beside."""
        motion, body = self.panel.motion.value, self.scene.body
        frames, status = self._searches.of_motion(
            self.scene, self._motions[motion], self.panel, self._show
        )
        if frames is not None:
            self._put_beside(Beside(body, "the motion untangled", {motion: frames}))  # type: ignore
        self._status = status

    def open_upload(self, name: str, content: bytes) -> None:
        """Show a file that a browser sent; a bad one changes nothing."""
        opened = files.open_upload(name, content, max_bytes=self._max_bytes)
        self._take(opened, files.label_of(name), first=False)

    def open_embedded(self) -> None:
        """Show the body that comes with the package."""
        self._take(embedded_body(), None, first=False)

    def save_mesh(self, client: Any) -> None:
        """Hand the surface to the browser that asked."""
        content = files.mesh_bytes(self.scene, self.scene.read())
        client.send_file_download("spt_jax.glb", content, save_immediately=True)

    def save_pose(self, client: Any) -> None:
        """Hand the pose to the browser that asked."""
        content = files.pose_bytes(self.scene)
        client.send_file_download("spt_jax_pose.npz", content, save_immediately=True)

    # How.

    def _do(self, key: Hashable, action: str, *arguments: Any, **keywords: Any) -> None:
        if action == "stop" or (self._searches.under_way and action in _EDITS):
            self._searches.stop()  # now, and not after what it is to stop
        if action == "stop":
            return
        self.worker.post(key, lambda: getattr(self, action)(*arguments, **keywords))

    def _rate(self) -> float:
        return self._motions[self.panel.motion.value].rate

    def _advance(self, gone: int) -> None:
        count = len(self._motions[self.panel.motion.value].names)
        row = (int(self.panel.frame.value) + gone) % count
        self.panel.show_frame(row)
        self.choose_frame(row)

    def _matched(self, opened: MotionFile, other: MotionFile, name: str) -> Beside:
        body, motions = self.scene.body, list(self._motions)
        put, notes = as_beside(opened, other, name, body, motions, embedded=self._embedded)  # type: ignore
        self._notes += [note for note in notes if note not in self._notes]
        return put

    def _put_beside(self, beside: Beside) -> None:
        self._beside = beside
        beside.load(self.panel.motion.value, int(self.panel.frame.value))
        self._stage.begin(self.scene, self.scene.read(), pair=True)
        self._stage.set_handles(self.scene, self.panel.joints, self._turned)

    def _turned(self, joint: int, wxyz: tuple[float, ...]) -> None:
        self._do(("handle", joint), "turn_in_world", joint, wxyz)

    def _take_upload(self, name: str, content: bytes) -> None:
        self._do("open", "open_upload", name, content)

    def _take(
        self, opened: Scene | MotionFile | files.Rigged, name: str | None, *, first: bool
    ) -> None:
        shown = as_shown(opened, name, None if first else self.scene, embedded=self._embedded)
        scene, motions, start, embedded, notes = shown
        if start is not None:
            motions[start[0]].load_into(scene, start[1])
        reading = scene.read()  # distances along the surface at rest take two seconds, once
        if reading.error is not None:
            raise ValueError(reading.error)
        self._player.play(False)
        self.scene, self._motions, self._beside = scene, motions, None
        self._embedded = embedded
        self._status = "ready" if start is None else motions[start[0]].names[start[1]]
        drop_removed_nodes(self.server)
        self._stage.begin(scene, reading)
        self.panel = Panel(self.server, scene, motions, start, self._do)
        self._stage.set_handles(scene, self.panel.joints, self._turned)
        self._notes = [*notes]
        for client in self.server.get_clients().values():
            self._say_notes(client)

    def _refresh(self, keys: set[Hashable]) -> None:
        self._show(self.scene.read(), self._status)
        dragged = [key[1] for key in keys if isinstance(key, tuple) and key[0] == "handle"]
        self._stage.place_handles(self.scene, but=dragged)
        # A slider must not be set under the hand that moves it.
        if not all(isinstance(key, tuple) and key[0] in ("slider", "shape") for key in keys):
            self.panel.show_state()

    def _show(self, reading: Reading, status: str) -> None:
        beside = None if self._beside is None else self._beside.read(self.scene)
        if reading.error is None:
            self._stage.show(reading, self.scene.faces, beside)
        self.panel.show_beside(beside, None if self._beside is None else self._beside.scene)
        self.panel.show_figures(reading, reading.error or status)

    def _report(self, error: Exception) -> None:
        self._status = tell_error(self.server, error)

    def _say_notes(self, client: Any) -> None:
        tell_notes(client, self._notes)
