"""Trees of arrays written as the pickles and the PyTorch archives that they were read from."""

import io
import pickle
import zipfile
from typing import Any, NamedTuple

import numpy as np

from spt_jax.io.poses.unpickling import LEGACY_MAGIC, STORAGES, TorchArray

_KINDS = {np.dtype(kind): name for name, kind in STORAGES.items() if name != "BFloat16Storage"}
# What torch.save writes today. Its readers ask for the version alone.
_TORCH_VERSION, _LEGACY_PROTOCOL = b"3\n", 1001


class _Global(NamedTuple):
    """A name that the pickle is to ask for."""

    module: str
    name: str


class _Persistent(NamedTuple):
    """What a pickle names instead of holding it."""

    pid: tuple[Any, ...]


_Pickler: Any = pickle._Pickler  # pyright: ignore[reportAttributeAccessIssue]


class _Writer(_Pickler):
    """Python's own pickler, whose arrays every NumPy reads, with tensors as PyTorch has them.

    NumPy 2 names `numpy._core`, which NumPy 1 does not have; the old name is known to both.

    Args:
        stream: what is written to.
        protocol: of the pickle.
        storages: takes the storages, where an archive holds them; None: they stand in the pickle.
    """

    def __init__(self, stream: io.BytesIO, protocol: int, storages: list[np.ndarray] | None = None):
        super().__init__(stream, protocol)
        self._storages = storages

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        """Write anything; tensors and names in their own way."""
        if isinstance(obj, _Global):
            self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, _Persistent):
            super().save(obj.pid)
            self.write(pickle.BINPERSID)
        elif isinstance(obj, TorchArray):
            self._save_tensor(np.ascontiguousarray(obj.view(np.ndarray)).reshape(obj.shape))
            self.memoize(obj)
        else:
            super().save(obj, save_persistent_id)

    def save_global(self, obj: Any, name: str | None = None) -> None:
        """Write the name of a function or class, NumPy's by its old one."""
        module = getattr(obj, "__module__", "") or ""
        if module.startswith("numpy._core"):
            obj_name = name or obj.__name__
            self.save(_Global(module.replace("numpy._core", "numpy.core", 1), obj_name))
            self.memoize(obj)
        else:
            super().save_global(obj, name)

    def _save_tensor(self, array: np.ndarray) -> None:
        steps = [step // array.itemsize for step in array.strides]
        self.save(_Global("torch._utils", "_rebuild_tensor_v2"))
        self.write(pickle.MARK)
        if self._storages is None:
            self.save(_Global("torch.storage", "_load_from_bytes"))
            super().save((_legacy_storage(array),))
            self.write(pickle.REDUCE)
        else:
            self.save(_Persistent(_pid(array, str(len(self._storages)))))
            self._storages.append(array)
        for value in (0, array.shape, tuple(steps), False):
            super().save(value)
        self.save(_Global("collections", "OrderedDict"))
        self.write(pickle.EMPTY_TUPLE + pickle.REDUCE + pickle.TUPLE + pickle.REDUCE)


def _pid(array: np.ndarray, key: str) -> tuple[Any, ...]:
    return ("storage", _Global("torch", _KINDS[array.dtype]), key, "cpu", array.size)


def _legacy_storage(array: np.ndarray) -> bytes:
    """What `_load_from_bytes` takes: see `read_legacy_torch`."""
    stream = io.BytesIO()
    sizes = {"short": 2, "int": 4, "long": 4}
    machine = {"protocol_version": _LEGACY_PROTOCOL, "little_endian": True, "type_sizes": sizes}
    for value in (LEGACY_MAGIC, _LEGACY_PROTOCOL, machine):
        _Writer(stream, 2).dump(value)
    _Writer(stream, 2).dump(_Persistent((*_pid(array, "0"), None)))
    _Writer(stream, 2).dump(["0"])
    stream.write(array.size.to_bytes(8, "little") + array.tobytes())
    return stream.getvalue()


def as_pickle(tree: Any, protocol: int) -> bytes:
    """A tree as a pickle, which Python, NumPy 1 and 2, and joblib load."""
    stream = io.BytesIO()
    _Writer(stream, protocol).dump(tree)
    return stream.getvalue()


def as_torch_archive(tree: Any) -> bytes:
    """A tree as the zip archive that `torch.save` writes, and `torch.load` reads."""
    stream, storages = io.BytesIO(), []
    _Writer(stream, 2, storages).dump(tree)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("archive/data.pkl", stream.getvalue())
        file.writestr("archive/byteorder", b"little")
        for k, storage in enumerate(storages):
            file.writestr(f"archive/data/{k}", storage.tobytes())
        file.writestr("archive/version", _TORCH_VERSION)
    return archive.getvalue()
