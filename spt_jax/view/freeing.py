"""`untangle_pose` and `untangle_mesh` with every step shown on its way."""

import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from spt_jax._query import as_directions
from spt_jax._steps import Step
from spt_jax.overlap.measure import Sampling
from spt_jax.untangle.mesh import untangle_checked
from spt_jax.untangle.pose import untangle_pose
from spt_jax.untangle.spread import Surface
from spt_jax.view.scene import Reading, Scene

Show = Callable[[Float[np.ndarray, "V 3"], str], None]


class Stopped(Exception):
    """The user has had enough."""


class _Steps:
    """Shows the steps of a search, and remembers the last one and what failed."""

    def __init__(self, show: Show, stopped: Callable[[], bool]):
        self._show, self._stopped = show, stopped
        self._shown: Step | None = None
        self._end = self._cost = 0.0
        self.last: Step | None = None
        self.error: Exception | None = None

    def __call__(self, step: Step) -> None:
        if self._stopped():
            raise Stopped
        self.last = step
        start = time.perf_counter()
        # Rejected steps show nothing new, and looking must not take longer than searching.
        same = self._shown is not None and np.array_equal(step.vertices, self._shown.vertices)
        if same or self.error is not None or start - self._end < 0.5 * self._cost:
            return
        self._shown = step
        try:
            self._show(step.vertices, f"step {step.steps}")
        except Exception as error:  # the search goes on; `raise_error` says what failed
            self.error = error
        self._end = time.perf_counter()
        self._cost = self._end - start

    def raise_error(self) -> None:
        """Raise what `show` raised."""
        if self.error is not None:
            raise self.error


def untangle_scene(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    """Untangle a scene, its steps shown as they are found.

    A body is untangled by `untangle_pose`, folds left aside; where folds count, its skin then by
    `untangle_mesh`. A mesh is untangled by `untangle_mesh`.

    Args:
        scene: changed to what was found; to the last step where stopped.
        show: called with vertices and a line of text.
        stopped: asked between steps.

    Raises:
        Unmeasurable: there is nothing to measure in what the scene shows.
    """
    try:
        if scene.body is not None:
            _untangle_pose(scene, show, stopped)
        if scene.body is None or scene.count_folds:
            _untangle_vertices(scene, show, stopped)
    except Stopped:
        pass


def outcome(before: Reading, after: Reading) -> str:
    """What came of a search, in words."""
    if after.error is not None:
        return after.error
    if before.is_free:
        return "nothing to untangle"
    if after.is_free:
        return "intersection-free"
    if not after.intersecting_pairs:
        return "not intersection-free: no faces intersect, but a part is enclosed in another"
    return f"not intersection-free: {after.intersecting_pairs} intersecting pairs left"


def _untangle_pose(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    steps = _Steps(show, stopped)
    try:
        result = untangle_pose(
            scene.body,  # pyright: ignore[reportArgumentType]
            scene.pose,
            shape=scene.shape,
            translation=scene.translation,
            on_step=steps,
        )
        scene.set_pose(np.asarray(result.pose))
    except Stopped:
        if steps.last is not None and steps.last.pose is not None:
            scene.set_pose(steps.last.pose)
        raise
    steps.raise_error()


def _untangle_vertices(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    vertices = scene.vertices
    surface = Surface(scene.faces, len(vertices))
    steps = _Steps(show, stopped)
    try:
        sampling = Sampling(None, as_directions(3))
        found = untangle_checked(vertices, surface, sampling, on_step=steps)
    except Stopped:
        if steps.last is not None:
            scene.set_free_vertices(steps.last.vertices)
        raise
    scene.set_free_vertices(found.vertices)
    steps.raise_error()
    show(
        found.vertices,
        f"step {found.steps}, {found.after.intersecting_pairs} intersecting pairs",
    )
