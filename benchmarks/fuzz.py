"""Meshes, files and calls at random, for hours: `python -m benchmarks.fuzz --hours N`.

Every case is rebuilt by the seed and its number, which a failure prints: `--only meshes:12345`.
Cases run in processes of their own with a limit on memory, so that a crash or a hang is counted,
and the run goes on. It ends with 1 where anything failed. With `--log` every case is written down
as it is done, and a run that was ended goes on where it was: the same command again.
"""

import collections
import importlib
import itertools
import json
import multiprocessing
import os
import resource
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import tyro

from benchmarks.common import Table, provenance, record_section
from benchmarks.fuzz_formats import FORMATS

Topic = Literal["meshes", "files", "calls"]
_TOPICS: tuple[Topic, ...] = get_args(Topic)
# Of numbers, so many to a message; of seconds, what one case takes at most, compiling included.
_BATCH = {"meshes": 20, "files": 20, "calls": 1}
_PATIENCE = 120.0
# Without counts, what share of the time each gets.
_SHARE = {"meshes": 0.45, "files": 0.3, "calls": 0.25}
_MEMORY = 2**30  # beyond what a process has at its start


@dataclass
class Settings:
    """How much is tried. With hours or seconds the three share the time; else counts are done."""

    hours: float = 0.0
    seconds: float = 0.0
    meshes: int = 2000
    files: int = 2000
    calls: int = 50
    seed: int = 0
    only: str = ""
    """One case, such as meshes:12345; the process that is asked runs it by itself."""
    log: Path | None = None
    """A file of one line for each case; those that are in it already are not tried again."""
    processes: int = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    record: bool = False
    """Write the tables into results.md."""


class Case(NamedTuple):
    """One case that was tried."""

    topic: Topic
    number: int
    row: str
    column: str
    faults: list[str]
    seconds: float = 0.0


def main(settings: Settings) -> int:
    if settings.only:
        topic, _, number = settings.only.partition(":")
        if topic not in _TOPICS or not number.isdecimal():
            print(f"only must be such as meshes:12345: got {settings.only!r}.", file=sys.stderr)
            return 2
        cases = [_tried(topic, settings.seed, int(number))]
        print(f"{settings.only}: {cases[0].row}, {cases[0].column}")
        return _told(cases, settings.seed)
    seconds = settings.seconds + 3600 * settings.hours
    known, cases, failed = _logged(settings), [], 0
    for topic in _TOPICS:
        count = None if seconds else getattr(settings, topic)
        room = seconds * _SHARE[topic] if seconds else float("inf")
        found = [case for case in known if case.topic == topic and _is_asked(case, count)]
        found += _run(topic, settings, count, room, {case.number for case in found})
        failed |= _told(found, settings.seed)
        cases += found
    tables = _tables(cases)
    for table in tables:
        table.print()
    took, faulty = sum(case.seconds for case in cases), sum(bool(case.faults) for case in cases)
    print(f"{len(cases):,} cases, {took:.0f} s by themselves, {faulty} failed.")
    if settings.record:
        _record(settings, cases, tables, took)
    return failed


def _tried(topic: Topic, seed: int, number: int) -> Case:
    """One case; whatever is raised that should not be is its fault."""
    check = importlib.import_module(f"benchmarks.fuzz_{topic}").check
    start = time.monotonic()
    try:
        row, column, faults = check(seed, number)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        told = f"{type(error).__name__}: {error} ({where.name}, line {where.lineno})"
        row, column, faults = "any", "raised", [told]
    return Case(topic, number, row, column, faults, round(time.monotonic() - start, 4))


def _serve(topic: Topic, seed: int, pipe: Any) -> None:
    """A process that runs the cases it is sent and answers case by case."""
    # The first cases, of every format, import and compile what the limit is not meant for.
    for number in range(len(FORMATS) if topic == "files" else 1):
        _tried(topic, seed, number)
    with open("/proc/self/statm") as file:
        held = int(file.read().split()[0]) * resource.getpagesize()
    if topic != "calls":  # whose programs compile in as much memory as they like
        resource.setrlimit(resource.RLIMIT_AS, (held + _MEMORY, held + _MEMORY))
    pipe.send("ready")
    while (numbers := pipe.recv()) is not None:
        for number in numbers:
            pipe.send(_tried(topic, seed, number))


def _run(
    topic: Topic, settings: Settings, count: int | None, seconds: float, known: set[int]
) -> list[Case]:
    """Cases from number 0 on but for those `known`, until there are as many or the time is up."""
    numbers = (k for k in range(sys.maxsize if count is None else count) if k not in known)
    batches = iter(lambda: tuple(itertools.islice(numbers, _BATCH[topic])), ())
    cases: list[Case] = []
    lock, end = threading.Lock(), time.monotonic() + seconds

    def drive() -> None:
        process = pipe = None
        while time.monotonic() < end:
            with lock:
                batch = next(batches, None)
            if batch is None:
                break
            while batch:
                if process is None:
                    process, pipe = _started(topic, settings.seed)
                found = _answers(process, pipe, topic, batch)
                with lock:
                    cases.extend(found)
                    _log(settings, found)
                batch = batch[len(found) :]
                if not process.is_alive():
                    process = None
        if process is not None and pipe is not None:
            pipe.send(None)
            process.join()

    with ThreadPoolExecutor(settings.processes) as drivers:
        for driver in [drivers.submit(drive) for _ in range(settings.processes)]:
            driver.result()
    done = len(cases) + len(known)
    if done < (1 if count is None else count):
        raise RuntimeError(f"{count or 'some'} {topic} must be tried: got {done}.")
    return cases


def _is_asked(case: Case, count: int | None) -> bool:
    return count is None or case.number < count


def _log(settings: Settings, cases: Iterable[Case]) -> None:
    if settings.log is not None:
        with settings.log.open("a") as file:
            file.writelines(json.dumps([settings.seed, *case]) + "\n" for case in cases)


def _logged(settings: Settings) -> list[Case]:
    """The cases of this seed in the log; a last line that was cut off is ignored."""
    if settings.log is None or not settings.log.exists():
        return []
    text = settings.log.read_text()
    whole, cut = text[: text.rfind("\n") + 1], text[text.rfind("\n") + 1 :]
    if cut:
        settings.log.write_text(whole)
    lines = (json.loads(line) for line in whole.splitlines())
    return [Case(*fields) for seed, *fields in lines if seed == settings.seed]


def _started(topic: Topic, seed: int) -> tuple[Any, Any]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(topic, seed, theirs), daemon=topic != "calls")
    process.start()
    theirs.close()
    if not ours.poll(_PATIENCE):
        process.kill()
        raise RuntimeError(f"a process for {topic} did not start within {_PATIENCE:g} s.")
    try:
        ours.recv()
    except EOFError:
        raise RuntimeError(f"a process for {topic} ended at once; run --only {topic}:0.") from None
    return process, ours


def _answers(process, pipe, topic: Topic, numbers: Sequence[int]) -> list[Case]:
    """Cases as they are answered; the last one is that which crashed or hung the process."""
    pipe.send(list(numbers))
    cases = []
    for number in numbers:
        try:
            if pipe.poll(_PATIENCE):
                cases.append(pipe.recv())
                continue
            what = f"no answer in {_PATIENCE:g} s"
            process.kill()
        except (EOFError, ConnectionError):
            what = "the process ended with {}"
        process.join()
        pipe.close()
        fault = what.format(process.exitcode)
        cases.append(Case(topic, number, "any", "crash or hang", [fault]))
        break
    return cases


def _told(cases: list[Case], seed: int) -> int:
    """Print what failed, with what rebuilds it; 1 if anything did."""
    failed = sorted((case for case in cases if case.faults), key=lambda case: case.number)
    for case in failed:
        command = f"python -m benchmarks.fuzz --seed {seed} --only {case.topic}:{case.number}"
        for fault in case.faults:
            print(f"FAILED {case.row}, {case.column}: {fault}\n  {command}")
    return int(bool(failed))


def _tables(cases: list[Case]) -> list[Table]:
    tables = []
    for topic in _TOPICS:
        ours = [case for case in cases if case.topic == topic]
        if not ours:
            continue
        columns = sorted({case.column for case in ours})
        counts = collections.Counter((case.row, case.column) for case in ours)
        failed = collections.Counter(case.row for case in ours if case.faults)
        rows = [
            (row, *(f"{counts[row, column]:,}" for column in columns), str(failed[row]))
            for row in sorted({case.row for case in ours})
        ]
        title = f"{len(ours):,} {topic}, {sum(failed.values())} failed"
        tables.append(Table(title, (topic, *columns, "failed"), rows))
    return tables


_ABOUT = """Meshes are measured as given, with their rows in another order or turned by 90 degrees,
and held against exact rational arithmetic (boxes along the axes) or manifold3d. Files are written
in another way that means the same, or damaged: then they must be refused by one line with their
name, or read as something whole. Calls are held against the plain call. Failed: a wrong value, a
gradient that breaks a law, something read without a word, another error, a crash, a hang, or more
memory than 300 MB."""


def _record(settings: Settings, cases: list[Case], tables: list[Table], took: float) -> None:
    given = [f"--{topic} {sum(case.topic == topic for case in cases)}" for topic in _TOPICS]
    command = f"python -m benchmarks.fuzz {' '.join(given)} --seed {settings.seed} --record"
    parts = [provenance(command), f"{_ABOUT} The cases took {took / 60:.0f} minutes."]
    record_section("fuzz", "Fuzz", "\n\n".join([*parts, *(t.markdown() for t in tables)]))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings)))
