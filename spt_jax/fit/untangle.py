"""Freeing a posed body of its self-intersections by moving its joints."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from spt_jax.arguments import MOST_RAYS, as_directions, as_rays
from spt_jax.body import BodyModel
from spt_jax.classes import classify_vertices
from spt_jax.penalty import self_intersection_penalty

# Per cubic centimetre, against squared centimetres of displacement. The first is weak enough that
# the pose slides along the contact rather than jumping out of it; the last leaves about a
# thousandth of the overlap, whatever its size.
_WEIGHTS = (0.01, 0.1, 1.0, 10.0, 100.0)

# Added to the mean squared vertex displacement per squared radian of every joint axis, in m^2.
# Without it the fingers, which move few vertices, may turn through any angle for next to nothing.
# Over six poses 1e-3 gave smaller displacements than 1e-4 at the same overlap (57 against 77 mm).
_STIFFNESS = 1e-3

_CENTIMETRE = 0.01


class Overlap(eqx.Module):
    """How much of a body is in self-intersection.

    Attributes:
        volume: the overlap volume, in m^3.
        ratio: the part of the vertices in it (paper, Eq. 11).
    """

    volume: Float[Array, "*batch"]
    ratio: Float[Array, "*batch"]


class UntangleResult(eqx.Module):
    """What `untangle_pose` found.

    Attributes:
        pose: the pose with the least overlap of all that were measured.
        vertices: the body in that pose, in metres.
        before, after: the overlap of the pose given and of the pose found.
        steps: of the solver, over all weights.
    """

    pose: Float[Array, "*batch J 3"]
    vertices: Float[Array, "*batch V 3"]
    before: Overlap
    after: Overlap
    steps: Int[Array, "*batch"]


def untangle_pose(
    body: BodyModel,
    pose: Float[Array, "*batch J 3"] | Float[np.ndarray, "*batch J 3"],
    *,
    shape: Float[Array, "*#batch B"] | Float[np.ndarray, "*#batch B"] | None = None,
    translation: Float[Array, "*#batch 3"] | Float[np.ndarray, "*#batch 3"] | None = None,
    rays: int = 256,
    directions: int | Float[np.ndarray, "D 3"] = 3,
    weights: tuple[float, ...] = _WEIGHTS,
    steps_per_weight: int = 25,
    tolerance: float = 1e-9,
    solver: optx.AbstractMinimiser | None = None,
    on_step: Callable[[int, int, float], None] | None = None,
) -> UntangleResult:
    """The pose nearest to the one given that is free of self-intersection, as far as it goes.

    For each weight in turn an optimistix minimiser takes

        (rms vertex displacement / cm)^2 + weight * (overlap volume / cm^3)

    from where the last one stopped; the displacement is that of the body's linearisation at the
    pose given, which makes its term a plain sum of squares in the solver's variables. All joints
    move but the root: turning the whole body frees nothing. The overlap is the sum of collisions
    and of the folds that skinning makes at armpits and groins; a deep fold may be traded for a
    visible change of the pose.

    Args:
        body: any `BodyModel`.
        pose: axis-angle, radians; leading axes are solved one after another.
        shape: shape coefficients, held fixed.
        translation: in metres, held fixed.
        rays: rays along the longer side of the screen during the search; what is compared and
            reported is measured with twice as many.
        directions: as in `self_intersection_penalty`.
        weights: rising weights of the overlap.
        steps_per_weight: most steps of the solver for each weight.
        tolerance: an overlap of this volume or less, in m^3, is none; the default is 1 mm^3.
        solver: an optimistix minimiser; BFGS by default.
        on_step: called with the index of the weight, the steps so far and the overlap volume
            whenever a weight is done.

    Returns:
        The pose with the least overlap of those measured after each weight, never worse than the
        one given; a pose without overlap comes back unchanged.

    Raises:
        ValueError: pose of another shape than (..., J, 3) or with values that are not finite;
            shape or translation that is not finite or does not fit pose's batch axes; no weights,
            or weights that are not positive and finite; steps_per_weight not positive; more than
            2048 rays, or fewer than one; directions as in `self_intersection_penalty`.
        TypeError: pose traced; rays or directions that are no numbers.

    Differentiation: none; it runs outside jit, and decides by the values it sees.

    Example:
        >>> from spt_jax import load_body, load_mocap, untangle_pose
        >>> body, mocap = load_body(), load_mocap()
        >>> pose = body.pose_from_smpl(mocap.pose[mocap.names.index("crawl/0092")])
        >>> result = untangle_pose(body, pose, rays=64, weights=(0.1, 1.0))
        >>> bool(result.after.volume < 0.1 * result.before.volume)
        True
    """
    pose = jnp.asarray(pose)
    if pose.shape[-2:] != (body.num_joints, 3):
        raise ValueError(
            f"pose must have shape (..., {body.num_joints}, 3): got {pose.shape}; "
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
    search_rays = as_rays(rays)
    if isinstance(search_rays, tuple) or 2 * search_rays > MOST_RAYS:
        raise ValueError(
            f"rays must be a whole number up to {MOST_RAYS // 2}, half of what is measured with: "
            f"got {rays!r}."
        )
    batch = pose.shape[:-2]
    for name, array in (("shape", shape), ("translation", translation)):
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite: got {np.asarray(array)!r}.")
    search = _Search(
        search_rays, as_directions(directions), solver or optx.BFGS(rtol=1e-3, atol=1e-3)
    )
    poses = pose.reshape(-1, *pose.shape[-2:])
    shapes = _per_pose("shape", shape, batch, len(poses))
    translations = _per_pose("translation", translation, batch, len(poses))
    found = [
        _untangle_one(search, body, *one, weights, steps_per_weight, tolerance, on_step or _nothing)
        for one in zip(poses, shapes, translations, strict=True)
    ]
    if not found:
        raise ValueError(f"pose must hold at least one pose: got shape {pose.shape}.")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves).reshape(*batch, *leaves[0].shape), *found)


class _Search(eqx.Module):
    rays: int = eqx.field(static=True)
    directions: tuple = eqx.field(static=True)
    solver: optx.AbstractMinimiser


def _untangle_one(
    search, body, pose, shape, translation, weights, steps_per_weight, tolerance, on_step
) -> UntangleResult:
    before = _measure(search, body, pose, shape, translation)
    best, least, steps = pose, float(before.volume), 0
    if least > tolerance:
        factor = _displacement_factor(body, pose, shape)
        moved = jnp.zeros(factor.shape[:1], pose.dtype)
        idle = 0
        for stage, weight in enumerate(weights):
            moved, taken = _descend(
                search,
                body,
                (pose, shape, translation, factor),
                moved,
                jnp.asarray(weight, pose.dtype),
                steps_per_weight,
            )
            steps += int(taken)
            candidate = _turned(pose, factor, moved)
            volume = float(_measure(search, body, candidate, shape, translation).volume)
            idle = idle + 1 if not volume < 0.99 * least else 0
            if volume < least:
                best, least = candidate, volume
            on_step(stage, steps, volume)
            # The first weights may be too weak to move anything; two in a row that gain nothing
            # after that mean that it no longer falls.
            if least <= tolerance or (idle >= 2 and stage > 2) or not np.isfinite(volume):
                break
    return UntangleResult(
        pose=best,
        vertices=body(best, shape, translation).vertices,
        before=before,
        after=_measure(search, body, best, shape, translation),
        steps=jnp.asarray(steps),
    )


@eqx.filter_jit
def _measure(search, body, pose, shape, translation) -> Overlap:
    vertices = body(pose, shape, translation).vertices
    options = {"rays": 2 * search.rays, "directions": np.array(search.directions)}
    volume = self_intersection_penalty(vertices, body.faces, **options)
    ratio = classify_vertices(vertices, body.faces, **options).ratio
    return Overlap(volume=volume, ratio=ratio.astype(volume.dtype))


@eqx.filter_jit
def _displacement_factor(body, pose, shape):
    """Cholesky factor of the quadratic form: joint rotations -> mean squared displacement."""
    jacobian = jax.jacfwd(lambda joints: body(pose.at[1:].set(joints), shape).vertices)(pose[1:])
    jacobian = jacobian.reshape(-1, pose[1:].size)
    form = jacobian.T @ jacobian / body.num_vertices
    return jnp.linalg.cholesky(form + _STIFFNESS * jnp.eye(len(form), dtype=form.dtype))


def _turned(pose, factor, moved):
    """The pose whose linearised displacement, in centimetres, has the squared norm of `moved`."""
    turn = jax.scipy.linalg.solve_triangular(factor, moved, trans=1, lower=True)
    return pose.at[1:].add(_CENTIMETRE * turn.reshape(pose[1:].shape))


@eqx.filter_jit
def _descend(search, body, fixed, moved, weight, max_steps):
    def objective(moved, arguments):
        body, (pose, shape, translation, factor), weight = arguments
        vertices = body(_turned(pose, factor, moved), shape, translation).vertices
        volume = self_intersection_penalty(
            vertices, body.faces, rays=search.rays, directions=np.array(search.directions)
        )
        return jnp.sum(moved**2) + weight * volume / _CENTIMETRE**3

    solution = optx.minimise(
        objective, search.solver, moved, (body, fixed, weight), max_steps=max_steps, throw=False
    )
    return solution.value, solution.stats["num_steps"]


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


def _nothing(stage: int, steps: int, volume: float) -> None:
    pass
