"""A motion and what became of it, side by side: what stands beside, and what plays both."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from spt_jax.body import AbstractBody
from spt_jax.untangle.motion import untangle_motion
from spt_jax.untangle.motion_run import MotionStep
from spt_jax.view.files import Frames
from spt_jax.view.freeing import Stopped
from spt_jax.view.scene import Reading, Scene
from spt_jax.view.worker import Worker


class Beside:
    """The same body in other poses, frame by frame, beside what is bent and measured.

    Args:
        body: of both.
        name: what it is called.
        motions: by the name of the motion beside which each stands; beside others is nothing.
    """

    def __init__(self, body: AbstractBody, name: str, motions: dict[str, Frames]):
        self.scene = Scene.of_body(body, name)
        self.motions = motions
        self._at: tuple[str, int] | None = None
        self._known: tuple[tuple, Reading] | None = None

    def load(self, motion: str, row: int) -> None:
        """Take a frame."""
        frames = self.motions.get(motion)
        self._at = None if frames is None else (motion, row)
        if frames is not None:
            frames.load_into(self.scene, row)

    def read(self, like: Scene) -> Reading | None:
        """Measure it as another scene is measured; None where nothing stands there."""
        if self._at is None:
            return None
        self.scene.count_folds, self.scene.paper = like.count_folds, like.paper
        wanted = (*self._at, like.count_folds, like.paper)
        if self._known is None or self._known[0] != wanted:
            self._known = wanted, self.scene.read()
        return self._known[1]


def matched(motions: dict[str, Frames], others: dict[str, Frames]) -> dict[str, Frames]:
    """The motions of a second file under the names of the first's, person by person.

    Raises:
        ValueError: there are not as many people, or frames.
    """
    if len(motions) != len(others):
        raise ValueError(
            f"beside must have as many people as file: got {len(motions)} and {len(others)}."
        )
    found = {}
    for (name, one), other in zip(motions.items(), others.values(), strict=True):
        if len(one.names) != len(other.names):
            raise ValueError(
                f"beside must have as many frames as file: got {len(one.names)} of {name!r} and "
                f"{len(other.names)}."
            )
        found[name] = other
    return found


def freed(
    body: AbstractBody, frames: Frames, show: Callable[[str], None], stopped: Callable[[], bool]
) -> tuple[Frames, str]:
    """The motion that `untangle_motion` makes of one, and its outcome in a line.

    Args:
        body, frames: the motion.
        show: called with a line of text from time to time.
        stopped: asked as often.

    Raises:
        Stopped: the user has had enough.
    """

    def on_step(step: MotionStep) -> None:
        if stopped():
            raise Stopped
        at = f"frame {step.done} of {step.frames}"
        show(f"{step.stage}: {at}, {step.colliding} collide" if step.colliding else at)

    shape = frames.shape
    if shape is not None:
        shape = np.pad(shape, ((0, 0), (0, body.num_shape - shape.shape[1]))).astype(np.float32)
    place = frames.translation
    result = untangle_motion(
        body,
        frames.pose,
        shape=shape,
        translation=None if place is None else place.astype(np.float32),
        frames_per_second=frames.rate,
        on_step=on_step,
    )
    free, count = int(np.count_nonzero(np.asarray(result.is_free))), len(frames.names)
    text = f"{free} of {count} frames are free, {int(result.moved.sum())} were moved"
    return replace(frames, pose=np.asarray(result.pose)), text


class Player:
    """Has a view go on from frame to frame, as fast as the motion is or as the view can.

    Args:
        worker: the view's.
        advance: called on the worker's thread with how many frames have gone by.
        rate: asked for the frames a second of what is shown.
    """

    def __init__(self, worker: Worker, advance: Callable[[int], None], rate: Callable[[], float]):
        self._worker, self._advance, self._rate = worker, advance, rate
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def play(self, wanted: bool) -> None:
        """Begin, or end."""
        self._ended.set()
        self._ended = threading.Event()
        if wanted:
            arguments = (self._ended,)
            self._thread = threading.Thread(
                target=self._run, args=arguments, name="spt_jax play", daemon=True
            )
            self._thread.start()

    def _run(self, ended: threading.Event) -> None:
        last = time.monotonic()
        while not ended.wait(max(0.0, last + 1 / self._rate() - time.monotonic())):
            # Not before the last frame is shown: what cannot keep up leaves frames out.
            if not self._worker.wait_until_idle(0.1):
                continue
            now = time.monotonic()
            gone = max(int((now - last) * self._rate()), 1)
            last = max(last + gone / self._rate(), now - 1.0)
            self._worker.post("frame", lambda gone=gone: self._advance(gone))
