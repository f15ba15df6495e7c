"""SMPL's official pickles, read without running anything that they name.

A pickle is a program: it can call whatever it can name. This reader knows a short list of names,
listed below one by one, answers each with a harmless function or a stand-in class of its own, and
refuses every other name before anything of it is imported, let alone called. Neither chumpy nor
SciPy is imported: their arrays are read from the state that the pickle stores.
"""

import codecs
import io
import os
import pickle
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy._core import multiarray


class _StandIn:
    """Holds the state of an object whose own class is not wanted here."""

    __slots__ = ("state",)
    state: Any

    # Also answers a pickle's attempt to set attributes on the class itself: with a TypeError.
    def __setstate__(self, state):
        self.state = state


class _Chumpy(_StandIn):
    """chumpy.ch.Ch: an array, `x`."""

    __slots__ = ()

    def as_array(self) -> np.ndarray:
        return np.asarray(plain(self.state["x"]))


class _ChumpySelect(_StandIn):
    """chumpy.reordering.Select: entries `idxs` of another array, reshaped."""

    __slots__ = ()

    def as_array(self) -> np.ndarray:
        source = np.asarray(plain(self.state["a"]))
        picked = source.ravel()[np.asarray(plain(self.state["idxs"]))]
        return picked.reshape(self.state["preferred_shape"])


class _Sparse(_StandIn):
    """A scipy.sparse matrix or array."""

    __slots__ = ()

    def as_array(self) -> np.ndarray:
        state = self.state
        dense = np.zeros(state["_shape"], np.asarray(state["data"]).dtype)
        np.add.at(dense, self._entries(state), state["data"])
        return dense

    def _entries(self, state) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError


class _SparseColumns(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        columns = np.repeat(np.arange(state["_shape"][1]), np.diff(state["indptr"]))
        return state["indices"], columns


class _SparseRows(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        rows = np.repeat(np.arange(state["_shape"][0]), np.diff(state["indptr"]))
        return rows, state["indices"]


class _SparseCoordinates(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        if "coords" in state:  # SciPy 1.13 and later
            return state["coords"]
        return state["row"], state["col"]


class _Function:
    """A function that a pickle may call, without attributes that it could set."""

    __slots__ = ()


class _Reconstruct(_Function):
    """numpy's _reconstruct, for plain arrays only."""

    __slots__ = ()

    def __call__(self, subtype, shape, dtype):
        if subtype is not np.ndarray:
            raise TypeError(f"arrays are rebuilt as numpy.ndarray only, not as {subtype!r}")
        return multiarray._reconstruct(np.ndarray, shape, dtype)


class _Scalar(_Function):
    """numpy's scalar, for plain numbers and strings only."""

    __slots__ = ()

    def __call__(self, dtype, value=None):
        if not isinstance(dtype, np.dtype) or dtype.hasobject or dtype.names:
            raise TypeError(f"NumPy scalars must be numbers or strings, not {dtype!r}")
        if value is None:
            return np.zeros((), dtype)[()]
        raw = value.encode("latin1") if isinstance(value, str) else bytes(value)
        return np.frombuffer(raw, dtype, count=1)[0]


class _FromBuffer(_Function):
    """numpy's _frombuffer, which protocol 5 uses."""

    __slots__ = ()

    def __call__(self, buffer, dtype, shape, order):
        return np.frombuffer(buffer, dtype).reshape(shape, order=order)


class _Rebuild(_Function):
    """copyreg's _reconstructor, for the stand-ins only."""

    __slots__ = ()

    def __call__(self, cls, base, state):
        if not (isinstance(cls, type) and issubclass(cls, _StandIn)) or base is not object:
            raise TypeError(f"copyreg._reconstructor may rebuild stand-ins only, not {cls!r}")
        return cls()


class _Encode(_Function):
    """_codecs.encode, by which Python 3 writes bytes in protocol 2: Latin-1 only."""

    __slots__ = ()

    def __call__(self, text, encoding="latin1"):
        if codecs.lookup(encoding).name != "iso8859-1":
            raise ValueError(f"bytes are read as latin1 only, not as {encoding!r}")
        return text.encode("latin1")


def _admitted() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("copyreg", "_reconstructor"): _Rebuild(),
        ("copy_reg", "_reconstructor"): _Rebuild(),
        ("_codecs", "encode"): _Encode(),
        ("collections", "OrderedDict"): OrderedDict,
        ("chumpy.ch", "Ch"): _Chumpy,
        ("chumpy.reordering", "Select"): _ChumpySelect,
    }
    for core in ("numpy.core", "numpy._core"):
        table[f"{core}.multiarray", "_reconstruct"] = _Reconstruct()
        table[f"{core}.multiarray", "scalar"] = _Scalar()
        table[f"{core}.numeric", "_frombuffer"] = _FromBuffer()
    for builtins in ("builtins", "__builtin__"):
        for kind in (object, set, frozenset):
            table[builtins, kind.__name__] = kind
    layouts = {"csc": _SparseColumns, "csr": _SparseRows, "coo": _SparseCoordinates}
    for layout, stand_in in layouts.items():
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}", "scipy.sparse"):
            table[module, f"{layout}_matrix"] = stand_in
            table[module, f"{layout}_array"] = stand_in
    return table


_ADMITTED = _admitted()


class RefusedPickleError(ValueError):
    """A pickle names something that this reader does not admit."""


class _Reader(pickle.Unpickler):
    def find_class(self, module_name, global_name, /):
        try:
            return _ADMITTED[module_name, global_name]
        except KeyError:
            raise RefusedPickleError(
                f"refused: the pickle asks for {module_name}.{global_name}. Only NumPy arrays, "
                "SciPy sparse matrices and chumpy arrays are read; nothing was run. Do not open "
                "this file with pickle.load unless you trust where it comes from."
            ) from None


def plain(value: Any) -> Any:
    """The dense NumPy array of a stand-in; any other value as it is."""
    if isinstance(value, _StandIn):
        return value.as_array()  # pyright: ignore[reportAttributeAccessIssue]
    return value


def read_pickle(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The dictionary in a pickle of plain data, the way Python 2 or 3 wrote it.

    Chumpy arrays and sparse matrices come back as objects that `plain` turns into dense arrays.

    Args:
        path: the file.

    Returns:
        The dictionary.

    Raises:
        RefusedPickleError: the pickle names anything beyond NumPy arrays, SciPy sparse matrices,
            chumpy arrays and plain containers. Nothing has been run then.
        ValueError: the file is damaged, or holds something other than a dictionary.

    Example:
        >>> import os, pickle, tempfile
        >>> from spt_jax.body.pickles import read_pickle
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = os.path.join(folder, "bad.pkl")
        ...     with open(path, "wb") as file:
        ...         _ = pickle.dump({"f": print}, file)
        ...     try:
        ...         read_pickle(path)
        ...     except ValueError as error:
        ...         "asks for builtins.print" in str(error)
        True
    """
    with open(path, "rb") as file:
        content = io.BytesIO(file.read())
    try:
        # Latin-1 keeps the bytes of Python 2's strings, in which its arrays are stored.
        value = _Reader(content, encoding="latin1").load()
    except RefusedPickleError as error:
        raise RefusedPickleError(f"{os.fspath(path)}: {error}") from None
    except Exception as error:
        raise ValueError(
            f"{os.fspath(path)} cannot be read as a pickle: {type(error).__name__}: {error}; it "
            "is truncated or damaged: download it again."
        ) from error
    if not isinstance(value, dict):
        raise ValueError(
            f"{os.fspath(path)} must hold a dictionary of arrays: got {type(value).__name__}."
        )
    return value
