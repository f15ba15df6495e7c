"""Files as they should be and as they should not: part of the fuzz.

Half of them are written in another way that means the same, and must be read the very same. The
others are damaged: they are read as they were before, or as something whole, or are refused by one
ValueError or OSError in one line that has the file's name. Nothing that they name is run.
"""

import copy
import io
import math
import pickle
import re
import resource
import signal
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz_formats import FORMATS, Arrays, Format, Generator, Written, as_json, as_npz
from spt_jax.files.limits import TooLargeError
from spt_jax.files.pickles import RefusedPickleError
from spt_jax.io.poses.reading import UnknownStructureError

SECONDS = 10  # for a file of some kilobytes
MEGABYTES = 300  # that reading it may take beyond what the process has

_PLAIN = (ValueError, TooLargeError, RefusedPickleError, UnknownStructureError, OSError)
_STRANGE: tuple[Any, ...] = (
    *(None, True, "x", "", -1, 0, 2**31, 2**63, 10**400, 1e308, -1e308),
    *(math.nan, math.inf, [], {}, [[]], [None], {"keypoints": None}, "9" * 5000),
)
_WORDS = (b"nan", b"inf", b"-1", b"1e999", b"99999999999999999999", b"x", b"", b"1_0", b"0x1f")
_WIDE = (0, -1, 2**31 - 1, -(2**31), 2**30)


class _TooLongError(BaseException):
    """Reading took longer than SECONDS; no reader catches it by `except Exception`."""


def check(seed: int, number: int) -> tuple[str, str, list[str]]:
    """Write and read one file: its format, what came of it, and what is wrong with that."""
    rng = np.random.default_rng([seed, number, 1])
    name = list(FORMATS)[number % len(FORMATS)]
    form = FORMATS[name]
    written = form.write(rng)
    with tempfile.TemporaryDirectory(prefix="spt-jax-fuzz-") as folder:
        path, called = Path(folder) / f"file{form.suffix}", Path(folder) / "called"
        if rng.integers(2):
            path.write_bytes(written.content)
            _, faults = _read(form, path, written, same=True, what="rewritten")
            return name, "rewritten", faults
        damage, content, same = _damaged(rng, name, form, written, called)
        path.write_bytes(content)
        outcome, faults = _read(form, path, written, same=same, what=damage)
        if called.exists():
            faults.append(f"{damage}: what the file names was run")
        return name, f"damaged, {outcome}", faults


def _read(
    form: Format, path: Path, written: Written, *, same: bool, what: str
) -> tuple[str, list[str]]:
    """How the file is read and what is wrong; `same`: what is read must be what was written."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    faults: list[str] = []
    outcome = "refused"
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            found = _in_time(form.read, path)
        equal = _are_equal(found, written.truth, form.close)
        outcome = "read the same" if equal else "read otherwise"
        faults += _wrong(found, equal or not same, what)
        faults += [f"{what}: warned {str(one.message)[:80]!r}" for one in warned[:1]]
    except _TooLongError:
        faults.append(f"{what}: took more than {SECONDS} s")
    except Exception as error:
        if what == "rewritten":
            faults.append(f"{what}: {type(error).__name__}: {error}")
        faults += _unfit(error, path, what)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    if grown > MEGABYTES:
        faults.append(f"{what}: took {grown:.0f} MB")
    return outcome, faults


def _in_time(read: Callable[[Path], Arrays], path: Path) -> Arrays:
    def end(*_: Any):
        raise _TooLongError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(SECONDS)
    try:
        return read(path)
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _are_equal(found: Arrays, truth: Arrays, close: float) -> bool:
    pairs = zip(found, truth, strict=False)
    return len(found) == len(truth) and all(
        a.shape == b.shape and (np.array_equal(a, b) or bool((np.abs(a - b) <= close).all()))
        for a, b in pairs
    )


def _wrong(found: Arrays, right: bool, what: str) -> list[str]:
    for array in found:
        if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            return [f"{what}: numbers that are not finite were read without a word"]
    return [] if right else [f"{what}: something else was read, without a word"]


def _unfit(error: Exception, path: Path, what: str) -> list[str]:
    """What is wrong with how a file is refused."""
    text = str(error)
    by_name = type(error) in _PLAIN or (isinstance(error, OSError) and error.errno is None)
    if not by_name:
        return [f"{what}: {type(error).__name__}: {text[:120]}"]
    if path.name not in text:
        return [f"{what}: the message lacks the file: {text[:120]}"]
    if "\n" in text:
        return [f"{what}: the message has several lines: {text[:120]!r}"]
    if "must fit into memory" in text:
        return [f"{what}: memory ran out"]
    return []


def _damaged(
    rng: Generator, name: str, form: Format, written: Written, called: Path
) -> tuple[str, bytes, bool]:
    """What was done, the content, and whether it must still be read the same or be refused."""
    if written.parts is not None and rng.random() < 0.6:
        if form.suffix == ".npz":
            return _damaged_arrays(rng, written.parts)
        if form.suffix == ".pkl":
            return _damaged_pickle(rng, written.parts, called)
        return _damaged_json(rng, written.parts)
    content = written.content
    way = rng.integers(8)
    place = int(rng.integers(len(content)))
    if way == 0:
        whole = content.rstrip()
        lines = form.text and b"\0" not in content
        cut = content[:place]
        if lines:  # the end of the last line may be lost without a trace
            cut = cut[: cut.rfind(b"\n") + 1]
        same = form.counted and not (lines and cut.rstrip() == whole)
        return f"cut after {len(cut)} of {len(content)} bytes", cut, same
    if way == 1:
        flipped = bytearray(content)
        for k in rng.integers(len(content), size=rng.integers(1, 5)):
            flipped[k] ^= 1 << int(rng.integers(8))
        return "bits flipped", bytes(flipped), form.summed
    if way == 2:
        strange = rng.integers(256, size=rng.integers(1, 40)).astype(np.uint8).tobytes()
        return "bytes inserted", content[:place] + strange + content[place:], False
    if way == 3:
        word = struct.pack(("<i", ">i")[rng.integers(2)], _WIDE[rng.integers(len(_WIDE))])
        return "a word replaced", content[:place] + word + content[place + 4 :], form.summed
    if way == 4:
        end = place + int(rng.integers(1, 200))
        return "bytes left out", content[:place] + content[end:], False
    if way == 5:
        deep = (b"[", b'{"a":', b"(", b"\x80\x02(")[rng.integers(4)] * int(10 ** rng.uniform(2, 5))
        return "nested deeply", content[:place] + deep + content[place:], False
    if way == 6:
        numbers = list(re.finditer(rb"-?\d+(\.\d+)?([eE][+-]?\d+)?", content))
        if numbers:
            one = numbers[rng.integers(len(numbers))]
            word = _WORDS[rng.integers(len(_WORDS))]
            changed = content[: one.start()] + word + content[one.end() :]
            return f"{one.group()[:20]!r} replaced by {word!r}", changed, False
    other = list(FORMATS)[rng.integers(len(FORMATS))]
    return f"{other} under this name", FORMATS[other].write(rng).content, False


def _damaged_arrays(rng: Generator, arrays: dict[str, Any]) -> tuple[str, bytes, bool]:
    """An .npz whose checksums are right and one of whose arrays is not."""
    key = list(arrays)[rng.integers(len(arrays))]
    if rng.integers(4) == 0:
        return f"{key} announced large", _announced(rng, arrays, key), False
    what, array = _strange_array(rng, np.asarray(arrays[key]))
    return f"{key} {what}", as_npz(rng, arrays | {key: array}), False


def _strange_array(rng: Generator, array: np.ndarray) -> tuple[str, np.ndarray]:
    way = rng.integers(7)
    with np.errstate(all="ignore"):
        if way == 0:
            array = np.array(array, copy=True)
            if array.dtype.kind == "f" and array.size:
                array.reshape(-1)[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e300])
            return "with a number that is none", array
        if way == 1:
            return "of objects", np.full(array.shape, None, object)
        if way == 2:
            return "of text", np.full(array.shape, "x")
        if way == 3 and array.dtype.kind in "fiu":
            return "complex", array.astype(complex) + 1j
        if way == 4:
            return "empty", np.zeros((0, *array.shape[1:]))
        if way == 5:
            return "of another shape", array.ravel()[: max(array.size - 1, 0)]
        return "in another place", array.T


def _announced(rng: Generator, arrays: dict[str, Any], key: str) -> bytes:
    """An .npz in which one array's header announces far more than there is."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            one = io.BytesIO()
            np.lib.format.write_array(one, np.asarray(array))
            content = one.getvalue()
            if name == key:
                shape = (int(10 ** rng.uniform(8, 18)), *np.shape(array)[1:])
                one = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    one, {"descr": "<f8", "fortran_order": False, "shape": shape}
                )
                content = one.getvalue() + b"\0" * 64
            archive.writestr(f"{name}.npy", content)
    return file.getvalue()


class _Call:
    """Pickled, a call of `open(path, "w")`, or of something harmless that is not admitted."""

    def __init__(self, function: Callable[..., Any], *given: Any):
        self.made = function, given

    def __reduce__(self):
        return self.made


def _damaged_pickle(
    rng: Generator, arrays: dict[str, Any], called: Path
) -> tuple[str, bytes, bool]:
    key = list(arrays)[rng.integers(len(arrays))]
    if rng.integers(2):
        held = arrays.get("v_template", arrays[key])
        held = held if isinstance(held, np.ndarray) else np.asarray([0.5, 1.0])
        what, value = _strange_array(rng, held)
        what = f"{key} {what}"
    else:
        what, value = f"{key} a call", _calls(called)[rng.integers(len(_calls(called)))]
    content = pickle.dumps(arrays | {key: value}, protocol=int(rng.integers(2, 6)))
    return what, content, False


def _calls(called: Path) -> tuple[_Call, ...]:
    return (
        _Call(open, str(called), "w"),
        _Call(eval, f"open({str(called)!r}, 'w')"),
        _Call(bytearray, 2**40),
        _Call(np.zeros, 2**40),
        _Call(__import__, "os"),
    )


def _damaged_json(rng: Generator, value: Any) -> tuple[str, bytes, bool]:
    """JSON with one node replaced, or taken out."""
    value = copy.deepcopy(value)
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in node if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(value)
    # Nodes near the root as often as the numbers, of which there are many more.
    named = [place for place in places if isinstance(place[1], str)]
    places = named if named and rng.integers(2) else places
    node, key = places[rng.integers(len(places))]
    if rng.integers(4) == 0:
        del node[key]
        return f"{key!r} left out", as_json(rng, value), False
    strange = _STRANGE[rng.integers(len(_STRANGE))]
    node[key] = strange
    return f"{key!r} replaced by {str(strange)[:20]!r}", as_json(rng, value), False
