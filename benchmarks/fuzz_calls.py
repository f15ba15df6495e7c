"""The penalty under random transformations of JAX, with random options: part of the fuzz.

Whatever stands around a call, it gives what the plain call gives, and in reverse mode the same
gradient. Second derivatives count the penalty as linear. Forward mode is refused by name.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jax import Array

from spt_jax import RestSurface, self_intersection_penalty

BATCH = 3
_OFF = {"float32": 1e-5, "float64": 1e-12}
_BOX = trimesh.creation.box()
_FACES = np.concatenate([_BOX.faces, _BOX.faces + 8])
_GROUPS = np.repeat([0, 1], 12)
_REST = np.concatenate([_BOX.vertices, _BOX.vertices + np.array([3.0, 0.0, 0.0])])


class Plain(NamedTuple):
    """The penalty with its options, a batch of meshes, and what it is for each by itself."""

    penalty: Callable[[Any], Array]
    of_faces: Callable[[Any, Any], Array]
    vertices: Array
    values: np.ndarray
    gradients: np.ndarray

    @property
    def one(self) -> Array:
        """The first mesh."""
        return self.vertices[0]


# What is computed, and what it must be equal to.
Pair = tuple[Any, Any]


def _nested(plain: Plain) -> Pair:
    twice = jnp.stack([plain.vertices, plain.vertices[::-1]])
    return jax.vmap(jax.vmap(plain.penalty))(twice), [plain.values, plain.values[::-1]]


def _scanned(plain: Plain) -> Pair:
    def step(total, vertices):
        value, gradient = jax.value_and_grad(plain.penalty)(vertices)
        return total + value, gradient

    start = jnp.zeros((), plain.vertices.dtype)
    total, gradients = jax.lax.scan(step, start, plain.vertices)
    return (total, gradients), (plain.values.sum(), plain.gradients)


def _branched(plain: Plain) -> Pair:
    zero = jnp.zeros((), plain.one.dtype)
    chosen = jax.jit(lambda v, k: jax.lax.cond(k > 0, plain.penalty, lambda _: zero, v))
    return (chosen(plain.one, 1), chosen(plain.one, 0)), (plain.values[0], 0.0)


def _squared(plain: Plain) -> Pair:
    """The Hessian of P^2 along two directions: 2 g g^T, since P counts as linear."""
    along = jnp.stack([jnp.ones_like(plain.one), plain.one])

    def square(t: Array) -> Array:
        return plain.penalty(plain.one + jnp.tensordot(t, along, 1)) ** 2

    slope = (np.asarray(along, np.float64) * plain.gradients[0]).sum(axis=(1, 2))
    return jax.hessian(square)(jnp.zeros(2, plain.one.dtype)), 2 * np.outer(slope, slope)


def _jacobian(plain: Plain) -> Pair:
    expected = np.zeros((BATCH, *plain.gradients.shape))
    expected[np.arange(BATCH), np.arange(BATCH)] = plain.gradients
    return jax.jacrev(plain.penalty)(plain.vertices), expected


def _mapped_faces(plain: Plain) -> Pair:
    faces = jnp.broadcast_to(jnp.asarray(_FACES, jnp.int32), (BATCH, *_FACES.shape))
    return jax.vmap(plain.of_faces)(plain.vertices, faces), plain.values


TRANSFORMED: dict[str, Callable[[Plain], Pair]] = {
    "batch": lambda p: (p.penalty(p.vertices), p.values),
    "jit": lambda p: (jax.jit(p.penalty)(p.one), p.values[0]),
    "jit of grad": lambda p: (jax.jit(jax.grad(p.penalty))(p.one), p.gradients[0]),
    "value_and_grad": lambda p: (
        jax.value_and_grad(p.penalty)(p.one),
        (p.values[0], p.gradients[0]),
    ),
    "vmap": lambda p: (jax.vmap(p.penalty)(p.vertices), p.values),
    "vmap of grad": lambda p: (jax.vmap(jax.grad(p.penalty))(p.vertices), p.gradients),
    "jit of vmap of grad": lambda p: (
        jax.jit(jax.vmap(jax.grad(p.penalty)))(p.vertices),
        p.gradients,
    ),
    "nested vmap": _nested,
    "scan": _scanned,
    "map": lambda p: (jax.lax.map(p.penalty, p.vertices), p.values),
    "cond": _branched,
    "checkpoint": lambda p: (jax.grad(jax.checkpoint(p.penalty))(p.one), p.gradients[0]),
    "grad of a sum": lambda p: (
        jax.grad(lambda v: p.penalty(v).sum())(p.vertices),
        p.gradients,
    ),
    "jacrev": _jacobian,
    "vmap over faces": _mapped_faces,
    "hessian of the square": _squared,
}

REFUSED: dict[str, Callable[[Plain], Any]] = {
    "jvp": lambda p: jax.jvp(p.penalty, (p.one,), (p.one,)),
    "jacfwd": lambda p: jax.jacfwd(p.penalty)(p.one),
    "linearize, called": lambda p: jax.linearize(p.penalty, p.one)[1](p.one),
    "jit of jvp": lambda p: jax.jit(lambda v: jax.jvp(p.penalty, (v,), (v,)))(p.one),
}


def check(seed: int, number: int) -> tuple[str, str, list[str]]:
    """One transformation with random options: its name, the dtype, and what is wrong with it."""
    rng = np.random.default_rng([seed, number, 2])
    names = [*TRANSFORMED, *REFUSED]
    name, dtype = names[number % len(names)], ("float32", "float64")[rng.integers(2)]
    options = _options(rng, traced_faces=name == "vmap over faces")
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", dtype == "float64" or bool(rng.integers(2)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            plain = _plain(rng, dtype, options)
            faults = _refused(plain, name) if name in REFUSED else _equal(plain, name, dtype)
    except Exception as error:
        faults = [f"{type(error).__name__}: {str(error)[:200]}"]
    finally:
        jax.config.update("jax_enable_x64", before)
    long = ("face_groups", "rest_surface")
    shown = {key: value for key, value in options.items() if key not in long}
    return name, dtype, [f"{fault}; options {shown}" for fault in faults]


def _options(rng: np.random.Generator, traced_faces: bool) -> dict[str, Any]:
    """Options of the penalty, each left out as often as not."""
    drawn: dict[str, Any] = {
        "value": ("volume", "ratio")[rng.integers(2)],
        "gradient": ("boundary", "vertex", "unit")[rng.integers(3)],
        "rule": ("vertex", "triangle")[rng.integers(2)],
        "rays": (None, 16, (8, 12))[rng.integers(3)],
        "directions": (1, 3, rng.normal(size=(2, 3)))[rng.integers(3)],
        "margin": float(rng.uniform(0, 0.1)),
    }
    options = {key: value for key, value in drawn.items() if rng.integers(2)}
    if not traced_faces and rng.integers(3) == 0:
        options["face_groups"] = _GROUPS
        options["ignore_groups"] = (((0, 0), (1, 1)), ((0, 1),))[rng.integers(2)]
    if not traced_faces and rng.integers(3) == 0:
        options["rest_surface"] = RestSurface(_REST, _FACES, distance=0.3)
    if rng.integers(10) == 0:  # by fewer rays than it casts by default, which only cost time here
        options |= {"backend": "xla", "rays": options.get("rays")}
        options["rays"] = 24 if options["rays"] is None else options["rays"]
    return options


def _plain(rng: np.random.Generator, dtype: str, options: dict[str, Any]) -> Plain:
    """Pairs of boxes that overlap, or in the last mesh of some batches do not."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    meshes = []
    for k in range(BATCH):
        shift = rng.uniform(0.2, 0.8, 3) if k < BATCH - 1 else rng.uniform(0.2, 2.0, 3)
        second = _BOX.vertices @ turn.T + shift
        meshes.append(np.concatenate([_BOX.vertices * rng.uniform(0.8, 1.2, 3), second]))
    vertices = jnp.asarray(np.stack(meshes), dtype)

    def of_faces(vertices: Any, faces: Any) -> Array:
        return self_intersection_penalty(vertices, faces, **options)

    def penalty(vertices: Any) -> Array:
        return of_faces(vertices, _FACES)

    values = np.array([np.asarray(penalty(one), np.float64) for one in vertices])
    gradients = np.array([np.asarray(jax.grad(penalty)(one), np.float64) for one in vertices])
    return Plain(penalty, of_faces, vertices, values, gradients)


def _equal(plain: Plain, name: str, dtype: str) -> list[str]:
    if not (np.isfinite(plain.values).all() and np.isfinite(plain.gradients).all()):
        return ["the plain call is not finite"]
    found, expected = TRANSFORMED[name](plain)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(_stacked(expected)), strict=True)
    faults = []
    for one, right in pairs:
        if one.dtype != dtype:
            faults.append(f"{one.dtype} where {dtype} went in")
        if one.shape != right.shape:
            faults.append(f"shape {one.shape} where {right.shape} is right")
            continue
        off = np.abs(np.asarray(one, np.float64) - right).max(initial=0.0)
        if not off <= _OFF[dtype] * max(1.0, np.abs(right).max(initial=0.0)):
            faults.append(f"off by {off:.3g} from the plain call")
    return faults


def _stacked(expected: Any) -> Any:
    """Lists of arrays as one array; tuples as they are."""
    if isinstance(expected, tuple):
        return tuple(np.asarray(one, np.float64) for one in expected)
    return np.asarray(expected, np.float64)


def _refused(plain: Plain, name: str) -> list[str]:
    try:
        REFUSED[name](plain)
    except TypeError as error:
        return [] if "jax.jacrev" in str(error) else [f"refused without a way out: {error}"]
    return ["forward mode was not refused"]
