"""Data sets: what processes and Ray gain, what a file costs beside its work, and what AMASS would.

    python -m benchmarks.datasets [--files 6] [--record]

Throughput is measured by processor time: how much of it the same files take where one process
works, and where two do side by side. On a machine that others use as well, wall time says how many
these are.
"""

import json
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common import Table, provenance, record_section
from spt_jax import load_mocap
from spt_jax.datasets import clean, run
from spt_jax.io import write_poses

# Of AMASS (Mahmood et al. 2019): more than 40 hours.
HOURS = 40.0
RATE = 30.0
# Shares of frames that collide: of careful captures, of all kinds, and of the bundled acrobatics.
SHARES = (0.01, 0.05, 0.2)
MACHINES = (("a laptop, 8 cores", 8), ("a job array, 64 cores", 64), ("a cluster, 512 cores", 512))


@dataclass
class Settings:
    """Options.

    Attributes:
        files: how many motions of each kind are cleaned.
        cheap: how many files the cost beside the work is taken from.
        ray: whether Ray is run, too.
        record: write the tables into results.md.
    """

    files: int = 6
    cheap: int = 400
    ray: bool = True
    record: bool = False


class Nothing:
    """A task that copies a few bytes."""

    name = "nothing"

    def settings(self) -> dict[str, Any]:
        return {}

    def wants(self, path: Path) -> bool:
        return True

    def start(self) -> None:
        pass

    def work(self, path: Path, out: Path, report: Any) -> dict[str, Any]:
        (out / path.name).write_bytes(path.read_bytes())
        return {"frames": 1}


def processor_seconds() -> float:
    """Of this process and of its children that have ended."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def beside_the_work(top: Path, count: int) -> float:
    """Processor seconds of a file beside its work: what twice as many files take more."""
    taken = []
    for number in (count, 2 * count):
        folder = top / f"cheap{number}"
        folder.mkdir()
        for k in range(number):
            (folder / f"{k}.txt").write_bytes(bytes(1000))
        begin = processor_seconds()
        run(Nothing(), folder, top / f"copied{number}", processes=1)
        taken.append(processor_seconds() - begin)
    return (taken[1] - taken[0]) / count


def motions(folder: Path, count: int) -> None:
    """A walk, of which a tenth collides, and a run that does not, each a little different."""
    mocap = load_mocap()
    folder.mkdir()
    for name in ("walk", "run"):
        rows = [k for k, label in enumerate(mocap.names) if label.startswith(f"{name}/")]
        for k in range(count):
            write_poses(
                folder / f"{name}{k}.npz", (1 - 0.002 * k) * mocap.pose[rows], frame_rate=30
            )


def cleaned(folder: Path, out: Path, **how: Any) -> tuple[list[dict[str, Any]], float]:
    """The rows of a run, and how long it took."""
    begin = time.perf_counter()
    found = clean(folder, out, pictures=0, **how)
    seconds = time.perf_counter() - begin
    assert found.is_whole, found.failures
    rows = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    return rows, seconds


def warm(rows: list[dict[str, Any]], name: str = "walk") -> float:
    """Median processor seconds of a file: most are worked on after the programs are compiled."""
    return float(np.median([r["processor_seconds"] for r in rows if r["name"].startswith(name)]))


def main(settings: Settings) -> None:
    """Measure, print, record."""
    with tempfile.TemporaryDirectory() as name:
        top = Path(name)
        beside = beside_the_work(top, settings.cheap)
        motions(top / "motions", settings.files)
        runs = [("local, 1 process", {"processes": 1}), ("local, 2 processes", {"processes": 2})]
        runs += [("Ray, 2 cores", {"engine": "ray"})] if settings.ray else []
        found = {
            said: cleaned(top / "motions", top / f"out{k}", **how)
            for k, (said, how) in enumerate(runs)
        }
    one = warm(found["local, 1 process"][0])
    table = []
    for said, (rows, seconds) in found.items():
        side_by_side = 1 if "1" in said else 2
        table.append(
            (
                said,
                f"{warm(rows):.2f}",
                f"{side_by_side * one / warm(rows):.2f}",
                f"{seconds:.0f}",
                f"{max(row['largest_memory_bytes'] for row in rows) / 1e9:.2f}",
            )
        )
    throughput = Table(
        f"{2 * settings.files} motions cleaned",
        (
            "engine",
            "processor s a walk",
            "throughput (1 process: 1)",
            "wall s in all",
            "GB a process",
        ),
        table,
    )
    rows = found["local, 1 process"][0]
    calm = next(row for row in rows if row["name"].startswith("run"))
    walk = next(row for row in rows if row["name"].startswith("walk"))
    frame = warm(rows, "run") / calm["frames"]
    colliding = (one - frame * walk["frames"]) / walk["colliding_frames_before"]
    frames = HOURS * 3600 * RATE
    costs = []
    for share in SHARES:
        hours = frames * (frame + share * colliding) / 3600
        walls = (f"{hours / cores:,.1f} h" for _, cores in MACHINES)
        costs.append((f"{share:.0%}", f"{hours:,.0f}", *walls))
    extrapolated = Table(
        f"{HOURS:.0f} hours of motion at {RATE:.0f} frames a second, {frames / 1e6:.2f} million "
        f"frames, extrapolated from {1e3 * frame:.1f} ms a frame and {colliding:.2f} s more for "
        "one that collides",
        ("frames that collide", "hours of a core", *(said for said, _ in MACHINES)),
        costs,
    )
    said = f"A file costs {1e3 * beside:.1f} ms of a core beside its work."
    throughput.print()
    extrapolated.print()
    print(said)
    if settings.record:
        body = "\n\n".join(
            [
                provenance("python -m benchmarks.datasets --record"),
                throughput.markdown(),
                said,
                extrapolated.markdown(),
            ]
        )
        record_section("datasets", "Data sets", body)


if __name__ == "__main__":
    from benchmarks import datasets  # by the name by which other processes import the task

    datasets.main(tyro.cli(datasets.Settings))
