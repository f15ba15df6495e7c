"""What a pickle's names stand for here: stand-ins for its objects, and the functions it may call.

`ADMITTED` lists every name that `pickles.py` admits, one by one, and what answers it: a harmless
function, or a class that only holds the state that the pickle stores. Neither chumpy nor SciPy is
imported; `plain` and `dense_array` turn the states of their arrays into NumPy's, within a limit.
"""

import codecs
import math
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy._core import multiarray

_MAX_BYTES = 2**30
_LARGEST_SCALAR = 64


class StandIn:
    """Holds the state of an object whose own class is not wanted here."""

    __slots__ = ("state",)
    state: Any

    # Also answers a pickle's attempt to set attributes on the class itself: with a TypeError.
    def __setstate__(self, state):
        self.state = state


class _Chumpy(StandIn):
    """chumpy.ch.Ch: an array, `x`."""

    __slots__ = ()

    def as_array(self, max_bytes: int) -> np.ndarray:
        return _dense(plain(self.state["x"], max_bytes), max_bytes)


class _ChumpySelect(StandIn):
    """chumpy.reordering.Select: entries `idxs` of another array, reshaped."""

    __slots__ = ()

    def as_array(self, max_bytes: int) -> np.ndarray:
        source = _dense(plain(self.state["a"], max_bytes), max_bytes)
        picked = source.ravel()[_dense(plain(self.state["idxs"], max_bytes), max_bytes)]
        return picked.reshape(self.state["preferred_shape"])


class _Sparse(StandIn):
    """A scipy.sparse matrix or array."""

    __slots__ = ()

    def as_array(self, max_bytes: int) -> np.ndarray:
        state = self.state
        shape, data = tuple(map(int, state["_shape"])), np.asarray(state["data"])
        if 8 * max(math.prod(shape), *shape) > max_bytes:
            raise ValueError(f"it announces a sparse matrix of shape {shape}, beyond the limit")
        dense = np.zeros(shape, data.dtype)
        np.add.at(dense, self._entries(state), data)
        return dense

    def _entries(self, state) -> tuple[np.ndarray, np.ndarray]:
        raise NotImplementedError


def _expanded(state: dict[str, Any], length: int) -> np.ndarray:
    """The row, or column, of each entry, from where each row's entries end."""
    counts: np.ndarray = np.diff(np.asarray(state["indptr"], np.int64))
    if len(counts) != length or (counts < 0).any() or counts.sum() != len(state["indices"]):
        raise ValueError("a sparse matrix says to have other entries than it has")
    return np.repeat(np.arange(length), counts)


class _SparseColumns(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        return state["indices"], _expanded(state, int(state["_shape"][1]))


class _SparseRows(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        return _expanded(state, int(state["_shape"][0])), state["indices"]


class _SparseCoordinates(_Sparse):
    __slots__ = ()

    def _entries(self, state):
        if "coords" in state:  # SciPy 1.13 and later
            return state["coords"]
        return state["row"], state["col"]


class Admitted:
    """A function that a pickle may call, without attributes that it could set."""

    __slots__ = ()


class _NumpyArrayName(Admitted):
    """numpy.ndarray, which arrays name and nothing may call: it allocates what is announced."""

    __slots__ = ()


NumpyArrayName = _NumpyArrayName()


class _Reconstruct(Admitted):
    """numpy's _reconstruct, for plain arrays only."""

    __slots__ = ()

    def __call__(self, subtype, shape, dtype):
        if subtype is not NumpyArrayName:
            raise TypeError(f"arrays are rebuilt as numpy.ndarray only, not as {subtype!r}")
        if tuple(shape) != (0,):  # as NumPy writes it: size and content follow
            raise ValueError(f"arrays are rebuilt from nothing: got an announced shape {shape}")
        return multiarray._reconstruct(np.ndarray, shape, dtype)


class _Scalar(Admitted):
    """numpy's scalar, for plain numbers and strings only."""

    __slots__ = ()

    def __call__(self, dtype, value=None):
        if not isinstance(dtype, np.dtype) or dtype.hasobject or dtype.names:
            raise TypeError(f"NumPy scalars must be numbers or strings, not {dtype!r}")
        if value is None:
            if dtype.itemsize > _LARGEST_SCALAR:
                raise ValueError(f"a scalar announces {dtype.itemsize:,} bytes")
            return np.zeros((), dtype)[()]
        raw = value.encode("latin1") if isinstance(value, str) else bytes(value)
        return np.frombuffer(raw, dtype, count=1)[0]


class _FromBuffer(Admitted):
    """numpy's _frombuffer, which protocol 5 uses."""

    __slots__ = ()

    def __call__(self, buffer, dtype, shape, order):
        return np.frombuffer(buffer, dtype).reshape(shape, order=order)


class _Rebuild(Admitted):
    """copyreg's _reconstructor, for the stand-ins only."""

    __slots__ = ()

    def __call__(self, cls, base, state):
        if not (isinstance(cls, type) and issubclass(cls, StandIn)) or base is not object:
            raise TypeError(f"copyreg._reconstructor may rebuild stand-ins only, not {cls!r}")
        return cls()


class _Encode(Admitted):
    """_codecs.encode, by which Python 3 writes bytes in protocol 2: Latin-1 only."""

    __slots__ = ()

    def __call__(self, text, encoding="latin1"):
        if codecs.lookup(encoding).name != "iso8859-1":
            raise ValueError(f"bytes are read as latin1 only, not as {encoding!r}")
        return text.encode("latin1")


def _admitted() -> dict[tuple[str, str], Any]:
    table: dict[tuple[str, str], Any] = {
        ("numpy", "ndarray"): NumpyArrayName,
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


ADMITTED = _admitted()
"""By module and name, what answers it."""


def plain(value: Any, max_bytes: int = _MAX_BYTES) -> Any:
    """The dense NumPy array of a stand-in; any other value as it is.

    Args:
        value: what a pickle holds.
        max_bytes: the most that a sparse matrix may take once it is dense.

    Raises:
        ValueError: it takes more, or contradicts itself.
    """
    if isinstance(value, StandIn):
        return value.as_array(max_bytes)  # pyright: ignore[reportAttributeAccessIssue]
    return value


def _dense(value: Any, max_bytes: int) -> np.ndarray:
    """A value as an array, once its lists hold no more entries than the limit lets in.

    A list that holds another one ten times, which holds a third ten times, takes a few bytes in a
    pickle and any number of them as an array.
    """
    if 8 * _entries(value) > max_bytes:
        raise ValueError("its lists hold more entries than the limit")
    return np.asarray(value)


def _entries(value: Any) -> float:
    """How many entries nested lists have in all; each list is looked at once, wherever it stands.

    A list that holds itself has infinitely many.
    """
    known: dict[int, float] = {}
    left = [value]
    while left:
        item = left[-1]
        inner = [x for x in item if _is_list(x)] if _is_list(item) else []
        fresh = [x for x in inner if id(x) not in known]
        if id(item) not in known and fresh:
            known[id(item)] = math.inf  # until what it holds is known
            left += fresh
            continue
        left.pop()
        own = float(len(item)) if _is_list(item) else 0.0
        known[id(item)] = own + sum(known[id(x)] for x in inner)
    return known[id(value)]


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def dense_array(value: Any, max_bytes: int | None = None) -> np.ndarray:
    """Whatever a pickle holds as a dense array: a stand-in, an array, or nested lists.

    Args:
        value: what the pickle holds.
        max_bytes: the limit; 1 GiB where None.

    Raises:
        ValueError, TypeError, KeyError: it is none, or larger.
    """
    limit = _MAX_BYTES if max_bytes is None else max_bytes
    return _dense(plain(value, limit), limit)
