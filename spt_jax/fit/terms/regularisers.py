"""What keeps a fitted body from passing through itself: the penalty, and the paper's rivals."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax._exclusions import as_fold_surface
from spt_jax._geometry import inflate
from spt_jax._groups import join_bodies
from spt_jax._penalty import self_intersection_penalty
from spt_jax._query import as_choice, as_directions, as_margin, as_rays
from spt_jax.body import BodyModel
from spt_jax.fit.figure import Variables
from spt_jax.fit.terms.laplacian import MeshLaplacian, laplacian_penalty
from spt_jax.fit.terms.spheres import BodySpheres, sphere_penalty
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface

_CENTIMETRE = 0.01


def as_weights(weights: Any) -> Float[Array, "stages"]:
    """Weights of the stages as an array.

    Raises:
        ValueError: none at all, or negative or not finite ones.
    """
    if isinstance(weights, Tracer):  # as when a regulariser is prepared inside jit
        return jnp.atleast_1d(weights)
    rows = np.atleast_1d(np.asarray(weights, np.float64))
    if rows.ndim != 1 or not rows.size or not np.isfinite(rows).all() or rows.min() < 0:
        raise ValueError(
            f"weights must be finite and not negative, one for each stage: got {weights!r}."
        )
    return jnp.asarray(rows)


class Regulariser(eqx.Module):
    """A term that `fit_pose` adds to the keypoints' in stages, its weight rising.

    Make your own by deriving from it: `energy` gets the parameters of one or several people, with
    one leading axis, in the world's axes, and is differentiated in reverse mode under jit.

    Attributes:
        weights: one for each stage, against a reprojection term in which a keypoint that is off by
            its expected error counts 1.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Regulariser, as_weights
        >>> class Still(Regulariser):
        ...     name = "still"
        ...     weights: jax.Array = eqx.field(converter=as_weights, default=(1.0, 10.0))
        ...
        ...     def energy(self, body, start, now):
        ...         return jnp.sum((now.pose - start.pose) ** 2)
        >>> body = load_body()  # fit_pose(body, ..., regulariser=Still()) takes it
        >>> people = Variables(jnp.zeros((2, 52, 3)), jnp.zeros((2, 10)), jnp.zeros((2, 3)))
        >>> float(Still().energy(body, people, people))
        0.0
    """

    name: ClassVar[str]
    weights: eqx.AbstractVar[Float[Array, "stages"]]

    def prepared(self, body: BodyModel, people: int) -> "Regulariser":
        """Itself with what it has to know of the body; called outside jit."""
        del body, people
        return self

    @abstractmethod
    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """The term without its weight.

        Args:
            body: the model.
            start: the parameters (N, ...) before the first stage.
            now: the parameters (N, ...).
        """


class Nothing(Regulariser):
    """No term: the keypoints, the prior and the limits alone ("RE only")."""

    name: ClassVar[str] = "none"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(0.0,))

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Zero."""
        return jnp.zeros((), now.pose.dtype)


class SelfIntersection(Regulariser):
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
    value: Literal["volume", "ratio"] = eqx.field(static=True, default="volume")
    gradient: Literal["boundary", "vertex", "unit"] = eqx.field(static=True, default="boundary")
    rule: Literal["vertex", "triangle"] = eqx.field(static=True, default="vertex")
    rays: Rays = eqx.field(static=True, default=None, converter=as_rays)
    directions: Any = eqx.field(static=True, default=3, converter=as_directions)
    rest_surface: RestSurface | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        as_choice("folds", self.folds, Literal["ignore", "count"])
        as_choice("value", self.value, Literal["volume", "ratio"])
        as_choice("gradient", self.gradient, Literal["boundary", "vertex", "unit"])
        as_choice("rule", self.rule, Literal["vertex", "triangle"])

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
        return found / _CENTIMETRE**3 if self.value == "volume" else found * 100


class Spheres(Regulariser):
    """Spheres in place of the surface ("RE + SA", Pons-Moll et al. 2015), in cm^2.

    Attributes:
        spheres: `BodySpheres` of the body; fitted to it if None.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Spheres
        >>> body = load_body()
        >>> shape, translation = jnp.zeros((1, body.num_shape)), jnp.zeros((1, 3))
        >>> rest = Variables(jnp.zeros((1, body.num_joints, 3)), shape, translation)
        >>> float(Spheres().prepared(body, 1).energy(body, rest, rest))  # no sphere is in another
        0.0
    """

    name: ClassVar[str] = "spheres"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(0.1, 1.0))
    spheres: BodySpheres | None = None

    def prepared(self, body: BodyModel, people: int) -> "Spheres":
        """With the spheres of the body."""
        if people > 1:
            raise ValueError(
                'regulariser must be "spt" or "none" for several people in one scene: got '
                '"spheres", which knows one body\'s own parts.'
            )
        if self.spheres is not None:
            return self
        return dataclasses.replace(self, spheres=BodySpheres.fit(body))

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Sum of squared depths of the spheres in each other, in cm^2."""
        if self.spheres is None:
            raise ValueError("spheres must be known: call prepared(body, people) first.")
        found = sphere_penalty(self.spheres, body, now.pose, now.shape, now.translation)
        return jnp.sum(found) / _CENTIMETRE**2


class Laplacian(Regulariser):
    """Laplacian regularisation ("RE + LR", Wang et al. 2018), in mm^2.

    What bends the surface costs, wherever it lies: the mean squared change of the Laplacian
    coordinates since the first stage began, in the body's own frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from spt_jax import load_body
        >>> from spt_jax.fit import Variables
        >>> from spt_jax.fit import Laplacian
        >>> body = load_body()
        >>> shape, translation = jnp.zeros((1, body.num_shape)), jnp.zeros((1, 3))
        >>> rest = Variables(jnp.zeros((1, body.num_joints, 3)), shape, translation)
        >>> turned = rest._replace(pose=rest.pose.at[0, 0, 1].set(1.0))
        >>> bent = rest._replace(pose=rest.pose.at[0, 4, 0].set(1.0))
        >>> term = Laplacian().prepared(body, 1)
        >>> [bool(term.energy(body, rest, now) > 0) for now in (turned, bent)]
        [False, True]
    """

    name: ClassVar[str] = "laplacian"
    weights: Float[Array, "stages"] = eqx.field(converter=as_weights, default=(1.0,))
    laplacian: MeshLaplacian | None = None

    def prepared(self, body: BodyModel, people: int) -> "Laplacian":
        """With the neighbours of the body's vertices."""
        if self.laplacian is not None:
            return self
        found = MeshLaplacian.from_faces(np.asarray(body.faces), body.num_vertices)
        return dataclasses.replace(self, laplacian=found)

    def energy(self, body: BodyModel, start: Variables, now: Variables) -> Float[Array, ""]:
        """Mean squared change of the Laplacian coordinates, in mm^2, summed over the people."""
        if self.laplacian is None:
            raise ValueError("laplacian must be known: call prepared(body, people) first.")

        def own_frame(variables: Variables) -> Array:
            pose = variables.pose.at[..., 0, :].set(0.0)
            return body(pose, variables.shape).vertices

        reference = jax.lax.stop_gradient(own_frame(start))
        return jnp.sum(laplacian_penalty(self.laplacian, reference, own_frame(now))) * 1e6


NAMED: dict[str, Callable[[], Regulariser]] = {
    kind.name: kind for kind in (Nothing, SelfIntersection, Spheres, Laplacian)
}


def as_regulariser(regulariser: Any) -> Regulariser:
    """A regulariser, or the one of a name with its usual weights.

    Raises:
        ValueError: an unknown name.
        TypeError: neither a name nor a `Regulariser`.

    Example:
        >>> from spt_jax.fit.terms.regularisers import as_regulariser
        >>> type(as_regulariser("spt")).__name__
        'SelfIntersection'
    """
    if isinstance(regulariser, Regulariser):
        return regulariser
    if isinstance(regulariser, str) and regulariser in NAMED:
        return NAMED[regulariser]()
    listed = ", ".join(repr(name) for name in NAMED)
    kind = ValueError if isinstance(regulariser, str) else TypeError
    raise kind(f"regulariser must be one of {listed}, or a Regulariser: got {regulariser!r}.")
