"""How much of the package the tests run: `python -m benchmarks.coverage --record`.

Runs the whole suite, the slow tests too, and takes as long.
"""

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path, PurePath

import tyro

from benchmarks.common import Table, provenance, record_section

TARGET = 90.0  # per cent of the lines


@dataclass
class Settings:
    """What is run."""

    tests: tuple[str, ...] = ()
    """Files of tests; all of them by default."""
    record: bool = False
    """Put the table into results.md."""


def measured(tests: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Lines that ran and all lines, by file.

    Raises:
        RuntimeError: a test failed, so that what it would have run is not known.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "coverage.json"
        command = [sys.executable, "-m", "pytest", "-m", "", "--cov=spt_jax"]
        command += ["--cov-report=", f"--cov-report=json:{report}", *tests]
        if subprocess.run(command).returncode:
            raise RuntimeError("tests must pass for their coverage to be known: some failed.")
        files = json.loads(report.read_text(encoding="utf-8"))["files"]
    found = {name: content["summary"] for name, content in files.items()}
    return {name: (s["covered_lines"], s["num_statements"]) for name, s in found.items()}


def table_of(lines: dict[str, tuple[int, int]]) -> Table:
    """By folder of the package, and in all."""
    folders: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for name, (ran, of) in lines.items():
        inside = PurePath(name).parts[1:]
        for group in (f"{inside[0]}/" if len(inside) > 1 else "modules at the top", "in all"):
            folders[group][0] += ran
            folders[group][1] += of
    names = [*sorted(folders.keys() - {"in all"}), "in all"]
    rows = [(n, str(folders[n][1]), f"{100 * folders[n][0] / folders[n][1]:.1f}") for n in names]
    return Table("Lines of spt_jax that the tests run", ("where", "lines", "%"), rows)


def main(settings: Settings) -> None:
    """Print the table, and record it."""
    lines = measured(settings.tests)
    table = table_of(lines)
    table.print()
    if settings.record:
        note = f"Lines of code, without docstrings; the target is {TARGET:.0f} %."
        body = [provenance("python -m benchmarks.coverage --record"), note, table.markdown()]
        record_section("coverage", "Coverage", "\n\n".join(body))
    if float(table.rows[-1][2]) < TARGET and not settings.tests:
        sys.exit(1)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
