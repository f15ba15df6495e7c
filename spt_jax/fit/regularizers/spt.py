"""The self-intersection penalty keeps a fitted body from passing through itself."""

import dataclasses
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from spt_jax._exclusions import as_fold_surface
from spt_jax._geometry import inflate
from spt_jax._groups import join_bodies
from spt_jax._penalty import self_intersection_penalty
from spt_jax._query import as_choice, as_criterion, as_directions, as_margin, as_rays
from spt_jax.body import BodyModel
from spt_jax.fit.problem.variables import Variables
from spt_jax.fit.regularizers._base import Regularizer, as_weights
from spt_jax.overlap.criteria import CRITERIA, Value
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface

_CENTIMETER = 0.01


class SelfIntersection(Regularizer):
    """The self-intersection penalty ("RE + SPT"), of all people together, in cm^3.

    The weights rise from one at which the body slides along a contact to one that leaves next to
    nothing of it.

    Attributes:
        folds: "ignore" leaves out the creases of skin at joints, "count" counts them as overlap.
        fold_distance: how near to each other along the rest surface sheets are folds, in metres;
            None: the body's own distances, place by place.
        margin: how far apart parts are pushed, in metres; 0 measures the surface as it is. As a
            JAX array it may change without compiling anew.
        value, gradient, rule: as in `self_intersection_penalty`. "ratio" with "unit" and "triangle"
            is the paper's term (Eqs. 10 and 11, Algorithm 1), which has no line search: use it with
            `optimistix.GradientDescent`. The ratio is in per cent then, and no gradient of the
            value.
        rays, directions: as in `self_intersection_penalty`.
        rest_surface: set by `prepared`, for one body or several; decides what is a fold.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body, load_mocap
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import SelfIntersection
        >>> body, mocap = load_body(), load_mocap()
        >>> pose = body.pose_from_smpl(jnp.asarray(mocap.pose[mocap.names.index("punch/0017")]))
        >>> person = Variables(pose[None], jnp.zeros((1, body.num_shape)), jnp.zeros((1, 3)))
        >>> every, far = SelfIntersection(folds="count"), SelfIntersection().prepared(body, 1)
        >>> everything, collisions = (t.energy(body, person, person) for t in (every, far))
        >>> bool(everything > collisions > 0)
        True
    """

    name: ClassVar[str] = "spt"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(0.1, 1.0, 10.0))
    _: dataclasses.KW_ONLY
    folds: Literal["ignore", "count"] = eqx.field(static=True, default="ignore")
    fold_distance: float | None = eqx.field(static=True, default=None)
    margin: float | Float[Array, ""] = eqx.field(
        default=0.0, converter=lambda given: given if isinstance(given, Array) else as_margin(given)
    )
    value: Value = eqx.field(static=True, default="volume")
    gradient: Literal["boundary", "vertex", "unit"] = eqx.field(static=True, default="boundary")
    rule: Literal["vertex", "triangle"] = eqx.field(static=True, default="vertex")
    rays: Rays = eqx.field(static=True, default=None, converter=as_rays)
    directions: Any = eqx.field(static=True, default=3, converter=as_directions)
    rest_surface: RestSurface | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        as_choice("folds", self.folds, Literal["ignore", "count"])
        as_criterion(self.value, on_device=False)
        as_choice("gradient", self.gradient, Literal["boundary", "vertex", "unit"])
        as_choice("rule", self.rule, Literal["vertex", "triangle"])

    @property
    def is_plain(self) -> bool:
        """Whether it is the volume with its own gradient, whose root is known by planes."""
        return (self.value, self.gradient, self.rule) == ("volume", "boundary", "vertex")

    def prepared(self, body: BodyModel, people: int) -> "SelfIntersection":
        """With the rest surface that decides what is a fold."""
        if self.folds == "count":
            return self
        surface = as_fold_surface(body, self.fold_distance)
        surface = surface.copies(people) if people > 1 else surface
        return dataclasses.replace(self, rest_surface=surface)

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Overlap of all people with themselves and each other: cm^3, or per cent of vertices."""
        vertices = body(now.pose, now.shape, now.translation).vertices
        scene = join_bodies(vertices, body.faces)
        surface, margin = scene.vertices, self.margin
        if isinstance(margin, Array):  # which may be traced
            surface, margin = inflate(surface, scene.faces, margin / 2), 0.0
        found = self_intersection_penalty(
            surface,
            scene.faces,
            value=self.value,
            gradient=self.gradient,
            rule=self.rule,
            rays=self.rays,
            directions=np.array(self.directions),
            margin=margin,
            rest_surface=self.rest_surface,
        )
        power = CRITERIA[self.value].power
        return found / _CENTIMETER**power if power else found * 100
