"""The penalty: overlap volume or the paper's ratio, with a gradient that comes from geometry."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Integer

from spt_jax._exclusions import as_exclusions
from spt_jax._geometry import inflate
from spt_jax._query import (
    as_backend,
    as_choice,
    as_criterion,
    as_directions,
    as_faces,
    as_margin,
    as_rays,
    as_vertices,
)
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.bridge.callback import call_on_host, is_local
from spt_jax.bridge.reverse_only import refuse_forward, with_slope
from spt_jax.bridge.second_order import Products, product, with_hessian
from spt_jax.overlap.criteria import Value
from spt_jax.overlap.host_curvature import curvature_on_host, kept_on_host
from spt_jax.overlap.host_functions import (
    PenaltyOptions,
    value_and_gradient_on_host,
    value_on_host,
)
from spt_jax.overlap.measure import Gradient, Rule, Sampling
from spt_jax.overlap.rays.beam import Rays
from spt_jax.rest.surface import RestSurface
from spt_jax.xla.backend import Program, Task, as_task, penalty_on_device
from spt_jax.xla.holes import closed_on_device
from spt_jax.xla.settings import Xla


def self_intersection_penalty(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    *,
    value: Value = "volume",
    gradient: Gradient = "boundary",
    rule: Rule = "vertex",
    rays: Rays = None,
    directions: Any = 3,
    margin: float = 0.0,
    face_groups: Integer[Array, "F"] | np.ndarray | None = None,
    ignore_groups: Any = (),
    rest_surface: RestSurface | None = None,
    backend: str | Xla = "auto",
    second_order: bool = False,
) -> Float[Array, "*batch"]:
    r"""Volume of a closed mesh's self-intersection, as a loss with its own exact gradient.

    With w the winding number, the volume is the integral of w (w - 1) / 2 over space: every two
    solids that overlap in a place count once there. That is the paper's Eq. 1 where two overlap
    (it stops at two); where three do it is 3, and where the surface is inside out 1. So it is a sum
    over pairs: that within each of several bodies and that between them add up to the whole. It
    is exact at any depth, in contact and for parts that coincide, from the triangles alone, or with
    `rays` the paper's sampling (section 3.2): the mean over directions of the overlapped length on
    the rays times the area of a ray. Without overlap, value and gradient are exactly zero; surfaces
    that only touch, but for rounding, do not overlap.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside. The mesh
            must be closed and consistently wound (see `check_mesh`); it need not be connected.
            Holes are closed by a fan to the mean of their boundary's vertices, if they are small
            beside the part around them (`check_mesh`); an open sheet encloses nothing: NaN.
        value: "volume", in the cube of the unit, or "ratio", the paper's Eq. 11: the part of the
            vertices in self-intersection, piecewise constant and not what the gradient derives.
        gradient: "boundary", the derivative of the volume; "vertex", the paper's Eq. 9, which
            takes each triangle as wholly in or out; "unit", its Eq. 10, of length one at every
            vertex in self-intersection.
        rule: how "ratio", "vertex" and "unit" label the vertices, as in `classify_vertices`.
        rays: None computes the volume in closed form, exact to rounding, so that it is smooth and
            its gradient exact, however the mesh is turned. (Should the sums of the closed form not
            close, which no closed mesh has been seen to do, 512 rays a side take over;
            `intersection_report` says so.) A number of rays along the longer side of the screen, or
            (rows, columns), samples it as the paper does.
        directions: of the rays, where any are cast: 1 (along -z, the paper's camera), 3 orthogonal
            ones, or the rows of a D x 3 array. With one, "boundary" is the exact derivative of the
            sampled volume; with several, crossings are weighed by how well their direction sees the
            triangle, which is closer to the limit of many rays.
        margin: how far apart sheets shall be, in the vertices' unit. What is measured is the
            surface moved outwards by half of it, `spt_jax.inflate`: where that no longer
            overlaps, value and gradient are zero and sheets that face each other are `margin`
            apart. Concave creases narrower than the margin fold when moved, and count.
        face_groups: a whole number for each triangle: its body part or person
            (`body.part_groups`, `join_bodies`).
        ignore_groups: pairs of groups whose overlaps are excluded, such as ((0, 0), (1, 1)) for
            "only between the two people". Between groups that are closed by themselves that is
            exact at any depth: what is within and what is between add up to the whole, to
            rounding. Groups that are parts of one surface are judged by
            their contours, as folds are.
        rest_surface: the surface at rest (`body.rest_surface`), to leave out folds. Intersecting
            triangles that are near each other along it (within 0.3 m on trunk and limbs, 2 to 4 cm
            on fingers) are a fold of the skin, made by bending. An overlap region counts by the
            fraction of its intersection contour's length that is not a fold: entirely for two
            limbs, not at all for the crease of an elbow. The fraction is differentiated too. Parts
            that are enclosed in each other at rest, as eyeballs in a head, are excluded. None:
            every overlap counts.
        backend: "numpy": on the host; "xla", or `spt_jax.xla.Xla` with the sizes of its
            arrays: in JAX alone, where the vertices are; "auto": "numpy", also where JAX runs on a
            GPU or TPU, since that alone is exact. "xla" measures by rays, 512 by default, and
            decides folds and groups by what the rays meet (`spt_jax.xla`; `python -m
            benchmarks.device` prints how far off it is). It closes holes where every overlap counts
            and the faces are known; else rays through a hole are left out, with a warning.
        second_order: whether the volume has its own second derivatives, and forward mode. They are
            exact wherever the volume has them: everywhere but where surfaces touch. A product with
            the Hessian costs a fifth of the gradient that it comes with, with a margin as much as
            that (`python -m benchmarks.second_order`). Only for the exact volume and gradient.

    Returns:
        One number per mesh, in the vertices' dtype. A volume that the dtype cannot distinguish from
        zero is zero, with a zero gradient. NaN, with a zero gradient, where value or gradient are
        more than the dtype can hold, or there is no surface to measure: a vertex is not finite, a
        traced face is out of range, the mesh is smaller than 1024 units in the last place of its
        coordinates, or so crumpled that more than 20 pairs of triangles to a triangle (and
        2,000,000) are near each other.

    Raises:
        TypeError: vertices not float32 or float64; faces or groups not whole numbers; rays,
            directions, margin or groups that are no numbers, or are traced; a rest_surface of
            another type.
        ValueError: wrong shapes; a face out of range; rays not positive; directions zero or not
            finite; a margin that is negative or not finite; groups or a rest surface that do not
            fit the faces; an unknown option; second_order with anything but the exact volume and
            its gradient.

    Differentiation: reverse mode (`jax.grad`, `jax.vjp`, `jac="bwd"` in optimistix) with respect to
        vertices. Forward mode (`jax.jvp`, `jax.jacfwd`, calling what `jax.linearize` returns) is
        refused by name. The gradient is computed with the value and held fixed: in second
        derivatives the penalty E counts as linear, so that the Hessian of f(E) is f''(E) g g^T with
        g its gradient: 2 g g^T for its square, without f'(E) times the curvature of E itself. With
        `second_order=True` every mode works, to second order with E's own curvature
        (`jax.jvp(jax.grad(loss))`, `jax.hessian`); third derivatives leave out that of E. With
        a margin, every kind of gradient is that of the moved surface, carried back to `vertices` by
        the chain rule. A batch that is sharded over devices stays so; inside `jax.shard_map` pass
        it check_vma=False. `jax.export` holds `backend="xla"` alone and refuses the others by name.

    Example:
        >>> import jax, trimesh
        >>> from spt_jax import self_intersection_penalty
        >>> box = trimesh.creation.box()
        >>> pair = trimesh.util.concatenate(box, box.copy().apply_translation([0.6, 0.0, 0.0]))
        >>> vertices = jax.numpy.asarray(pair.vertices, "float32")
        >>> loss = lambda v: self_intersection_penalty(v, pair.faces)
        >>> volume, gradient = jax.value_and_grad(loss)(vertices)
        >>> print(f"{volume:.2f}")
        0.40
        >>> push = gradient[8:].sum(axis=0)  # how the overlap grows when the second box moves
        >>> print(f"{push[0]:.1f}")
        -1.0
    """
    vertices = as_vertices(vertices)
    faces = as_faces(faces, vertices.shape[-2])
    apart = as_margin(margin)
    options = PenaltyOptions(
        as_criterion(value, as_backend(backend) is not None),
        as_choice("gradient", gradient, Gradient),
        as_choice("rule", rule, Rule),
        Sampling(as_rays(rays), as_directions(directions)),
        as_exclusions(face_groups, ignore_groups, rest_surface, faces),
        float(np.finfo(vertices.dtype).eps),
        apart / 2,
    )
    device = as_backend(backend)
    if second_order:
        _check_has_curvature(options, device)
        if apart:  # through JAX, which has the second derivatives of what moves the surface
            vertices = inflate(vertices, faces, apart / 2)
        options = options._replace(outwards=0.0)
        if isinstance(faces, Tracer):
            return _curved(options, None, vertices, faces)
        return _curved(options, Known(np.asarray(faces)), vertices, ())
    if apart and device is not None:
        vertices = inflate(vertices, faces, apart / 2)
    vertices = refuse_forward(vertices)
    if device is not None:
        program = Program(device, options.sampling.rays, options.value, None, options.rule)
        task = as_task(program, options.sampling, vertices.dtype, options.exclusions)
        way = program, options.gradient
        too_large = None
        if (options.value, options.gradient) == ("volume", "boundary"):
            whole = not options.exclusions.any
            vertices, faces, too_large = closed_on_device(vertices, faces, everything=whole)
        found = _on_device(way, vertices, jnp.asarray(faces), task.tables)
        return found if too_large is None else jnp.where(too_large, jnp.nan, found)
    if isinstance(faces, Tracer):
        return differentiable(options, None, vertices, faces)
    return differentiable(options, Known(np.asarray(faces)), vertices, ())


def paper_penalty(
    vertices: Float[Array, "*batch V 3"] | np.ndarray,
    faces: Integer[Array, "F 3"] | np.ndarray,
    *,
    rays: int | tuple[int, int] = 512,
    normalize: bool = True,
    backend: str | Xla = "auto",
) -> Float[Array, "*batch"]:
    """The paper to the letter: one direction, Algorithm 1, the ratio, Eq. 10 or 9.

    The value is Eq. 11, the fraction of the vertices that are penetrating or inverted (V_out or
    V_in). The gradient is Eq. 10 (`normalize`) or Eq. 9. They are not each other's derivative, so a
    line search on this pair fails; it is meant for plain gradient descent. For anything else use
    `self_intersection_penalty`.

    Args:
        vertices: positions of one mesh or of a batch that shares its faces, in any unit.
        faces: indices of each triangle's corners, counter-clockwise seen from outside.
        rays: rays along the longer side of the screen, or (rows, columns).
        normalize: Eq. 10, unit vectors, rather than Eq. 9, a third of the area normals.
        backend: as in `self_intersection_penalty`.

    Returns:
        One ratio per mesh, in the vertices' dtype; NaN for vertices that are not finite.

    Raises:
        TypeError, ValueError: as `self_intersection_penalty`.

    Differentiation: as `self_intersection_penalty`.

    Example:
        >>> import jax.numpy as jnp, trimesh
        >>> from spt_jax import paper_penalty
        >>> box = trimesh.creation.box()
        >>> print(paper_penalty(jnp.asarray(box.vertices, "float32"), box.faces))
        0.0
    """
    return self_intersection_penalty(
        vertices,
        faces,
        value="ratio",
        gradient="unit" if normalize else "vertex",
        rule="triangle",
        rays=rays,
        directions=1,
        backend=backend,
    )


class Known(NamedTuple):
    """Faces whose values are known: no operand, and nothing to differentiate."""

    faces: np.ndarray


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def differentiable(options, known, vertices, traced):
    """What the host measures, for options of the penalty's or of a sheet's kind, with its gradient.

    Args:
        options: hashable, of `host_functions`.
        known: the faces where their values are known; else None.
        vertices: positions, with any batch axes.
        traced: the faces where they are traced; else ().
    """
    faces = traced if known is None else known.faces
    (value,) = call_on_host(value_on_host, options, (_scalar(vertices),), vertices, faces)
    return value


def _penalty_forward(options, known, vertices, traced):
    faces = traced if known is None else known.faces
    results = (_scalar(vertices), (vertices.shape[-2:], vertices.dtype.name))
    # The residual is the gradient: the backward pass never calls the host.
    value, gradient = call_on_host(value_and_gradient_on_host, options, results, vertices, faces)
    return with_slope(vertices, value, gradient), gradient


def _penalty_backward(options, known, gradient, cotangent):
    return _scaled(gradient, cotangent), None


differentiable.defvjp(_penalty_forward, _penalty_backward)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _curved(options, known, vertices, traced):
    faces = traced if known is None else known.faces
    (value,) = call_on_host(value_on_host, options, (_scalar(vertices),), vertices, faces)
    return value


@_curved.defjvp
def _curved_jvp(options, known, primals, tangents):
    vertices, traced = primals
    faces = traced if known is None else known.faces
    results = (_scalar(vertices), (vertices.shape[-2:], vertices.dtype.name))
    value, gradient = call_on_host(kept_on_host, options, results, vertices, faces)
    hessian = Products(curvature_on_host, options, None if known is None else known.faces)
    gradient = with_hessian(hessian, vertices, gradient, traced)
    return with_slope(vertices, value, gradient), product(gradient, tangents[0])


def _check_has_curvature(options: PenaltyOptions, device: Xla | None) -> None:
    wanted = {"value": "volume", "gradient": "boundary"}
    given = {"value": options.value, "gradient": options.gradient}
    if given != wanted or options.sampling.rays is not None or device is not None:
        raise ValueError(
            'second_order must come with the exact volume: value="volume", gradient="boundary", '
            f'rays=None and backend="numpy" or "auto"; got value={options.value!r}, '
            f"gradient={options.gradient!r}, rays={options.sampling.rays!r} and "
            f"{'the host' if device is None else 'the device'}."
        )


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _differentiable_on_device(way, vertices, faces, tables):
    return penalty_on_device(vertices, faces, Task(way[0], tables))[0]


def _forward_on_device(way, vertices, faces, tables):
    program, kind = way
    task = Task(program._replace(gradient=kind), tables)
    value, gradient = penalty_on_device(vertices, faces, task)
    return with_slope(vertices, value, gradient), gradient


def _backward_on_device(way, gradient, cotangent):
    return _scaled(gradient, cotangent), None, None


_differentiable_on_device.defvjp(_forward_on_device, _backward_on_device)
_on_device = BoundedJit(_differentiable_on_device)


def _scaled(gradient, cotangent):
    # where, not a product alone: an infinite cotangent must not turn a zero gradient into NaN.
    if is_local(gradient) and is_local(cotangent):  # nothing to compile
        known = np.asarray(gradient)
        with np.errstate(all="ignore"):
            product = np.asarray(cotangent)[..., None, None] * known
        return jax.device_put(np.where(known == 0, np.zeros_like(known), product))
    product = cotangent[..., None, None] * gradient
    return jnp.where(gradient == 0, jnp.zeros_like(product), product)


def _scalar(vertices):
    return (), vertices.dtype.name
