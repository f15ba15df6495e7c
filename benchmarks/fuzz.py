"""Meshes, files and calls at random, for hours: `python -m benchmarks.fuzz --hours N`.

Every case is rebuilt by the seed and its number, which a failure prints: `--only meshes:12345`.
Cases run in processes of their own with a limit on memory, so that a crash or a hang is counted,
and the run goes on. It ends with 1 where anything failed.
"""

import collections
import importlib
import multiprocessing
import os
import resource
import sys
import threading
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
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


def main(settings: Settings) -> int:
    if settings.only:
        topic, _, number = settings.only.partition(":")
        if topic not in _TOPICS or not number.isdecimal():
            print(f"only must be such as meshes:12345: got {settings.only!r}.", file=sys.stderr)
            return 2
        cases = [_tried(topic, settings.seed, int(number))]
        print(f"{settings.only}: {cases[0].row}, {cases[0].column}")
        return _told(cases, settings.seed)
    start = time.monotonic()
    seconds = settings.seconds + 3600 * settings.hours
    cases, failed = [], 0
    for topic in _TOPICS:
        count = None if seconds else getattr(settings, topic)
        room = seconds * _SHARE[topic] if seconds else float("inf")
        found = _run(topic, settings, count, room)
        failed |= _told(found, settings.seed)
        cases += found
    tables = _tables(cases)
    for table in tables:
        table.print()
    took = time.monotonic() - start
    print(f"{len(cases):,} cases in {took:.0f} s, {sum(bool(c.faults) for c in cases)} failed.")
    if settings.record:
        _record(settings, cases, tables, took)
    return failed


def _tried(topic: Topic, seed: int, number: int) -> Case:
    """One case; whatever is raised that should not be is its fault."""
    check = importlib.import_module(f"benchmarks.fuzz_{topic}").check
    try:
        return Case(topic, number, *check(seed, number))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        told = f"{type(error).__name__}: {error} ({where.name}, line {where.lineno})"
        return Case(topic, number, "any", "raised", [told])


def _serve(topic: Topic, seed: int, pipe: Any) -> None:
    """A process that tries what it is told to, and answers case by case."""
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


def _run(topic: Topic, settings: Settings, count: int | None, seconds: float) -> list[Case]:
    """Cases from number 0 on, until there are as many or the time is up, by several processes."""
    if count == 0:
        return []
    cases: list[Case] = []
    lock, batches = threading.Lock(), iter(range(0, count or sys.maxsize, _BATCH[topic]))
    end = time.monotonic() + seconds

    def drive() -> None:
        process = pipe = None
        while time.monotonic() < end:
            with lock:
                first = next(batches, None)
            if first is None:
                break
            last = first + _BATCH[topic] if count is None else min(first + _BATCH[topic], count)
            while first < last:
                if process is None:
                    process, pipe = _started(topic, settings.seed)
                case = _answers(process, pipe, topic, range(first, last), cases)
                first = case if case is not None else last
                if case is not None:
                    process = None
        if process is not None and pipe is not None:
            pipe.send(None)
            process.join()

    with ThreadPoolExecutor(settings.processes) as drivers:
        for driver in [drivers.submit(drive) for _ in range(settings.processes)]:
            driver.result()
    if not cases or (count is not None and len(cases) < count):
        raise RuntimeError(f"{count or 'some'} {topic} must be tried: got {len(cases)}.")
    return cases


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


def _answers(process, pipe, topic: Topic, numbers: range, cases: list[Case]) -> int | None:
    """Cases as they are answered; the number to go on with where the process crashed or hung."""
    pipe.send(list(numbers))
    for number in numbers:
        try:
            if pipe.poll(_PATIENCE):
                cases.append(pipe.recv())
                continue
            what = f"no answer in {_PATIENCE:g} s"
            process.kill()
            process.join()
        except (EOFError, ConnectionError):
            process.join()
            what = f"the process ended with {process.exitcode}"
        pipe.close()
        cases.append(Case(topic, number, "any", "crash or hang", [what]))
        return number + 1
    return None


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
    parts = [provenance(command), f"{_ABOUT} It took {took / 60:.0f} minutes."]
    record_section("fuzz", "Fuzz", "\n\n".join([*parts, *(t.markdown() for t in tables)]))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings)))
