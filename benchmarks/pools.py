"""Whether a kept library could take the place of our pool: `python -m benchmarks.pools [--record]`.

Every law of `benchmarks.pool_laws` is tried on every candidate, each in a process of its own.
Wants `pip install loky psutil`, which nothing else here does. The figures in seconds want an idle
machine with two cores.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.pool_candidates import CANDIDATES
from benchmarks.pool_laws import LAWS, Finding

TOP = Path(__file__).parents[1]
# What depends on the moment is tried so many times, and has to hold each time.
TRIES = {"killed": 4}
NOTE = """
Each law is tried in a process of its own, {tries} times where a worker is killed. By processor
time means twice the seconds of one core over those of both. loky's and Python's pools wait without
end for the rest of an answer whose sender was killed in the middle of it
(`multiprocessing.connection` has no time limit), and for a stopped process when the program ends;
loky's workers stay when the program is killed; spawn imports the user's script, and JAX with it.
Ours stays.
"""
UNGUARDED = """import sys
print("started", flush=True)
import benchmarks.pool_laws
benchmarks.pool_laws.main()
"""


@dataclass
class Settings:
    """What is tried."""

    laws: tuple[str, ...] = tuple(LAWS)
    patience: float = 90.0
    """Seconds after which a law is broken by hanging."""
    record: bool = False
    """Put the table into results.md."""


@contextmanager
def script(law: str) -> Iterator[list[str]]:
    """The command that tries a law, less the candidate's name."""
    if law != "guard":
        yield [sys.executable, "-m", "benchmarks.pool_laws", law]
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "script.py"
        path.write_text(UNGUARDED)
        yield [sys.executable, str(path), law]


def left_of(group: int) -> int:
    """How many processes of a session there are."""
    found = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, session = path.read_text().rsplit(")", 1)[1].split()[:4]
        except (OSError, ValueError):
            continue
        found += int(session) == group and state != "Z"
    return found


def tried(law: str, name: str, patience: float) -> Finding:
    """One law on one candidate."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(TOP), *sys.path]))}
    with script(law) as command:
        process = subprocess.Popen(
            [*command, name],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            start_new_session=True,
        )
        lines: list[str] = []
        found_at = time.monotonic()
        try:
            assert process.stdout is not None
            timer = threading.Timer(patience, os.killpg, (process.pid, 9))
            timer.start()
            for line in process.stdout:
                lines.append(line)
                found_at = time.monotonic()
                if line.startswith('{"met"') or line.startswith('{"pid"'):
                    break
            process.wait()
            took = time.monotonic() - found_at
            hung = not timer.is_alive()
            timer.cancel()
            said = process.stderr.read() if process.stderr and not left_of(process.pid) else ""
        finally:
            deadline = time.monotonic() + 10
            while left_of(process.pid) and time.monotonic() < deadline:
                time.sleep(0.05)
            left = left_of(process.pid)
            if left:
                os.killpg(process.pid, 9)
    return judged(law, lines, process.returncode, took, hung, left, said)


def judged(
    law: str, lines: list[str], code: int, took: float, hung: bool, left: int, said: str
) -> Finding:
    """What was seen from outside, and what the script found itself."""
    if law == "orphan" and code == -9 and not hung:
        return Finding(left == 0, "ends" if left == 0 else f"{left} left after 10 s")
    if law == "guard":
        starts = sum("started" in line for line in lines)
        answered = any(line.startswith("{") for line in lines)
        figure = f"{starts} started" + ("" if answered else ", no answer")
        return Finding(starts == 1 and answered, figure)
    if hung:
        return Finding(False, "hangs")
    found = [json.loads(line) for line in lines if line.startswith("{")]
    if not found:
        return Finding(False, said.strip().splitlines()[-1][:80] if said.strip() else "fails")
    own = Finding(**found[-1])
    if law == "leaves":
        return Finding(code == 0 and left == 0 and took < 10, f"after {took:.1f} s")
    if law == "exit":
        clean = code == 0 and left == 0 and not said.strip()
        what = f"{took:.1f} s, {left} left, {len(said.splitlines())} lines said"
        return Finding(own.met and clean, what)
    return own


def worst(law: str, name: str, patience: float) -> Finding:
    """The law on a candidate, as often as it has to hold."""
    found = [tried(law, name, patience) for _ in range(TRIES.get(law, 1))]
    broken = [one for one in found if not one.met]
    if not broken or len(found) == 1:
        return found[0]
    return broken[0]._replace(figure=f"{len(broken)} of {len(found)}: {broken[0].figure}")


def main(settings: Settings) -> None:
    rows = []
    with progress() as bar:
        task = bar.add_task("laws", total=len(settings.laws) * len(CANDIDATES))
        for law in settings.laws:
            cells = []
            for name in CANDIDATES:
                found = worst(law, name, settings.patience)
                bar.console.log(f"{law}, {name}: {found.met}, {found.figure}")
                cells.append(("" if found.met else "**no**: ") + found.figure)
                bar.advance(task)
            rows.append([LAWS[law][1], *cells])
    table = Table("A worker beside the caller, 16 posed bodies a batch", ("law", *CANDIDATES), rows)
    table.print()
    if settings.record:
        command = provenance("python -m benchmarks.pools --record")
        body = f"{command}\n{NOTE.format(tries=TRIES['killed'])}\n{table.markdown()}"
        record_section("pools", "Pools of processes", body)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
