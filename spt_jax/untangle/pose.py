"""Remove a posed body's self-intersections by moving its joints.

Here is what users call; the search for each pose is in `one_pose.py`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from spt_jax._contact import as_rows
from spt_jax._exclusions import as_fold_surface
from spt_jax._query import MOST_RAYS, as_choice, as_directions, as_margin, as_rays
from spt_jax._steps import OnStep
from spt_jax.body import AbstractBody
from spt_jax.overlap.rays.beam import Rays
from spt_jax.untangle.contacts import is_found
from spt_jax.untangle.descent import SOLVER, Folds, Search, faces_of
from spt_jax.untangle.motion_input import as_positive
from spt_jax.untangle.one_pose import UntangleResult, WantedContacts, untangle_one
from spt_jax.untangle.spread import Surface

# Per cubic centimetre, against squared centimetres of displacement. The first is weak enough that
# the pose slides along the contact rather than jumping out of it; the last leaves about a
# thousandth of the overlap, whatever its size.
_WEIGHTS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


def untangle_pose(
    body: AbstractBody,
    pose: Float[Array, "..."] | Float[np.ndarray, "..."],
    *,
    shape: Float[Array, "*#batch B"] | Float[np.ndarray, "*#batch B"] | None = None,
    translation: Float[Array, "*#batch 3"] | Float[np.ndarray, "*#batch 3"] | None = None,
    folds: Folds = "ignore",
    fold_distance: float | None = None,
    margin: float = 0.002,
    rays: int | None = None,
    directions: int | Float[np.ndarray, "D 3"] = 3,
    weights: tuple[float, ...] = _WEIGHTS,
    steps_per_weight: int = 25,
    tolerance: float = 1e-9,
    solver: optx.AbstractMinimiser | None = None,
    contacts: Any = None,
    contact_distance: float = 0.02,
    contact_weight: float = 20.0,
    on_step: OnStep | None = None,
) -> UntangleResult:
    """The pose nearest to the one given in which no body parts collide, as far as it goes.

    For each weight in turn an optimistix minimiser takes

        (rms vertex displacement / cm)^2 + weight * (overlap volume / cm^3)

    from where the last one stopped, until no two parts of the surface intersect; the displacement
    is that of the body's linearisation at the pose given, which makes its term a plain sum of
    squares in the solver's variables. All joints move but the root: turning the whole body frees
    nothing. The overlap is that of the surface moved outwards by half of `margin`. Where the
    weights leave collisions, the last ones are tried again with two and four times the margin.
    Where they still do, or the vertices moved by more than 60 mm (root mean square), a limb may
    have passed through another part: it is swung to sides on which nothing collides, the nearest
    of them are freed again, and what moves the body least is taken.

    Args:
        body: a `BodyModel`, a `RigModel`, or what `spt_jax.body.adapt` returns.
        pose: axis-angle, radians; leading axes are solved one after another.
        shape: shape coefficients, held fixed.
        translation: in metres, held fixed.
        folds: what happens to overlaps of sheets that lie near each other on the rest surface,
            the creases that skinning makes at armpits, elbows and groins. "ignore": they are left
            as they are, and a pose that has only those comes back unchanged. "remove": the pose
            is freed of collisions, then `untangle_mesh` moves the vertices until the surface
            intersects itself nowhere. "count": they are no different from collisions; the pose has
            to open them, at the price of a visible change, and no margin is kept.
        fold_distance: how near to each other, along the rest surface and in metres, sheets are
            folds; everywhere the same. None: `body.rest_surface` says, place by place.
        margin: how far apart colliding parts are pushed, in metres.
        rays: as in `self_intersection_penalty`; a number is what the search uses, and what is
            compared and reported is measured with twice as many.
        directions: as in `self_intersection_penalty`.
        weights: rising weights of the overlap.
        steps_per_weight: most steps of the solver for each weight.
        tolerance: an overlap of this volume or less, in m^3, counts as none where no faces
            intersect; the default is 1 mm^3.
        solver: an optimistix minimiser; by default `contact_solver.ContactSolver`, which asks for
            the overlap a quarter as often as `optimistix.BFGS` (benchmarks/results.md).
        contacts: contact that is to be kept, hands that clap or arms that are crossed: pairs of
            patches as `contact_penalty` takes them, or "found", those of `find_contacts` in the
            pose given. Pairs within `contact_distance` of each other in the pose given are held as
            near as they were, or at the margin where they were nearer or intersected.
        contact_distance: in metres.
        contact_weight: what the squared distance of a pair beyond that weighs, in cm^2, against the
            squared displacement; 0 lets contacts go.
        on_step: called with a `spt_jax.Step` after each step of the solver; what it raises ends the
            search. The solver's loop then runs in Python.

    Returns:
        The pose with the fewest intersecting pairs, and of those the least overlap, among those
        measured after each weight, never worse than the one given; a pose in which nothing collides
        comes back unchanged. `status` says how it ended, `is_free` whether nothing collides any
        more. Where the solver runs away, to numbers that are not finite or to joints turned by more
        than a full turn, that place is not taken, and the next weight starts from the last one that
        could be measured.

    Raises:
        ValueError: pose of another shape than (..., J, 3) or with values that are not finite;
            shape or translation that is not finite or does not fit pose's batch axes; no weights,
            or weights that are not positive and finite; steps_per_weight not positive; more than
            2048 rays, or fewer than one; an unknown way with folds; margin or fold_distance
            negative or not finite; another word for contacts; directions as in
            `self_intersection_penalty`; `spt_jax.overlap.measure.Unmeasurable` for a pose given in
            which the body has no surface that could be measured.
        TypeError: pose traced; rays, margin, fold_distance or directions that are no numbers.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> from spt_jax import load_body, load_mocap, untangle_pose
        >>> body, mocap = load_body(), load_mocap()
        >>> pose = body.pose_from_smpl(mocap.pose[mocap.names.index("cartwheel/0103")])
        >>> result = untangle_pose(body, pose)
        >>> int(result.before.intersecting_pairs) > 0, int(result.after.intersecting_pairs)
        (True, 0)
        >>> result.reason
        'collision-free'
    """
    pose = jnp.asarray(pose)
    one = body.pose_shape
    if pose.shape[-len(one) :] != one:
        raise ValueError(
            f"pose must have shape (..., {', '.join(map(str, one))}): got {pose.shape}; "
            "body.pose_from_smpl converts poses of other joint counts."
        )
    if isinstance(pose, Tracer):
        raise TypeError(
            "pose must be known: got a traced array; untangle_pose decides by the values that it "
            "sees, so call it outside jit, vmap and grad."
        )
    if not np.isfinite(pose).all():
        raise ValueError(
            f"pose must be finite: got {int(np.sum(~np.isfinite(pose)))} values that are not; "
            "leave such frames out."
        )
    weights = tuple(float(weight) for weight in np.atleast_1d(np.asarray(weights, np.float64)))
    if not weights or not all(0 < weight < np.inf for weight in weights):
        raise ValueError(f"weights must be positive and finite, at least one: got {weights!r}.")
    if not isinstance(steps_per_weight, (int, np.integer)) or steps_per_weight < 1:
        raise ValueError(
            f"steps_per_weight must be a positive whole number: got {steps_per_weight!r}."
        )
    batch = pose.shape[: pose.ndim - len(one)]
    for name, array in (("shape", shape), ("translation", translation)):
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite: got {np.asarray(array)!r}.")
    way = as_choice("folds", folds, Folds)
    rest = None if way == "count" else as_fold_surface(body, fold_distance)
    search = Search(
        rays=_as_search_rays(rays),
        directions=as_directions(directions),
        folds=way,
        margin=0.0 if way == "count" else as_margin(margin),
        weights=weights,
        steps_per_weight=int(steps_per_weight),
        tolerance=float(tolerance),
        solver=solver or SOLVER,
        rest=rest,
    )
    wanted = WantedContacts(
        contacts,
        as_positive("contact_distance", contact_distance, zero=True),
        as_positive("contact_weight", contact_weight, zero=True),
        rest,
    )
    if contacts is not None and not is_found(contacts):
        as_rows(contacts, faces_of(body))  # refused before anything is searched
    poses = list(map(jnp.asarray, np.asarray(pose).reshape(-1, *one)))
    shapes = _per_pose("shape", shape, batch, len(poses))
    translations = _per_pose("translation", translation, batch, len(poses))
    surface = Surface(np.asarray(body.faces), body.num_vertices) if way == "remove" else None
    found = [
        untangle_one(search, surface, body, *one, wanted, on_step)
        for one in zip(poses, shapes, translations, strict=True)
    ]
    if not found:
        raise ValueError(f"pose must hold at least one pose: got shape {pose.shape}.")
    return jax.tree.map(lambda *leaves: _stacked(leaves, batch), *found)


def _stacked(leaves: tuple[Array | np.ndarray, ...], batch: tuple[int, ...]) -> Array:
    # In NumPy: of each shape JAX would compile a program.
    return jnp.asarray(
        np.stack([np.asarray(x) for x in leaves]).reshape((*batch, *leaves[0].shape))
    )


def _as_search_rays(rays: Any) -> Rays:
    search_rays = as_rays(rays)
    if isinstance(search_rays, tuple) or (
        isinstance(search_rays, int) and 2 * search_rays > MOST_RAYS
    ):
        raise ValueError(
            f"rays must be None or a whole number up to {MOST_RAYS // 2}, half of what is "
            f"measured with: got {rays!r}."
        )
    return search_rays


def _per_pose(name, array, batch, count):
    if array is None:
        return [None] * count
    array = jnp.asarray(array)
    try:
        spread = jnp.broadcast_to(array, (*batch, array.shape[-1]))
    except (IndexError, ValueError):
        raise ValueError(
            f"{name} must be one vector, or have pose's batch axes {batch} in front: got shape "
            f"{array.shape}."
        ) from None
    return list(spread.reshape(count, array.shape[-1]))
