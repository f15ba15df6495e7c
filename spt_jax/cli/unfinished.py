"""Runs that go on where they were: what is done of one is kept, item by item, until it ends well.

While a run works, `OUT/unfinished` holds manifest.json, which says what the run is made from, and a
file for each item that is done. Whatever ends the run, the same command goes on with the next item;
when all results stand, the folder is gone.
"""

import hashlib
import json
import os
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from spt_jax.files.archives import read_npz
from spt_jax.files.limits import read_json
from spt_jax.files.outputs import atomic_write, ensure_folder, write_json

FOLDER = "unfinished"
_MANIFEST = "manifest.json"
_LOCK = "lock"
_PART = "{:06d}.npz"
_NUMBERED = re.compile(r"\d{6,}\.npz")
# As `atomic_write` names what is not whole yet: a killed run leaves it behind.
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.(npz|json|glb|png)")


class UnfinishedRun:
    """What is done of a run; a context that lets go of it, and leaves nothing if nothing is done.

    Args:
        out: the folder of the results, which exists.
        manifest: what the results depend on, as JSON types: command, versions, settings, inputs.
        say: is called with a line about what was found.
        anew: throw away what another run left, whatever it was.

    Raises:
        ValueError: `out` holds what is done of a run with another manifest; one that works now.
        OSError: the folder cannot be written.
    """

    def __init__(
        self,
        out: Path,
        manifest: Mapping[str, Any],
        *,
        say: Callable[[str], None],
        anew: bool = False,
    ):
        self.folder = ensure_folder(out / FOLDER)
        self._say = say
        self._lock = _locked(self.folder)
        try:
            for place in (out, self.folder):
                _remove(path for path in place.iterdir() if _TEMPORARY.fullmatch(path.name))
            if anew and (self.folder / _MANIFEST).exists():
                _remove([*self._parts(), self.folder / _MANIFEST])
            self._begin(json.loads(json.dumps(manifest)))
        except BaseException:
            self._release()
            raise

    def _begin(self, manifest: Any) -> None:
        path = self.folder / _MANIFEST
        if not path.exists():
            if self._parts():
                raise ValueError(
                    f"out must not hold numbered files of another kind: got {self.folder} without "
                    f"{_MANIFEST}; choose another --out, or remove it."
                )
            write_json(path, manifest)
            return
        difference = _difference(read_json(path, "manifest"), manifest)
        if difference is not None:
            raise ValueError(
                f"out must not hold another run that is not finished: got {self.folder}, where "
                f"{difference}; finish that run with its own command, choose another --out, or "
                "throw away what is done of it with --anew."
            )
        if len(self):
            self._say(f"{len(self)} done before, kept in {self.folder}; this run goes on there")

    def __enter__(self) -> "UnfinishedRun":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        done = len(self._parts())
        if done and kind is not None:
            self._say(f"{done} done and kept in {self.folder}; the same command goes on there")
        self._release(and_remove=not done)

    def __len__(self) -> int:
        return len(self._parts())

    def found(self, item: int) -> dict[str, np.ndarray] | None:
        """The arrays kept of an item; None where it is not done, or its file is damaged."""
        path = self.folder / _PART.format(item)
        if not path.exists():
            return None
        try:
            return read_npz(path, what="kept item").arrays
        except (ValueError, OSError):
            self._say(f"{path} is damaged; what it held is made again")
            return None

    def keep(self, item: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Write what is done of an item, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        path = self.folder / _PART.format(item)
        with atomic_write(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)

    def finish(self) -> None:
        """Remove all that was kept: the results stand."""
        _remove(self._parts())

    def _parts(self) -> list[Path]:
        return [path for path in self.folder.glob("*.npz") if _NUMBERED.fullmatch(path.name)]

    def _release(self, and_remove: bool = False) -> None:
        if and_remove:
            _remove([self.folder / _MANIFEST, self.folder / _LOCK])
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if and_remove and not any(self.folder.iterdir()):
            self.folder.rmdir()


def manifest_of(
    command: str,
    settings: Mapping[str, Any],
    body: Any,
    items: Sequence[tuple[str, Sequence[Any]]],
) -> dict[str, Any]:
    """All that the results of a run depend on.

    Args:
        command: its name.
        settings: the options that change a result.
        body: the `BodyModel` or `RigModel`.
        items: the name of each and what it is made from: arrays, strings, numbers, None.
    """
    import jax

    from spt_jax.cli.frames import versions

    found = {name: value for name, value in versions().items() if name != "platform"}
    device = jax.devices()[0]
    inputs = [*jax.tree.leaves(body), str(body.parents), str(body.joint_names)]
    return {
        "format": 1,
        "command": command,
        "versions": found | {"code": _code_digest()},
        "machine": {
            "processor": platform.machine(),
            "device": f"{device.platform} {device.device_kind}",
            "float64": bool(jax.config.jax_enable_x64),  # pyright: ignore[reportAttributeAccessIssue]
            "XLA_FLAGS": os.environ.get("XLA_FLAGS", ""),
        },
        "settings": dict(settings),
        "body": digest(inputs),
        "items": [{"name": name, "made from": digest(given)} for name, given in items],
    }


def digest(values: Iterable[Any]) -> str:
    """A hash of arrays, with their dtypes and shapes, and of anything else as `repr` has it."""
    found = hashlib.sha256()
    for value in values:
        if value is None or isinstance(value, (str, int, float, tuple)):
            found.update(repr(value).encode())
            continue
        array = np.ascontiguousarray(value)
        found.update(f"{array.dtype.str}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _code_digest() -> str:
    """Of the package's sources: a version says little while they are worked on."""
    package = Path(__file__).parent.parent
    files = sorted(package.rglob("*.py"))
    names = [str(path.relative_to(package)) for path in files]
    return digest([*names, *(path.read_text(encoding="utf-8") for path in files)])


def _difference(one: Any, other: Any, at: str = "") -> str | None:
    """Where two manifests first differ, in words; None where they are the same."""
    if isinstance(one, dict) and isinstance(other, dict):
        for key in [*other, *(key for key in one if key not in other)]:
            name = f"{at} {key}".strip()
            if key not in one or key not in other:
                return f"{name} is {_said(one, key)} and not {_said(other, key)}"
            found = _difference(one[key], other[key], name)
            if found is not None:
                return found
        return None
    if isinstance(one, list) and isinstance(other, list):
        if len(one) != len(other):
            return f"there are {len(one)} {at} and not {len(other)}"
        pairs = enumerate(zip(one, other, strict=True))
        return next((d for k, (a, b) in pairs if (d := _difference(a, b, f"{at} {k}"))), None)
    return None if one == other else f"{at or 'the manifest'} is {one!r} and not {other!r}"


def _said(content: Mapping[str, Any], key: str) -> str:
    return repr(content[key]) if key in content else "missing"


def _remove(paths: Iterable[Path]) -> None:
    for path in list(paths):
        path.unlink(missing_ok=True)


def _locked(folder: Path) -> int | None:
    """The lock of a folder, which a killed process lets go of; None where there are no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise ValueError(
            f"out must not be worked on by another run: got {folder.parent}, where one works now; "
            "wait for it, or choose another --out."
        ) from error
    except OSError:  # a file system without locks
        os.close(lock)
        return None
    return lock
