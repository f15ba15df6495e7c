"""The poses of one person, frame after frame."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax._camera import PinholeCamera
from spt_jax._result import Result
from spt_jax._status import RESULTS
from spt_jax.body import BodyModel
from spt_jax.fit.options import Search, Stages, Start, Terms
from spt_jax.fit.pose import fit_pose
from spt_jax.fit.problem.learned_priors import pose_prior
from spt_jax.fit.problem.priors import GaussianPosePrior
from spt_jax.fit.regularizers import as_regularizer
from spt_jax.fit.regularizers._base import Regularizer
from spt_jax.fit.result import FitResult
from spt_jax.keypoints import Person, keypoint_regressor

# Frames whose shapes are fitted where the shape is one for all: those of which most was seen.
_SHAPE_FRAMES = 5


class MotionFit(Result):
    """What `fit_motion` found.

    Attributes:
        fits: of each frame in which the person was seen, (T, ...).
        frames: their numbers in the sequence.
        shape: the coefficients that all frames share.
    """

    fits: FitResult
    frames: Int[np.ndarray, "T"]
    shape: Float[Array, "B"]

    @property
    def pose(self) -> Float[Array, "T J 3"]:
        """Axis-angle of every joint in each of these frames, in radians."""
        return self.fits.pose

    @property
    def translation(self) -> Float[Array, "T 3"]:
        """In metres, one a frame."""
        return self.fits.translation

    @property
    def status(self) -> RESULTS:
        """How the fit of each frame ended."""
        return self.fits.status

    def as_dict(self) -> dict[str, Any]:
        """How the fits ended, as JSON types."""
        return {"frames": self.frames.tolist(), **self.fits.as_dict()}


def fit_motion(
    body: BodyModel,
    frames: Sequence[Person | None],
    camera: PinholeCamera,
    *,
    start: Start = Start(),
    terms: Terms = Terms(),
    regularizer: str | Regularizer = "spt",
    search: Search = Search(),
    stages: Stages = Stages(),
    speed: float = 0.15,
    on_frame: Callable[[int, FitResult], None] | None = None,
) -> MotionFit:
    """Find the poses of one person in the frames of a video, each near the one before.

    Each frame is fitted by `fit_pose`. Its prior is the usual one times a Gaussian about the pose
    of the frame before, whose deviation is `speed` for each angle and grows with the root of the
    frames in between, so that depth flips do not alternate. The place and the turn of the whole
    body are not tied: its depth is as uncertain as in a single image, and goes some centimetres to
    and fro. All frames are fitted by the same programs: they are compiled once. `untangle_motion`
    then frees the motion as a whole of what collides.

    Args:
        body: any `BodyModel`.
        frames: the person in each frame, of `read_keypoints`, in one layout; None where not seen.
            `spt_jax.keypoints.find_tracks` follows people from frame to frame.
        camera: the one that sees all frames.
        start: as in `fit_pose`; a pose is where the first frame starts from. With `fit_shape` the
            shape is the median of those of the five frames of which most was seen, and is then held
            fixed in all.
        terms: as in `fit_pose`; the prior must be a Gaussian, or "mocap".
        regularizer, search, stages: as in `fit_pose`.
        speed: how much an angle changes from frame to frame, in radians.
        on_frame: called with the number of each frame and its fit.

    Returns:
        MotionFit.

    Raises:
        TypeError, ValueError: as `fit_pose`; nobody in any frame; layouts that differ; a prior that
            is no Gaussian; a speed that is not positive.

    Differentiation: none; it runs outside jit.

    Example:
        >>> import numpy as np
        >>> from spt_jax import PinholeCamera, load_body, load_mocap
        >>> from spt_jax.fit import fit_motion
        >>> from spt_jax.keypoints import Person
        >>> body, mocap = load_body(), load_mocap()
        >>> camera = PinholeCamera(1000.0, (500.0, 500.0), translation=(0.0, 0.0, 4.0))
        >>> poses = np.array(mocap.pose[mocap.names.index("walk/0010") :][:2])
        >>> poses[:, 0] = [np.pi, 0, 0]  # upright: the image's y points down
        >>> points = np.asarray(camera.project(body(body.pose_from_smpl(poses)).joints[:, :22]))
        >>> frames = [Person(one, np.ones(22), "smpl22") for one in points]
        >>> found = fit_motion(body, [*frames, None], camera, regularizer="none")
        >>> found.frames.tolist(), found.pose.shape
        ([0, 1], (2, 52, 3))
    """
    numbers = [k for k, one in enumerate(frames) if one is not None]
    people = [one for one in frames if one is not None]
    if not people:
        raise ValueError("frames must show the person at least once: got nobody in any of them.")
    layouts = sorted({one.layout for one in people})
    if len(layouts) > 1:
        raise ValueError(f"frames must have one layout: got {', '.join(layouts)}.")
    # Made once for all frames: a regressor reads the body's surface.
    layout = keypoint_regressor(body, layouts[0], count=len(people[0].points))
    term = as_regularizer(regularizer).prepared(body, 1)

    def fit(number: int, begin: Start, prior: GaussianPosePrior) -> FitResult:
        one = people[number]
        return fit_pose(
            body,
            one.points,
            camera,
            layout=layout,
            confidence=one.confidence,
            start=begin,
            terms=_of_frame(terms, prior, number),
            regularizer=term,
            search=search,
            stages=stages,
        )

    usual = as_gaussian(body, terms)
    shape = start.shape
    if start.fit_shape:
        order = np.argsort([-float(one.confidence.sum()) for one in people], kind="stable")
        chosen = order[:_SHAPE_FRAMES].tolist()
        shapes = [np.asarray(fit(number, start, usual).shape) for number in chosen]
        shape = np.median(shapes, axis=0)
    held = dataclasses.replace(start, shape=shape, fit_shape=False)
    fits: list[FitResult] = []
    for number, frame in enumerate(numbers):
        prior, begin = usual, held
        if fits:
            gap = frame - numbers[number - 1]
            prior = near_pose(usual, fits[-1].pose, speed * np.sqrt(gap))
            begin = dataclasses.replace(held, pose=None)
        fits.append(fit(number, begin, prior))
        if on_frame is not None:
            on_frame(frame, fits[-1])
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *fits)
    return MotionFit(together, np.array(numbers), fits[0].shape)


def as_gaussian(body: BodyModel, terms: Terms) -> GaussianPosePrior:
    """The Gaussian of terms, for frames to be tied to each other.

    Raises:
        ValueError: their prior is no Gaussian.
    """
    if isinstance(terms.prior, GaussianPosePrior):
        return terms.prior
    if isinstance(terms.prior, str):
        return pose_prior(body.joint_names)
    raise ValueError(
        'prior must be "mocap" or a GaussianPosePrior for a motion, whose frames are tied to each '
        f"other by it: got {terms.prior!r}."
    )


def near_pose(
    prior: GaussianPosePrior, pose: Float[Array, "J 3"], deviation: float
) -> GaussianPosePrior:
    """A prior times a Gaussian about a pose, with one deviation for all angles, in radians.

    The product of two Gaussians is one: its inverse covariance is the sum of theirs.

    Raises:
        ValueError: the deviation is not positive and finite.
    """
    if not 0 < deviation < np.inf:
        raise ValueError(f"speed must be positive and finite, in radians: got {deviation!r}.")
    if isinstance(pose, Tracer) or not np.isfinite(pose).all():
        return prior
    whitening = np.asarray(prior.whitening, np.float64)
    mean, near = (np.asarray(one, np.float64)[1:].reshape(-1) for one in (prior.mean, pose))
    own, tie = whitening.T @ whitening, np.eye(len(near)) / deviation**2
    both = own + tie
    middle = np.linalg.solve(both, own @ mean + tie @ near).reshape(-1, 3)
    dtype = prior.mean.dtype
    return GaussianPosePrior(
        jnp.asarray(np.concatenate([np.zeros((1, 3)), middle]), dtype),
        jnp.asarray(np.linalg.cholesky(both).T, dtype),
    )


def _of_frame(terms: Terms, prior: GaussianPosePrior, number: int) -> Terms:
    """The terms of one frame, whose scales may be one a frame."""
    scales = {
        name: value if value is None or np.ndim(value) == 0 else np.asarray(value)[number]
        for name, value in (("expected_error", terms.expected_error), ("robust", terms.robust))
    }
    return dataclasses.replace(terms, prior=prior, **scales)
