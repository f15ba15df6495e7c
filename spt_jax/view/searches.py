"""The searches that a view runs, one at a time, and how they are stopped."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from spt_jax.view.beside import freed
from spt_jax.view.files import Frames
from spt_jax.view.freeing import Stopped, outcome, untangle_scene
from spt_jax.view.panel import Panel
from spt_jax.view.scene import Reading, Scene

Show = Callable[[Reading, str], None]


class Searches:
    """Frees what a view shows, until it is free or the user has had enough.

    Attributes:
        under_way: whether a search runs.
    """

    def __init__(self) -> None:
        self.under_way = False
        self._stop = threading.Event()

    @property
    def stopped(self) -> bool:
        """Whether the search is to end, or was ended."""
        return self._stop.is_set()

    def stop(self) -> None:
        """End the search under way at its next step, from any thread."""
        self._stop.set()

    def of_scene(self, scene: Scene, panel: Panel, show: Show) -> str:
        """Untangle a scene and show every step; what came of it, in words."""
        with self._running(panel):
            before = scene.read()
            show(before, "untangling; the first time takes some seconds to compile")
            untangle_scene(
                scene,
                lambda vertices, text: show(scene.read(vertices), f"untangling: {text}"),
                self._stop.is_set,
            )
        return "stopped" if self.stopped else outcome(before, scene.read())

    def of_motion(
        self, scene: Scene, frames: Frames, panel: Panel, show: Show
    ) -> tuple[Frames | None, str]:
        """All frames of a motion untangled as one, None where stopped; and the same in words."""
        with self._running(panel):
            reading, body = scene.read(), scene.body
            try:
                return freed(
                    body,  # pyright: ignore[reportArgumentType]
                    frames,
                    lambda text: show(reading, text),
                    self._stop.is_set,
                )
            except Stopped:
                return None, "stopped"

    @contextmanager
    def _running(self, panel: Panel) -> Iterator[None]:
        self._stop.clear()
        self.under_way = True
        panel.show_busy(True)
        try:
            yield
        finally:
            self.under_way = False
            panel.show_busy(False)
