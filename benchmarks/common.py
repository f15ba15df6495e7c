"""What the benchmarks share: tables, progress, and their sections of results.md."""

import datetime
import importlib.metadata
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import rich.table
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from spt_jax import config
from spt_jax.files.outputs import atomic_write

# Batches are timed as those are measured who ask for it.
config.processes = "auto"

RESULTS = Path(__file__).with_name("results.md")
FIGURES = Path(__file__).with_name("figures")

_HEADING = """# Results

What the scripts of this folder printed. Each section names the command that wrote it, the date, the
versions and the processor cores; running the command again replaces that section alone. Times are
medians of repeated runs, in one process unless the section says otherwise. The machine is a shared
one with two cores, so a time can be a few tens of per cent too long; counts, ratios and volumes do
not depend on it.
"""


class Table(NamedTuple):
    """A titled table of ready-made strings, for the terminal and for results.md."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def print(self) -> None:
        """Print it on standard output, whole: a pipe has no width to fit it to."""
        console = Console()
        console = console if console.is_terminal else Console(width=160)
        table = rich.table.Table(title=self.title, title_justify="left", title_style="bold")
        for index, name in enumerate(self.header):
            table.add_column(name, justify="right" if index else "left")
        for row in self.rows:
            table.add_row(*row)
        console.print(table)

    def markdown(self) -> str:
        """The table in GitHub's Markdown, under its title in bold."""
        rule = ["---"] + ["---:"] * (len(self.header) - 1)
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, rule, *self.rows)]
        return "\n".join([f"**{self.title}**", "", *lines])


def progress() -> Progress:
    """A progress bar on standard error that shows nothing where that is not a terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def provenance(command: str) -> str:
    """One line: the command, the date, the versions and the number of cores."""
    versions = [f"Python {platform.python_version()}"] + [
        f"{name} {importlib.metadata.version(name)}" for name in ("spt-jax", "jax", "numpy")
    ]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    date = datetime.date.today().isoformat()
    return f"`{command}`; {date}; {', '.join(versions)}; {cores} cores ({platform.machine()})."


def record_section(name: str, title: str, body: str) -> None:
    """Write one section of results.md, in place of its last version or else at the end.

    Args:
        name: what its markers are called: `<!-- name:start -->` and `<!-- name:end -->`.
        title: the section's heading.
        body: Markdown.

    Raises:
        ValueError: results.md has one of the two markers without the other, or has one twice.
        OSError: results.md cannot be written.
    """
    start, end = f"<!-- {name}:start -->", f"<!-- {name}:end -->"
    section = f"{start}\n## {title}\n\n{body.strip()}\n{end}"
    text = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else _HEADING
    found = text.count(start), text.count(end)
    if found == (0, 0):
        text = f"{text.rstrip()}\n\n{section}\n"
    elif found == (1, 1) and text.index(start) < text.index(end):
        before, rest = text.split(start)
        text = before + section + rest.split(end)[1]
    else:
        raise ValueError(
            f"results.md must hold {start} and {end} once each, in order, or neither: got "
            f"{found[0]} and {found[1]}; mend the markers by hand."
        )
    with atomic_write(RESULTS) as temporary:
        temporary.write_text(text, encoding="utf-8")
