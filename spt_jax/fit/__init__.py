"""Poses from keypoints: the fit, and what it can be given of your own."""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.fit.motion import MotionFit as MotionFit
    from spt_jax.fit.motion import fit_motion as fit_motion
    from spt_jax.fit.options import Scene as Scene
    from spt_jax.fit.options import Search as Search
    from spt_jax.fit.options import Stages as Stages
    from spt_jax.fit.options import Start as Start
    from spt_jax.fit.options import Terms as Terms
    from spt_jax.fit.people import Penetration as Penetration
    from spt_jax.fit.people import PeopleResult as PeopleResult
    from spt_jax.fit.people import fit_people as fit_people
    from spt_jax.fit.pose import fit_pose as fit_pose
    from spt_jax.fit.problem.learned_priors import mixture_prior as mixture_prior
    from spt_jax.fit.problem.learned_priors import pose_prior as pose_prior
    from spt_jax.fit.problem.limits import JointLimits as JointLimits
    from spt_jax.fit.problem.limits import joint_limits as joint_limits
    from spt_jax.fit.problem.priors import FunctionPosePrior as FunctionPosePrior
    from spt_jax.fit.problem.priors import GaussianPosePrior as GaussianPosePrior
    from spt_jax.fit.problem.priors import MixturePosePrior as MixturePosePrior
    from spt_jax.fit.problem.priors import PosePrior as PosePrior
    from spt_jax.fit.problem.variables import Variables as Variables
    from spt_jax.fit.regularizers import as_regularizer as as_regularizer
    from spt_jax.fit.regularizers import regularizer_names as regularizer_names
    from spt_jax.fit.regularizers._base import Regularizer as Regularizer
    from spt_jax.fit.regularizers._base import as_weights as as_weights
    from spt_jax.fit.regularizers.laplacian import Laplacian as Laplacian
    from spt_jax.fit.regularizers.none import Nothing as Nothing
    from spt_jax.fit.regularizers.spheres import Spheres as Spheres
    from spt_jax.fit.regularizers.spt import SelfIntersection as SelfIntersection
    from spt_jax.fit.result import FitResult as FitResult
    from spt_jax.fit.spheres.model import BodySpheres as BodySpheres

__all__ = [
    "BodySpheres",
    "FitResult",
    "FunctionPosePrior",
    "GaussianPosePrior",
    "JointLimits",
    "Laplacian",
    "MixturePosePrior",
    "MotionFit",
    "Nothing",
    "Penetration",
    "PeopleResult",
    "PosePrior",
    "Regularizer",
    "Scene",
    "Search",
    "SelfIntersection",
    "Spheres",
    "Stages",
    "Start",
    "Terms",
    "Variables",
    "as_regularizer",
    "as_weights",
    "fit_motion",
    "fit_people",
    "fit_pose",
    "joint_limits",
    "mixture_prior",
    "pose_prior",
    "regularizer_names",
]

# Imported when they are first asked for: they bring optimistix, and import this package.
_OPTIONS = "spt_jax.fit.options"
_PRIORS = "spt_jax.fit.problem.priors"
_REGULARIZERS = "spt_jax.fit.regularizers"

__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "BodySpheres": "spt_jax.fit.spheres.model",
        "FitResult": "spt_jax.fit.result",
        "FunctionPosePrior": _PRIORS,
        "GaussianPosePrior": _PRIORS,
        "JointLimits": "spt_jax.fit.problem.limits",
        "Laplacian": f"{_REGULARIZERS}.laplacian",
        "MixturePosePrior": _PRIORS,
        "MotionFit": "spt_jax.fit.motion",
        "Nothing": f"{_REGULARIZERS}.none",
        "Penetration": "spt_jax.fit.people",
        "PeopleResult": "spt_jax.fit.people",
        "PosePrior": _PRIORS,
        "Regularizer": f"{_REGULARIZERS}._base",
        "Scene": _OPTIONS,
        "Search": _OPTIONS,
        "SelfIntersection": f"{_REGULARIZERS}.spt",
        "Spheres": f"{_REGULARIZERS}.spheres",
        "Stages": _OPTIONS,
        "Start": _OPTIONS,
        "Terms": _OPTIONS,
        "Variables": "spt_jax.fit.problem.variables",
        "as_regularizer": _REGULARIZERS,
        "as_weights": f"{_REGULARIZERS}._base",
        "fit_motion": "spt_jax.fit.motion",
        "fit_people": "spt_jax.fit.people",
        "fit_pose": "spt_jax.fit.pose",
        "joint_limits": "spt_jax.fit.problem.limits",
        "mixture_prior": "spt_jax.fit.problem.learned_priors",
        "pose_prior": "spt_jax.fit.problem.learned_priors",
        "regularizer_names": _REGULARIZERS,
    },
)
