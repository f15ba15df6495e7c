"""Poses from keypoints: the fit, and what it can be given of your own."""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.fit.figure import Variables as Variables
    from spt_jax.fit.people import Penetration as Penetration
    from spt_jax.fit.people import PeopleResult as PeopleResult
    from spt_jax.fit.people import fit_people as fit_people
    from spt_jax.fit.pose import fit_pose as fit_pose
    from spt_jax.fit.result import FitResult as FitResult
    from spt_jax.fit.terms.priors import GaussianPosePrior as GaussianPosePrior
    from spt_jax.fit.terms.priors import JointLimits as JointLimits
    from spt_jax.fit.terms.priors import joint_limits as joint_limits
    from spt_jax.fit.terms.priors import pose_prior as pose_prior
    from spt_jax.fit.terms.regularisers import Laplacian as Laplacian
    from spt_jax.fit.terms.regularisers import Regulariser as Regulariser
    from spt_jax.fit.terms.regularisers import SelfIntersection as SelfIntersection
    from spt_jax.fit.terms.regularisers import Spheres as Spheres
    from spt_jax.fit.terms.regularisers import as_weights as as_weights
    from spt_jax.fit.terms.spheres import BodySpheres as BodySpheres

__all__ = [
    "BodySpheres",
    "FitResult",
    "GaussianPosePrior",
    "JointLimits",
    "Laplacian",
    "Penetration",
    "PeopleResult",
    "Regulariser",
    "SelfIntersection",
    "Spheres",
    "Variables",
    "as_weights",
    "fit_people",
    "fit_pose",
    "joint_limits",
    "pose_prior",
]

# Imported when they are first asked for: they bring optimistix, and import this package.
__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "BodySpheres": "spt_jax.fit.terms.spheres",
        "FitResult": "spt_jax.fit.result",
        "GaussianPosePrior": "spt_jax.fit.terms.priors",
        "JointLimits": "spt_jax.fit.terms.priors",
        "Laplacian": "spt_jax.fit.terms.regularisers",
        "Penetration": "spt_jax.fit.people",
        "PeopleResult": "spt_jax.fit.people",
        "Regulariser": "spt_jax.fit.terms.regularisers",
        "SelfIntersection": "spt_jax.fit.terms.regularisers",
        "Spheres": "spt_jax.fit.terms.regularisers",
        "Variables": "spt_jax.fit.figure",
        "as_weights": "spt_jax.fit.terms.regularisers",
        "fit_people": "spt_jax.fit.people",
        "fit_pose": "spt_jax.fit.pose",
        "joint_limits": "spt_jax.fit.terms.priors",
        "pose_prior": "spt_jax.fit.terms.priors",
    },
)
