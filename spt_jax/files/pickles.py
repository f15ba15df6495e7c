"""SMPL's official pickles, read without running anything that they name.

A pickle is a program: it can call whatever it can name. This reader knows a short list of names,
answers each with a harmless function or a stand-in class of its own (`stand_ins.py` lists them one
by one), and refuses every other name before anything of it is imported, let alone called.

Nor are the sizes believed that a pickle announces: what would be allocated by them alone, a table
of references, an empty array, a sparse matrix made dense, is compared with the bytes that there are
and with a limit.
"""

import io
import math
import os
import pickle
import pickletools
import struct
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from spt_jax.files.stand_ins import ADMITTED, StandIn


class RefusedPickleError(ValueError):
    """A pickle names something that this reader does not admit."""


# In Python alone, which is slower by object, of which these files have few: here what an array
# announces can be looked at before NumPy believes it (an array of objects that says to have more of
# them than it has ends NumPy 2.4 with a segmentation fault), and what stands between objects read.
_Unpickler: Any = pickle._Unpickler  # pyright: ignore[reportAttributeAccessIssue]


class GuardedUnpickler(_Unpickler):
    """Python's own unpickler, with a list of names, and nothing believed that is announced.

    Args:
        stream: the pickle.
        names: by module and name, what answers it.
        read: what is read, for the message that refuses any other name.
    """

    dispatch: ClassVar = dict(_Unpickler.dispatch)

    def __init__(
        self,
        stream: io.BytesIO,
        names: Mapping[tuple[str, str], Any] = ADMITTED,
        read: str = "NumPy arrays, SciPy sparse matrices and chumpy arrays",
    ):
        # Latin-1 keeps the bytes of Python 2's strings, in which its arrays are stored.
        super().__init__(stream, encoding="latin1")
        self._stream, self._names, self._read = stream, names, read

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """The stand-in of a name that is admitted."""
        try:
            return self._names[module_name, global_name]
        except KeyError:
            raise RefusedPickleError(
                f"refused: the pickle asks for {module_name}.{global_name}. Only {self._read} are "
                "read; nothing was run. Do not open this file with pickle.load unless you trust "
                "where it comes from."
            ) from None

    def load_build(self) -> None:
        """Python's, for what may have a state, and an array once it has what it announces."""
        target = self.stack[-2]
        if not isinstance(target, StandIn | np.ndarray | np.dtype | OrderedDict):
            raise TypeError(f"it gives a state to {type(target).__name__}")
        if isinstance(target, np.ndarray):
            _check_state(self.stack[-1])
        super().load_build()

    dispatch[pickle.BUILD[0]] = load_build

    def load_bytearray8(self) -> None:
        """Python's, which would allocate whatever is announced."""
        (length,) = struct.unpack("<Q", self.read(8))
        if length > len(self._stream.getbuffer()):  # frames are read ahead of what is left
            raise ValueError(f"it announces {length:,} bytes")
        self.append(bytearray(self.read(length)))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8

    def load_frame(self) -> None:
        """Python's, which takes a frame that is cut for a whole one."""
        (length,) = struct.unpack("<Q", self.read(8))
        if length > len(self._stream.getbuffer()) - self._stream.tell():
            raise ValueError(f"a frame announces {length:,} bytes; it is cut")
        self._unframer.load_frame(length)

    dispatch[pickle.FRAME[0]] = load_frame


def _check_state(state: Any) -> None:
    """Raise where an array of objects announces more of them than it has."""
    _, shape, dtype, _, content = state if len(state) == 5 else (0, *state)
    if dtype.hasobject and math.prod(map(int, shape)) != len(content):
        raise ValueError(f"an array announces the shape {shape} and has {len(content)} objects")


def _check_memo(content: bytes) -> None:
    """Raise where a pickle numbers its references so that the table of them would be huge."""
    numbered = 0
    for opcode, argument, _ in pickletools.genops(content):
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            numbered += 1
            if int(str(argument)) > 4 * numbered + 1000:
                raise ValueError(f"it gives its reference {numbered} the number {argument}")


def read_pickle(path: str | os.PathLike[str], content: bytes | None = None) -> dict[str, Any]:
    """The dictionary in a pickle of plain data, the way Python 2 or 3 wrote it.

    Chumpy arrays and sparse matrices come back as objects that `plain` turns into dense arrays.

    Args:
        path: the file.
        content: the file's bytes, where they have been read already.

    Returns:
        The dictionary.

    Raises:
        RefusedPickleError: the pickle names anything beyond NumPy arrays, SciPy sparse matrices,
            chumpy arrays and plain containers. Nothing has been run then.
        ValueError: the file is damaged, or holds something other than a dictionary.

    Example:
        >>> import os, pickle, tempfile
        >>> from spt_jax.files.pickles import read_pickle
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
    if content is None:
        with open(path, "rb") as file:
            content = file.read()
    try:
        _check_memo(content)
        with warnings.catch_warnings():
            # Python 2's NumPy wrote 0 and 1 for what NumPy 2 wants to be False and True.
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", UserWarning)
            value = GuardedUnpickler(io.BytesIO(content)).load()
    except RefusedPickleError as error:
        raise RefusedPickleError(f"{os.fspath(path)}: {error}") from None
    except Exception as error:
        raise ValueError(
            f"{os.fspath(path)} cannot be read as a pickle: {type(error).__name__}: {error}; it "
            "is truncated or damaged: download it again."
        ) from error
    if isinstance(value, np.ndarray) and value.dtype.hasobject and value.shape == ():
        value = value.item()  # as np.save wraps a dictionary
    if not isinstance(value, dict):
        raise ValueError(
            f"{os.fspath(path)} must hold a dictionary of arrays: got {type(value).__name__}."
        )
    return value
