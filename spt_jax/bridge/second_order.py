"""A gradient that the host knows, with the Hessian as a linear map that the host knows too.

`with_hessian` is the gradient again, whose derivative along a velocity is the Hessian times that.
The product is a primitive of our own: it is linear in the velocity and symmetric, so that its
transpose is itself, and reverse mode goes through it as well as forward mode does. Its derivative
with respect to the vertices, a third derivative, counts as zero.
"""

from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from spt_jax.bridge.batches import lanes_as_meshes
from spt_jax.bridge.callback import call_on_host
from spt_jax.bridge.on_host import HostFunction


class Products:
    """A Hessian's products with velocities, of one question about meshes.

    Args:
        function: takes vertices and, after them, as many rows of the velocity; see `Work`.
        options: handed on as they are.
        faces: where they are known.
    """

    def __init__(self, function: HostFunction, options: Hashable, faces: np.ndarray | None):
        self.function, self.options, self.faces = function, options, faces

    def __repr__(self) -> str:
        return self.function.__name__

    def __call__(self, vertices: Array, velocity: Array, *faces: Array) -> Array:
        """Products for a list of meshes (N, V, 3), whose faces are (1 or N, F, 3)."""
        results = ((vertices.shape[-2:], vertices.dtype.name),)
        both = jnp.concatenate([vertices, velocity], axis=-2)

        def called(both, corners):
            return call_on_host(self.function, self.options, results, both, corners)[0]

        if self.faces is not None:
            return called(both, self.faces)
        if faces[0].shape[0] == 1:
            return called(both, faces[0][0])
        return jax.vmap(called)(both, faces[0])


def with_hessian(
    hessian: Products,
    vertices: Float[Array, "*batch V 3"],
    gradient: Float[Array, "*batch V 3"],
    faces: Any = (),
) -> Float[Array, "*batch V 3"]:
    """The gradient, whose derivative along a velocity of the vertices is the Hessian times that.

    Args:
        hessian: its products.
        vertices: where the gradient is taken.
        gradient: a constant.
        faces: where they are traced.
    """
    return _with_hessian(hessian, vertices, jax.lax.stop_gradient(gradient), faces)


def product(
    gradient: Float[Array, "*batch V 3"], change: Float[Array, "*batch V 3"]
) -> Float[Array, "*batch"]:
    """The derivative along a change of the vertices, to be derived again."""
    # An infinite tangent, as of sqrt at no overlap, must not turn a zero gradient into NaN. Only
    # that of a whole mesh: one component's own derivative need not be zero where it is.
    nothing = (gradient == 0).all(axis=(-2, -1), keepdims=True)
    return (gradient * jnp.where(nothing, jnp.zeros_like(change), change)).sum(axis=(-2, -1))


def _curved(hessian, vertices, gradient, faces):
    return gradient


def _curved_jvp(hessian, primals, tangents):
    vertices, _, faces = primals
    batch = vertices.shape[:-2]
    flat = vertices.reshape(-1, *vertices.shape[-2:])
    change = tangents[0].reshape(flat.shape)
    operands = (faces[None],) if isinstance(faces, (Tracer, jax.Array)) else ()
    found = _times.bind(flat, change, *operands, hessian=hessian)
    return _with_hessian(hessian, *primals), found.reshape(*batch, *vertices.shape[-2:])


_with_hessian = jax.custom_jvp(_curved, nondiff_argnums=(0,))
_with_hessian.defjvp(_curved_jvp)

_times = Primitive("spt_jax_hessian_times")


@_times.def_impl
def _run(vertices, velocity, *faces, hessian):
    return hessian(vertices, velocity, *faces)


@_times.def_abstract_eval
def _shape(vertices, velocity, *faces, hessian):
    return ShapedArray(velocity.shape, velocity.dtype)


def _times_jvp(primals, tangents, *, hessian):
    vertices, velocity, *faces = primals
    found = _times.bind(vertices, velocity, *faces, hessian=hessian)
    change = tangents[1]
    if isinstance(change, ad.Zero):
        return found, change
    return found, _times.bind(vertices, change, *faces, hessian=hessian)


def _times_transposed(cotangent, vertices, velocity, *faces, hessian):
    if isinstance(cotangent, ad.Zero):
        return (None, cotangent, *(None for _ in faces))
    found = _times.bind(vertices, cotangent, *faces, hessian=hessian)
    return (None, found, *(None for _ in faces))


def _batched(operands, dims, *, hessian):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    vertices, velocity, *faces = (
        x if d is None or d == 0 else jnp.moveaxis(x, d, 0)
        for x, d in zip(operands, dims, strict=True)
    )
    lanes = [d is not None for d in dims]
    meshes = lanes_as_meshes(size, [lanes[0], *lanes[2:]], vertices, *faces)
    (moves,) = lanes_as_meshes(size, [lanes[1]], velocity)
    found = _times.bind(meshes[0], moves, *meshes[1:], hessian=hessian)
    return found.reshape(size, -1, *found.shape[1:]), 0


ad.primitive_jvps[_times] = _times_jvp
ad.primitive_transposes[_times] = _times_transposed
batching.primitive_batchers[_times] = _batched
mlir.register_lowering(
    _times,
    mlir.lower_fun(lambda *operands, hessian: hessian(*operands), multiple_results=False),
)
