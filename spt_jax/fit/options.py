"""The options of a fit, by subject: its start, its terms, its search and its descent."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from spt_jax._query import as_margin
from spt_jax.fit.problem.limits import JointLimits
from spt_jax.fit.problem.priors import PosePrior, PriorFunction
from spt_jax.fit.regularizers._base import checked_weights

#: Numbers as users have them: arrays, or lists of them.
Numbers: TypeAlias = ArrayLike | Sequence[Any]
Minimizer: TypeAlias = optx.AbstractMinimiser


def _as_flag(name: str, flag: bool) -> bool:
    if not isinstance(flag, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False: got {flag!r}.")
    return bool(flag)


def _as_count(name: str, number: int) -> int:
    if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < 1:
        raise ValueError(f"{name} must be a whole number of at least 1: got {number!r}.")
    return int(number)


class Start(eqx.Module):
    """Where a fit starts, and what of it is fitted.

    Attributes:
        pose: axis-angle in radians, (..., J, 3); where it is given, no other orientations and depth
            flips are tried. Give the translation, too: it starts at zero otherwise.
        shape: coefficients, (..., B); held fixed, or with `fit_shape` where to start. None: zero.
        translation: in metres, (..., 3); held fixed without `fit_translation`, else found from the
            keypoints, or where to start if `pose` is given too.
        fit_shape, fit_translation: whether to fit them.

    Raises:
        TypeError: fit_shape or fit_translation is neither True nor False.

    Example:
        >>> from spt_jax.fit import Start
        >>> Start(fit_shape=True).fit_shape  # fit_pose(..., start=Start(fit_shape=True))
        True
    """

    pose: Numbers | None = None
    shape: Numbers | None = None
    translation: Numbers | None = None
    fit_shape: bool = eqx.field(
        static=True, default=False, converter=partial(_as_flag, "fit_shape")
    )
    fit_translation: bool = eqx.field(
        static=True, default=True, converter=partial(_as_flag, "fit_translation")
    )


class Terms(eqx.Module):
    """The terms of a fit other than the regularizer, and their weights.

    Attributes:
        prior: "mocap", a Gaussian of the embedded motion capture; one of your own (`pose_prior`, a
            `PosePrior`); a function from axis-angle (J, 3) to an array whose squares are the cost;
            or None.
        limits: "anatomical", the ranges in `joint_limits`; `joint_limits` of your own; or None.
        prior_weight, limits_weight, shape_weight, upright_weight: what each term counts for,
            against a keypoint that is off by its expected error.
        expected_error: of a keypoint, in pixels, one number or one for each person, (...); by None
            a hundredth of the larger side of the box around a person's keypoints.
        robust: Geman-McClure's scale in pixels (rho(x) = x^2 / (1 + (x / scale)^2)), one number or
            one for each person, (...): keypoints much farther off are taken for mistakes. By None
            rho(x) = x^2.

    Raises:
        ValueError: a weight that is negative or not finite, or another prior or limits.

    Example:
        >>> from spt_jax.fit import Terms
        >>> Terms(prior=None, robust=50.0).robust  # pixels
        50.0
    """

    prior: Literal["mocap"] | PosePrior | PriorFunction | None = "mocap"
    limits: Literal["anatomical"] | JointLimits | None = "anatomical"
    prior_weight: float | Float[Array, ""] = 1.0
    limits_weight: float | Float[Array, ""] = 1.0
    shape_weight: float | Float[Array, ""] = 1.0
    upright_weight: float | Float[Array, ""] = 0.25
    expected_error: Numbers | None = None
    robust: Numbers | None = None

    def __check_init__(self):
        for name in ("prior_weight", "limits_weight", "shape_weight", "upright_weight"):
            _check_weight(name, getattr(self, name))
        prior, limits = self.prior, self.limits
        if not (prior is None or _is_prior(prior)):
            raise ValueError(
                'prior must be "mocap", a PosePrior, a function of the pose or None: got '
                f"{prior!r}."
            )
        named = isinstance(limits, str) and limits == "anatomical"
        if not (limits is None or named or isinstance(limits, JointLimits)):
            raise ValueError(f'limits must be "anatomical", JointLimits or None: got {limits!r}.')


class Search(eqx.Module):
    """How the pose is searched that the regularized stages start from, by the keypoints alone.

    Attributes:
        starts: how many orientations to try.
        solver: any optimistix minimiser; a BFGS by default.
        max_steps: of each fit; twice as many where `Start.pose` is given. With 60 all starts of
            eight frames were cut off, and two of them ended in worse minima than those next to the
            truth.

    Raises:
        ValueError: starts or max_steps is no positive whole number.
        TypeError: a solver that is no minimiser.

    Example:
        >>> from spt_jax.fit import Search
        >>> Search(starts=12).max_steps
        120
    """

    starts: int = eqx.field(static=True, default=6, converter=partial(_as_count, "starts"))
    solver: Minimizer | None = None
    max_steps: int = eqx.field(
        static=True, default=120, converter=partial(_as_count, "max_steps of the search")
    )

    def __check_init__(self):
        _check_solver("solver of the search", self.solver)


class Stages(eqx.Module):
    """How the regularized stages descend; the regularizer's weights say how many there are.

    Attributes:
        solver: any optimistix minimiser. By default the self-intersection penalty has a search of
            its own, on the host, which asks for the overlap a few times (`spt_jax/fit/contact`);
            other regularizers, other values of the penalty and traced calls have a BFGS.
        max_steps: of each stage; the search on the host goes on for three times as many in the last
            one, where it has something left to gain.
        free: whether that search goes on after the last stage until no parts intersect, with the
            keypoints, prior and limits in its objective. Only where folds are left out.

    Raises:
        ValueError: max_steps is no positive whole number.
        TypeError: a solver that is no minimiser; free is neither True nor False.

    Example:
        >>> import optimistix as optx
        >>> from spt_jax.fit import Stages
        >>> Stages(optx.LBFGS(1e-3, 1e-3), max_steps=50).max_steps
        50
    """

    solver: Minimizer | None = None
    max_steps: int = eqx.field(
        static=True, default=20, converter=partial(_as_count, "max_steps of the stages")
    )
    free: bool = eqx.field(static=True, default=True, converter=partial(_as_flag, "free"))

    def __check_init__(self):
        _check_solver("solver of the stages", self.solver)


class Scene(eqx.Module):
    """How people who share a scene are fitted together, once each of them has been fitted alone.

    Attributes:
        weights: of the overlap in cm^3, one for each stage of the scene.
        margin: how far apart surfaces are pushed, in metres.
        fold_distance: how near to each other, along the rest surface and in metres, sheets of one
            body are folds; None: the body's own distances, place by place.
        solver: any optimistix minimiser; None for the penalty's own search on the host.
        max_steps: of each stage.

    Raises:
        ValueError, TypeError: weights, margin, solver or max_steps that are none.

    Example:
        >>> from spt_jax.fit import Scene
        >>> len(Scene(margin=0.005).weights)
        5
    """

    weights: tuple[float, ...] = eqx.field(
        static=True,
        converter=lambda given: tuple(checked_weights(given).tolist()),
        default=(0.01, 0.1, 1.0, 10.0, 100.0),
    )
    margin: float = eqx.field(static=True, converter=as_margin, default=0.002)
    fold_distance: float | None = eqx.field(static=True, default=None)
    solver: Minimizer | None = None
    max_steps: int = eqx.field(
        static=True, default=25, converter=partial(_as_count, "max_steps of the scene")
    )

    def __check_init__(self):
        _check_solver("solver of the scene", self.solver)


def _is_prior(prior: Any) -> bool:
    return prior == "mocap" if isinstance(prior, str) else callable(prior)


def _check_weight(name: str, weight: Any) -> None:
    # A JAX scalar may change without compiling anew, and may be traced.
    if isinstance(weight, Tracer):
        return
    known = isinstance(weight, (int, float, np.integer, np.floating, Array))
    if not known or np.ndim(weight) != 0 or not 0 <= float(weight) < np.inf:
        raise ValueError(f"{name} must be a finite number, not negative: got {weight!r}.")


def _check_solver(name: str, given: Any) -> None:
    if given is not None and not isinstance(given, optx.AbstractMinimiser):
        raise TypeError(
            f"{name} must be an optimistix minimiser, such as optimistix.BFGS(1e-3, 1e-3): got "
            f"{type(given).__name__}."
        )


def scalar(weight: float | Array) -> Array:
    """A weight as an array in JAX's default dtype."""
    return jnp.asarray(weight, jnp.zeros(()).dtype)
