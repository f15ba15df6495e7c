"""What differentiates a value whose gradient is known: backwards, and once more around that.

A value comes with its gradient, and only `jax.vjp` and what is built on it can use that well. So
`refuse_forward` says by name what forward mode has to be replaced with, and `with_slope` lets a
value be differentiated again where it stands in a gradient: the Hessian of f(E) then has the part
f''(E) g g^T, and E itself counts as linear.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

_REFUSAL = (
    "self_intersection_penalty has no forward mode (jax.jvp, jax.jacfwd, and what jax.linearize "
    "returns): its gradient is made for reverse mode; take jax.grad, jax.vjp or jax.jacrev, and in "
    'optimistix options=dict(jac="bwd"), or pass second_order=True, which has every mode.'
)


def refuse_forward(vertices: Float[Array | np.ndarray, "*batch V 3"]) -> Float[Array, "*batch V 3"]:
    """The same vertices, of which nothing that depends has a forward-mode derivative.

    The linear function that `jax.linearize` returns may be transposed, as optimistix does, and not
    be called.

    Raises:
        TypeError: when differentiated in forward mode; inside `jit` when that is compiled.
    """
    return _marked.bind(vertices)


def with_slope(
    vertices: Float[Array | np.ndarray, "*batch V 3"],
    value: Float[Array, "*batch"],
    gradient: Float[Array, "*batch V 3"],
) -> Float[Array, "*batch"]:
    """The value, whose derivative with respect to the vertices is the gradient, a constant."""
    return _with_slope(vertices, jax.lax.stop_gradient(value), jax.lax.stop_gradient(gradient))


@jax.custom_jvp
def _with_slope(vertices, value, gradient):
    return value


@_with_slope.defjvp
def _(primals, tangents):
    gradient = primals[2]
    # where: an infinite tangent must not turn a zero gradient into NaN.
    change = jnp.where(gradient == 0, jnp.zeros_like(gradient), tangents[0])
    return _with_slope(*primals), (gradient * change).sum(axis=(-2, -1))


def _refuse(*_: Any, **__: Any):
    raise TypeError(_REFUSAL)


# The identity, and its tangent, which may be transposed and nothing else.
_marked = Primitive("spt_jax_reverse_only")
_tangent = Primitive("spt_jax_reverse_only_tangent")


def _same_shape(x):
    return ShapedArray(x.shape, x.dtype)


for _primitive in (_marked, _tangent):
    _primitive.def_abstract_eval(_same_shape)
    batching.defvectorized(_primitive)

_marked.def_impl(lambda x: x)
mlir.register_lowering(_marked, lambda _, x: [x])
_tangent.def_impl(_refuse)
mlir.register_lowering(_tangent, _refuse)


def _marked_jvp(primals, tangents):
    (x,), (change,) = primals, tangents
    if isinstance(change, ad.Zero):
        return x, change
    return x, _tangent.bind(change)


def _tangent_jvp(primals, tangents):
    (x,), (change,) = primals, tangents
    out = _tangent.bind(x)
    return out, change if isinstance(change, ad.Zero) else _tangent.bind(change)


def _tangent_transposed(cotangent, _):
    return (cotangent,)


ad.primitive_jvps[_marked] = _marked_jvp
ad.primitive_jvps[_tangent] = _tangent_jvp
ad.primitive_transposes[_tangent] = _tangent_transposed
