"""A folder in which what is done of a motion is kept: a run that was ended goes on there."""

import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from spt_jax.files.archives import read_npz
from spt_jax.files.limits import read_json
from spt_jax.files.outputs import atomic_write, ensure_folder, write_json

_MANIFEST = "motion.json"


class KeptWindows:
    """What is done of a motion: a file for each piece of it, and one that says of which motion.

    Args:
        folder: where; None keeps nothing.
        made_from: all that the result depends on: arrays, numbers, strings, None.

    Raises:
        ValueError: the folder holds what is done of another motion, or with other options.
        OSError: it cannot be written.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, made_from: Iterable[Any]):
        self._folder = None if folder is None else ensure_folder(folder)
        if self._folder is None:
            return
        wanted = {"format": 1, "versions": _versions(), "made from": _digest(made_from)}
        path = self._folder / _MANIFEST
        if not path.exists():
            write_json(path, wanted)
            return
        found = read_json(path, "kept motion")
        if found != wanted:
            same = isinstance(found, dict) and found.get("versions") == wanted["versions"]
            other = "another motion or other options" if same else "other versions of the packages"
            raise ValueError(
                f"resume must be the folder of the same motion and options: got {self._folder}, "
                f"which holds what was done with {other}; name another folder, or remove it."
            )

    def found(self, name: str) -> dict[str, np.ndarray] | None:
        """What was kept of a piece; None where it is not done, or its file is damaged."""
        path = self._path(name)
        if path is None or not path.exists():
            return None
        try:
            return read_npz(path, what="kept piece").arrays
        except (ValueError, OSError):
            return None  # it is made again, and takes the damaged one's place

    def keep(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Write a piece, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        path = self._path(name)
        if path is not None:
            with atomic_write(path) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, allow_pickle=False, **arrays)

    def _path(self, name: str) -> Path | None:
        return None if self._folder is None else self._folder / f"{name}.npz"


def _versions() -> dict[str, str]:
    from importlib.metadata import version

    found = {name: version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    package = Path(__file__).parent.parent
    # A version says little while the sources are worked on.
    sources = (path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py")))
    device = jax.devices()[0]
    return found | {
        "spt_jax": _digest(sources),
        "device": f"{device.platform} {device.device_kind}",
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
    }


def _digest(values: Iterable[Any]) -> str:
    found = hashlib.sha256()
    for value in values:
        if value is None or isinstance(value, (str, int, float, tuple)):
            found.update(repr(value).encode() + b";")
        else:
            array = np.ascontiguousarray(value)
            found.update(f"{array.dtype.str}{array.shape}".encode())
            found.update(array.tobytes())
    return found.hexdigest()
