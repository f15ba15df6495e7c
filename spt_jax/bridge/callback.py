"""The way from JAX to NumPy and back: the only `jax.pure_callback` of the package.

Where all arrays are known, NumPy is called at once and nothing is traced or compiled, so that no
value of any option leaves a program behind. Inside `jit` a primitive of our own stands for the
call; it is lowered to `jax.pure_callback`. Four traps shape this file:

- On CPU a callback gets its operands as `jax.Array`s, and one above about 100 kB is copied on the
  thread pool that is waiting for the callback: the program hangs
  (https://github.com/jax-ml/jax/issues/24255, https://github.com/jax-ml/jax/issues/25861).
  So arrays travel as pieces of at most 96 kB and are joined here, and faces that are known do not
  travel at all.
- The callback runs on another thread, where `with jax.enable_x64(True)` of the caller does not
  hold: a float64 array would be rounded or refused there. So 8-byte numbers travel as pairs of
  uint32, both ways.
- Raising inside a callback is undefined behaviour: what can be wrong in the values comes back as
  NaN, everything else is refused while tracing.
- `jax.pure_callback` gathers a batch that is sharded over devices. There, and nowhere else, the
  callback is given to XLA by its number, which each device calls with its own part of the batch.

The call has no derivative. `stop_gradient` on its operands keeps outer transformations
(Hessian-vector products, implicit differentiation) from asking for one.
"""

import math
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Integer

try:  # private, as `custom_partitioning` has it for itself: a lowering that needs the devices
    from jax._src.dispatch import prim_requires_devices_during_lowering as _with_devices
except ImportError:  # then a batch that is sharded is gathered
    _with_devices: set[Primitive] = set()

from spt_jax.bridge import on_host
from spt_jax.bridge.batches import lanes_as_meshes
from spt_jax.bridge.on_host import HostFunction, ResultSpec, Work

_PIECE_BYTES = 96 * 1024


class _Call:
    """The parameter of the primitive: the work, and the faces where they are known."""

    def __init__(self, work: Work, faces: np.ndarray | None):
        self.work, self.faces = work, faces

    def __repr__(self) -> str:
        return self.work.function.__name__

    def __call__(self, vertices: Any, faces: Any = None) -> list[np.ndarray]:
        """The results for a list of meshes of known values."""
        vertices = np.asarray(vertices)
        faces = np.asarray(faces) if self.faces is None else self.faces
        return on_host.measured(self.work, vertices, faces)


def call_on_host(
    function: HostFunction,
    options: Hashable,
    results: tuple[ResultSpec, ...],
    vertices: Float[Array | np.ndarray, "*batch V 3"],
    faces: Integer[Array | np.ndarray, "F 3"],
) -> tuple[Array, ...]:
    """Run a NumPy function once per mesh of the batch, in the processes that `config` allows.

    Results are kept in an LRU cache keyed by the vertices' bytes, so that a repeated mesh, also
    within one batch, is measured once. A batch that is sharded over devices stays so.

    Args:
        function: a module-level function, pure.
        options: handed on as they are.
        results: for each result, its shape for one mesh and its dtype. Where nothing can be
            measured, numbers come back as NaN and arrays as zeros.
        vertices: any number of leading batch axes.
        faces: shared by the batch; under `vmap` they may be batched too.

    Raises:
        ValueError: under `jax.export`, which cannot hold a call of this Python.

    Differentiation: none; all derivatives through the result are zero.
    """
    work = Work(function, options, results)
    if not isinstance(faces, Tracer):
        # A copy, since the program may outlive what the caller does to the array.
        traced = isinstance(vertices, Tracer)
        kept = np.array(faces) if traced else np.asarray(faces)
        call, operands = _Call(work, kept[None]), ()
        if not traced:
            return tuple(_at_once(call, vertices))
    else:
        call, operands = _Call(work, None), (jax.lax.stop_gradient(faces)[None],)
    batch = vertices.shape[:-2]
    flat = jax.lax.stop_gradient(vertices).reshape(math.prod(batch), *vertices.shape[-2:])
    found = _host_call.bind(flat, *operands, call=call)
    return tuple(array.reshape(batch + array.shape[1:]) for array in found)


def clear_results() -> None:
    """Drop the cached results, so that a benchmark measures anew."""
    on_host.clear_results()


def is_local(array: Any) -> bool:
    """Whether an array's values are known, and all in one place."""
    if isinstance(array, Tracer):
        return False
    return not isinstance(array, jax.Array) or len(array.sharding.device_set) == 1


def _at_once(call: _Call, vertices: Any, *faces: Any) -> list[Array]:
    """The results for known meshes with any batch axes, where the vertices are."""
    batch = vertices.shape[:-2]

    def of(piece: Any) -> list[np.ndarray]:
        lead = piece.shape[:-2]
        found = call(np.asarray(piece).reshape(math.prod(lead), *piece.shape[-2:]), *faces)
        return [array.reshape(lead + array.shape[1:]) for array in found]

    sharding = getattr(vertices, "sharding", None)
    if is_local(vertices) or not isinstance(sharding, NamedSharding):
        found = of(vertices)
        if sharding is not None and len(sharding.device_set) == 1:
            return [jax.device_put(array, sharding) for array in found]
        return [jax.device_put(array) for array in found]
    # Each device's own part of the batch.
    spec = tuple(sharding.spec) + (None,) * (vertices.ndim - len(sharding.spec))
    along = NamedSharding(sharding.mesh, PartitionSpec(*spec[: len(batch)]))
    if any(name is not None for name in spec[len(batch) :]) or faces:
        whole = NamedSharding(sharding.mesh, PartitionSpec())
        return [jax.device_put(array, whole) for array in of(vertices)]
    parts = [(shard.device, of(shard.data)) for shard in vertices.addressable_shards]
    return [
        jax.make_array_from_single_device_arrays(
            (*batch, *shape), along, [jax.device_put(found[k], device) for device, found in parts]
        )
        for k, (shape, _) in enumerate(call.work.results)
    ]


_host_call = Primitive("spt_jax_host_call")
_host_call.multiple_results = True
_with_devices.add(_host_call)


@_host_call.def_impl
def _run(vertices, *faces, call):
    return _at_once(call, vertices, *faces)


@_host_call.def_abstract_eval
def _shapes(vertices, *faces, call):
    shapes = [((vertices.shape[0], *shape), dtype) for shape, dtype in call.work.results]
    return [ShapedArray(shape, np.dtype(dtype)) for shape, dtype in shapes]


def _batched(operands, dims, *, call):
    size = next(x.shape[d] for x, d in zip(operands, dims, strict=True) if d is not None)
    front = [
        x if d is None or d == 0 else jnp.moveaxis(x, d, 0)
        for x, d in zip(operands, dims, strict=True)
    ]
    vertices, *faces = front
    meshes = lanes_as_meshes(size, [d is not None for d in dims], vertices, *faces)
    found = _host_call.bind(*meshes, call=call)
    shapes = [(size, array.shape[0] // size, *array.shape[1:]) for array in found]
    return [x.reshape(shape) for x, shape in zip(found, shapes, strict=True)], [0] * len(found)


batching.primitive_batchers[_host_call] = _batched


def _lowered(ctx, *operands, call):
    module = ctx.module_context
    if getattr(module.lowering_parameters, "for_export", False):
        raise ValueError(
            "jax.export cannot hold a call of this Python, where the exact penalty is measured: "
            'export a function with backend="xla", or export what comes before and after.'
        )
    devices = getattr(module.axis_context, "device_assignment", None)
    sharded = isinstance(module.axis_context, mlir.ShardingContext) and len(devices or ()) > 1
    through = _through_callback(call)
    if sharded and module.platforms[0] in _TARGETS:
        # What a partition is lowered to comes too late to register a callback of its own.
        module.add_host_callback(_in_words(call))
        number = len(module.host_callbacks) - 1
        through = _per_device(call, _TARGETS[module.platforms[0]], number)
    return mlir.lower_fun(through, multiple_results=True)(ctx, *operands)


mlir.register_lowering(_host_call, _lowered)

# What XLA's callbacks with a number are called, where they are known to take the parts of a batch.
_TARGETS = {
    "cpu": "xla_ffi_python_cpu_callback",
    "cuda": "xla_ffi_python_gpu_callback",
    "rocm": "xla_ffi_python_gpu_callback",
}


def _in_words(call: _Call):
    """The callback: 8-byte results as pairs of uint32, which nobody rounds."""

    def run(*arrays):
        return tuple(
            x.view(np.uint32).reshape(*x.shape, 2) if x.dtype.itemsize == 8 else x
            for x in call(*arrays)
        )

    return run


def _from_words(call: _Call, found) -> tuple[Array, ...]:
    dtypes = [dtype for _, dtype in call.work.results]
    return tuple(
        jax.lax.bitcast_convert_type(words, dtype)
        for words, dtype in zip(found, dtypes, strict=True)
    )


def _through_callback(call: _Call):
    def through(*operands):
        specs = [(x.shape, x.dtype.name) for x in operands]

        def run(*pieces):
            return _in_words(call)(
                *(_joined(x, *spec) for x, spec in zip(pieces, specs, strict=True))
            )

        words = tuple(
            jax.ShapeDtypeStruct(x.shape, x.dtype) for x in _words_of(*operands, call=call)
        )
        return _from_words(call, jax.pure_callback(run, words, *map(_pieces, operands)))

    return through


def _pieces(array: Array) -> tuple[Array, ...]:
    flat = array.reshape(-1)
    if flat.dtype.itemsize == 8:
        flat = jax.lax.bitcast_convert_type(flat, "uint32").reshape(-1)
    step = _PIECE_BYTES // flat.dtype.itemsize
    return tuple(flat[start : start + step] for start in range(0, flat.size, step))


def _joined(pieces, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    # jax.Array -> NumPy by np.asarray alone: any other use of jax here may wait for the thread
    # that waits for us.
    arrays = [np.asarray(piece) for piece in pieces]
    joined = np.concatenate(arrays) if arrays else np.zeros(0, dtype)
    return joined.view(dtype).reshape(shape)


_numbered = Primitive("spt_jax_numbered_callback")
_numbered.multiple_results = True


@_numbered.def_abstract_eval
def _words_of(vertices, *faces, call, **_):
    found = _shapes(vertices, *faces, call=call)
    return [
        ShapedArray((*x.shape, 2), np.dtype("uint32")) if x.dtype.itemsize == 8 else x
        for x in found
    ]


def _emitted(ctx, *operands, call, target, number):
    return jax.ffi.ffi_lowering(target)(ctx, *operands, index=np.uint64(number))


mlir.register_lowering(_numbered, _emitted, cacheable=False)


def _per_device(call: _Call, target: str, number: int):
    """The call where a batch may be sharded: each device has its own part measured."""

    def through(*operands):
        return _from_words(call, _numbered.bind(*operands, call=call, target=target, number=number))

    mapped = custom_partitioning(through)

    def shardings(mesh, arguments):
        # Faces of their own go with their meshes; one list of faces goes everywhere.
        names = arguments[0].sharding.spec
        name = names[0] if len(names) else None
        vertices = NamedSharding(mesh, PartitionSpec(name, None, None))
        given = [vertices]
        for faces in arguments[1:]:
            own = name if faces.shape[0] > 1 else None
            given.append(NamedSharding(mesh, PartitionSpec(own, None, None)))
        found = tuple(
            NamedSharding(mesh, PartitionSpec(name, *(None,) * len(shape)))
            for shape, _ in call.work.results
        )
        return tuple(given), found

    def infer(mesh, arguments, _):
        return shardings(mesh, arguments)[1]

    def partition(mesh, arguments, _):
        given, found = shardings(mesh, arguments)
        return mesh, through, found, given

    def rule(_, values, __):
        letters = iter("abcdefghijklm")
        kept: list[str] = []

        def others(count: int) -> str:
            names = [next(letters) for _ in range(count)]
            kept.extend(names)
            return " ".join(names)

        given = [f"n {others(2)}"]
        for value in values[1:]:
            several = value.type.shape[0] > 1 if hasattr(value, "type") else value.shape[0] > 1
            given.append(f"n {others(2)}" if several else others(3))
        found = [f"n {others(len(shape))}".strip() for shape, _ in call.work.results]
        return f"{', '.join(given)} -> {', '.join(found)}"

    mapped.def_partition(
        partition=partition, infer_sharding_from_operands=infer, sharding_rule=rule
    )
    return mapped
