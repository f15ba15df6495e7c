"""Pickles of results, joblib's and PyTorch's among them, read without running what they name.

What `spt_jax.files.pickles` admits is admitted here, and beside it what these files are made of,
each name answered by a stand-in of our own: joblib's arrays, which stand between the pickle's own
bytes (joblib/joblib, joblib/numpy_pickle.py), and PyTorch's tensors (pytorch/pytorch,
torch/_utils.py). Neither package is imported.
"""

import io
import math
import os
import pickle
import struct
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np

from spt_jax.files.limits import MAX_BYTES, TooLargeError, check_bytes
from spt_jax.files.pickles import GuardedUnpickler, RefusedPickleError
from spt_jax.files.stand_ins import ADMITTED, Admitted, NumpyArrayName, StandIn

STORAGES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "BFloat16Storage": "<u2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C


class TorchArray(np.ndarray):
    """An array that was a tensor, and is to become one again."""


class _JoblibArray(StandIn):
    """joblib's NumpyArrayWrapper: shape and dtype of an array whose bytes follow."""

    __slots__ = ()


class _Storage(NamedTuple):
    """The name of one of PyTorch's kinds of storage."""

    name: str
    dtype: np.dtype


class _Tensor(Admitted):
    """torch._utils._rebuild_tensor_v2: a view of a storage."""

    __slots__ = ("max_bytes",)

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes

    def __call__(self, storage, offset, size, stride, *_):
        offset, size, stride = int(offset), tuple(map(int, size)), tuple(map(int, stride))
        if len(size) != len(stride) or offset < 0 or min((*size, *stride), default=0) < 0:
            raise ValueError(f"a tensor announces the size {size} and the stride {stride}")
        if math.prod(size) * max(storage.itemsize, 8) > self.max_bytes:
            raise ValueError(f"a tensor announces the size {size}, beyond the limit")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if math.prod(size) and last >= len(storage):
            raise ValueError(f"a tensor of size {size} reaches beyond its {len(storage)} numbers")
        steps = tuple(step * storage.itemsize for step in stride)
        view = np.lib.stride_tricks.as_strided(storage[offset:], size, steps)
        return np.array(view).view(TorchArray)


class _Parameter(Admitted):
    """torch._utils._rebuild_parameter: its data alone."""

    __slots__ = ()

    def __call__(self, data, *_):
        return data


class _LoadFromBytes(Admitted):
    """torch.storage._load_from_bytes: a storage within another pickle."""

    __slots__ = ("max_bytes",)

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes

    def __call__(self, content):
        content = content.encode("latin1") if isinstance(content, str) else bytes(content)
        return read_legacy_torch(content, self.max_bytes)


class _Path(Admitted):
    """pathlib's paths, as text."""

    __slots__ = ()

    def __call__(self, *parts):
        return "/".join(map(str, parts))


def _admitted(max_bytes: int) -> dict[tuple[str, str], Any]:
    tensor, path = _Tensor(max_bytes), _Path()
    table: dict[tuple[str, str], Any] = {
        ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
        ("torch._utils", "_rebuild_tensor_v2"): tensor,
        ("torch._utils", "_rebuild_tensor"): tensor,
        ("torch._utils", "_rebuild_parameter"): _Parameter(),
        ("torch.storage", "_load_from_bytes"): _LoadFromBytes(max_bytes),
        ("torch", "Size"): tuple,
    }
    for module in ("torch", "torch.storage", "torch.cuda"):
        table |= {(module, name): _Storage(name, np.dtype(kind)) for name, kind in STORAGES.items()}
    for kind in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"):
        table["pathlib", kind] = path
    return ADMITTED | table


class Reader(GuardedUnpickler):
    """The guarded unpickler with the names of results, which reads what stands between objects.

    Args:
        stream: the content.
        max_bytes: the limit for what a pickle announces.
        storage: returns a storage that a persistent id names, as an array.
    """

    dispatch: ClassVar = dict(GuardedUnpickler.dispatch)

    def __init__(
        self,
        stream: io.BytesIO,
        max_bytes: int,
        storage: Callable[[Any], np.ndarray] | None = None,
    ):
        read = "arrays of NumPy, PyTorch, SciPy and chumpy, and plain containers,"
        super().__init__(stream, _admitted(max_bytes), read)
        self._max_bytes, self._storage = max_bytes, storage

    def persistent_load(self, pid: Any) -> Any:
        """The storage that an id names."""
        if self._storage is None:
            raise ValueError("it names something that lies outside of it")
        return self._storage(pid)

    def load_build(self) -> None:
        """The guarded one, and then the bytes that follow one of joblib's arrays."""
        super().load_build()
        if isinstance(self.stack[-1], _JoblibArray):
            self.stack[-1] = self._joblib_array(self.stack[-1].state)

    dispatch[pickle.BUILD[0]] = load_build

    def _left(self) -> int:
        return len(self._stream.getbuffer()) - self._stream.tell()

    def _joblib_array(self, state: dict[str, Any]) -> np.ndarray:
        shape, dtype = tuple(map(int, state["shape"])), state["dtype"]
        if state["subclass"] is not NumpyArrayName or not isinstance(dtype, np.dtype):
            raise TypeError(f"joblib's arrays are read as numpy.ndarray only: got {state!r}")
        if dtype.hasobject:
            array = Reader(self._stream, self._max_bytes).load()
            if not isinstance(array, np.ndarray):
                raise TypeError("an array of objects is none")
            return array
        if state.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > self._left():
            raise ValueError(f"an array announces the shape {shape}, for which bytes are missing")
        content = self._stream.read(math.prod(shape) * dtype.itemsize)
        flat = np.frombuffer(bytearray(content), dtype)
        return flat.reshape(shape[::-1]).T if state["order"] == "F" else flat.reshape(shape)


def unpickled(
    content: bytes,
    path: str | os.PathLike[str],
    *,
    max_bytes: int | None = None,
    storage: Callable[[Any], np.ndarray] | None = None,
) -> Any:
    """What a pickle holds, joblib's too.

    Args:
        content: its bytes.
        path: the file, for messages.
        max_bytes: the limit; 1 GiB where None.
        storage: see `Reader`.

    Raises:
        RefusedPickleError: it names anything else; nothing has been run then.
        ValueError: it is damaged.
    """
    limit = MAX_BYTES if max_bytes is None else max_bytes
    try:
        with warnings.catch_warnings():
            # Python 2's NumPy wrote 0 and 1 for what NumPy 2 wants to be False and True.
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", UserWarning)
            return Reader(io.BytesIO(content), limit, storage).load()
    except RefusedPickleError as error:
        raise RefusedPickleError(
            f"pose file {os.fspath(path)!r} must hold plain data: {error}"
            " Convert it to .npz where it was made."
        ) from None
    except (TooLargeError, MemoryError, RecursionError):
        raise
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(
            f"pose file must be a whole pickle: got {os.fspath(path)!r} ({what}); it is cut or "
            "damaged: make or download it again."
        ) from error


def as_storage(kind: Any, content: bytes, count: int) -> np.ndarray:
    """A storage's numbers from its bytes; bfloat16 becomes float32."""
    if not isinstance(kind, _Storage):
        raise TypeError(f"a storage is of no known kind: got {kind!r}")
    if count < 0 or count * kind.dtype.itemsize > len(content):
        raise ValueError(f"a storage announces {count:,} numbers and has {len(content):,} bytes")
    numbers = np.frombuffer(content, kind.dtype, count)
    if kind.name == "BFloat16Storage":
        return (numbers.astype("<u4") << 16).view("<f4")
    return numbers


def read_legacy_torch(content: bytes, max_bytes: int) -> Any:
    """What `torch.save` wrote before its zip archives, and still writes for a storage in a pickle.

    Five pickles one after the other (a magic number, a version, the machine, the object, the keys
    of its storages), then each storage: how many numbers, and these.

    Raises:
        ValueError: it is none; whatever `Reader` raises.
    """
    stream = io.BytesIO(content)
    magic, _, machine = (Reader(stream, max_bytes).load() for _ in range(3))
    if magic != LEGACY_MAGIC:
        raise ValueError("it is no file of PyTorch")
    if not (isinstance(machine, dict) and machine.get("little_endian", True)):
        raise ValueError("its numbers have their bytes in the other order")
    start = stream.tell()
    kinds: dict[str, Any] = {}

    def named(pid: Any) -> np.ndarray:
        kinds[str(pid[2])] = pid[1]
        return np.zeros(0)

    # Once for the kinds of the storages, which follow, and once more with them.
    _Pretend(stream, max_bytes, named).load()
    keys = Reader(stream, max_bytes).load()
    storages: dict[str, np.ndarray] = {}
    for key in map(str, keys):
        (count,) = struct.unpack("<q", stream.read(8))
        if not isinstance(kinds.get(key), _Storage):
            raise ValueError(f"the storage {key!r} is of no known kind")
        size = count * kinds[key].dtype.itemsize
        if not 0 <= size <= len(content):
            raise ValueError(f"a storage announces {count:,} numbers")
        storages[key] = as_storage(kinds[key], stream.read(size), count)
    stream.seek(start)
    return Reader(stream, max_bytes, lambda pid: storages[str(pid[2])]).load()


class _Pretend(Reader):
    """A reader that looks at names and sizes, and makes no tensors."""

    def __init__(self, *given: Any):
        super().__init__(*given)
        tensor = ("torch._utils", "_rebuild_tensor_v2")
        self._names = self._names | {
            tensor: _Parameter(),
            (tensor[0], "_rebuild_tensor"): _Parameter(),
        }


def check_total(path: str | os.PathLike[str], tree: Any, max_bytes: int | None) -> None:
    """Raise where the arrays of a tree take more than the limit, each as often as it stands there.

    Raises:
        TooLargeError: they do.
    """
    total, left, seen = 0, [tree], set()
    while left:
        node = left.pop()
        if isinstance(node, np.ndarray) and not node.dtype.hasobject:
            total += node.size * max(node.itemsize, 8)
        elif isinstance(node, dict | list | tuple | np.ndarray) and id(node) not in seen:
            seen.add(id(node))
            held = node.values() if isinstance(node, dict) else node
            left += held.ravel().tolist() if isinstance(held, np.ndarray) else held
    check_bytes("the arrays of pose file", path, total, max_bytes)
