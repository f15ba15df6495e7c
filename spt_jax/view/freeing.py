"""`untangle_pose` and `untangle_mesh` with every step shown on its way."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import Float

from spt_jax.arguments import as_directions
from spt_jax.overlap.measure import Sampling
from spt_jax.untangle.mesh import untangle_checked
from spt_jax.untangle.pose import turned, untangle_pose
from spt_jax.untangle.spread import Surface
from spt_jax.view.scene import Scene

Show = Callable[[Float[np.ndarray, "V 3"], str], None]

# Arrays above about 100 kB must not be operands of a callback (`host.py` says why).
_PIECE = 20_000

# Steps of the first looks at an untangling mesh; each search starts anew and goes twice as far.
_MESH_LOOKS = (1, 2, 4, 8, 16)


class Stopped(Exception):
    """The user has had enough."""


class _Relay:
    """Where the running solver's steps go; called by XLA, so it raises nothing and uses no JAX."""

    def __init__(self):
        self.target: Callable[[np.ndarray, np.ndarray], None] | None = None
        self.error: Exception | None = None

    def __call__(self, pose, *pieces) -> None:
        if self.target is None or self.error is not None:
            return
        try:
            flat = np.concatenate([np.asarray(piece) for piece in pieces])
            self.target(np.array(pose), flat.reshape(-1, 3))
        except Exception as error:
            self.error = error


class _Watched(optx.AbstractMinimiser):
    """A minimiser whose every accepted step is posed and handed to a relay."""

    inner: optx.AbstractMinimiser
    relay: _Relay = eqx.field(static=True)

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.norm

    def init(self, *args):
        return self.inner.init(*args)

    def step(self, fn, y, args, options, state, tags):
        y, state, aux = self.inner.step(fn, y, args, options, state, tags)
        body, (pose, shape, translation, factor), *_ = args
        at = turned(pose, factor, y)
        flat = body(at, shape, translation).vertices.reshape(-1)
        pieces = [flat[start : start + _PIECE] for start in range(0, flat.size, _PIECE)]
        jax.debug.callback(self.relay, at, *pieces)
        return y, state, aux

    def terminate(self, *args):
        return self.inner.terminate(*args)

    def postprocess(self, *args):
        return self.inner.postprocess(*args)


# One object, so that the solver is compiled once.
_RELAY = _Relay()
_SOLVER = _Watched(  # pyright: ignore[reportCallIssue]
    inner=optx.BFGS(rtol=1e-3, atol=1e-3), relay=_RELAY
)


def untangle_scene(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    """Free a scene, its steps shown as they are found.

    A body is freed by `untangle_pose`, folds left aside; where folds count, its skin then by
    `untangle_mesh`. A mesh is freed by `untangle_mesh`.

    Args:
        scene: changed to what was found; to the step last shown where stopped.
        show: called with vertices and a line of text, from another thread too.
        stopped: asked between steps, or between the weights of a pose.

    Raises:
        Unmeasurable: there is nothing to measure in what the scene shows.
    """
    try:
        if scene.body is not None:
            _free_pose(scene, show, stopped)
        if scene.body is None or scene.count_folds:
            _free_vertices(scene, show, stopped)
    except Stopped:
        pass


def _free_pose(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    last: dict[str, Any] = {"pose": None, "steps": 0, "end": 0.0, "cost": 0.0}

    def on_vertices(pose: np.ndarray, vertices: np.ndarray) -> None:
        same = last["pose"] is not None and np.array_equal(pose, last["pose"])
        last["pose"], last["steps"] = pose, last["steps"] + 1
        start = time.perf_counter()
        # Rejected steps show nothing new, and looking must not take longer than searching.
        if same or start - last["end"] < 0.5 * last["cost"]:
            return
        show(vertices, f"step {last['steps']}")
        last["end"] = time.perf_counter()
        last["cost"] = last["end"] - start

    def on_weight(stage: int, steps: int, volume: float) -> None:
        # Between two programs; from within one nothing may be raised.
        if stopped():
            raise Stopped

    _RELAY.target, _RELAY.error = on_vertices, None
    try:
        result = untangle_pose(
            scene.body,  # pyright: ignore[reportArgumentType]
            scene.pose,
            shape=scene.shape,
            translation=scene.translation,
            solver=_SOLVER,
            on_step=on_weight,
        )
        scene.set_pose(np.asarray(result.pose))
    except Stopped:
        if last["pose"] is not None:
            scene.set_pose(last["pose"])
        raise
    finally:
        jax.effects_barrier()
        _RELAY.target = None
    if _RELAY.error is not None:
        raise _RELAY.error


def _free_vertices(scene: Scene, show: Show, stopped: Callable[[], bool]) -> None:
    # The search starts from the same vertices every time and is deterministic, so a short one ends
    # where a long one passes; the first that frees the mesh has found what the long one finds.
    vertices = scene.vertices
    surface = Surface(scene.faces, len(vertices))
    sampling = Sampling(None, as_directions(3))

    def on_step(attempt: int, steps: int, pairs: int) -> None:
        if stopped():
            raise Stopped

    for steps in (*_MESH_LOOKS, None):
        looks = {"attempts": 1, "steps_per_attempt": steps, "whole_parts": False}
        most = {} if steps is None else looks
        found = untangle_checked(vertices, surface, sampling, on_step=on_step, **most)
        scene.set_free_vertices(found.vertices)
        show(
            found.vertices,
            f"step {found.steps}, {found.after.intersecting_pairs} intersecting pairs",
        )
        if not found.after.intersecting_pairs:
            return
