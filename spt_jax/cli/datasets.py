"""What the commands over folders share: bars, the table at the end, exit codes."""

import json as json_format
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from spt_jax.cli.terminal import CommandError, err_console, out_console, show

if TYPE_CHECKING:
    from spt_jax._camera import PinholeCamera
    from spt_jax.datasets import Summary

# Files that are worked on and have a bar of their own; a cluster has more than a screen has lines.
_MOST_BARS = 8

_UNITS = {"volume": ("cm³", 1e6), "ratio": ("%", 100.0)}
_LENGTHS = ("depth", "displacement", "difference")


# Options that every task takes as they are.
_OF_ANY_TASK = ("engine", "processes", "shard", "anew", "retry", "verify", "max_bytes")


@dataclass(frozen=True)
class RunOptions:
    """How the files of a folder are worked on, and what is said of it.

    Attributes:
        engine: "local", processes of this machine, or "ray", a Ray cluster.
        processes: how many, each of one core and 1 GB; "auto": as many as there is room for.
        shard: i/n with i from 0: one of n parts of the files alone, for job arrays.
        ray_address: of the cluster; not given: RAY_ADDRESS, or one on this machine.
        ray_cpus: cores that each file asks of the cluster.
        ray_memory: bytes that each file asks of the cluster.
        ray_retries: how often a file is tried again whose process or node has ended.
        anew: do what is done again, with whatever settings it was made.
        retry: try files again that failed.
        verify: compare what is done with its hashes, not its sizes alone.
        max_bytes: how large a file may be, and its arrays once unpacked; not given: 1 GiB.
        json: print the summary as JSON in place of the table.
        quiet: print errors alone.
    """

    engine: Literal["local", "ray"] = "local"
    processes: int | Literal["auto"] = "auto"
    shard: str | None = None
    ray_address: str | None = None
    ray_cpus: float = 1.0
    ray_memory: int | None = None
    ray_retries: int = 3
    anew: bool = False
    retry: bool = False
    verify: bool = False
    max_bytes: int | None = None
    json: bool = False
    quiet: bool = False


def over_folder(
    start: Callable[..., "Summary"], folder: Path, out: Path, run: RunOptions, **options: Any
) -> int:
    """Run a task over a folder with progress bars, and print the summary; return the exit code.

    Args:
        start: `spt_jax.datasets.clean` or another.
        folder: the data set.
        out: where the results go.
        run: how.
        options: of `start`.

    Raises:
        CommandError: the folder, the output or an option is at fault.
    """
    from spt_jax.datasets.engines.cluster import Resources

    options |= {name: getattr(run, name) for name in _OF_ANY_TASK}
    ray = Resources(run.ray_address, run.ray_cpus, run.ray_memory, run.ray_retries)
    try:
        with _ended_by_sigterm(), _bars(run.quiet) as on_event:
            summary = start(folder, out, ray=ray, on_event=on_event, **options)
    except (OSError, TypeError, ValueError, RuntimeError) as error:
        raise CommandError(" ".join(str(error).split())) from error
    if run.json:
        print(json_format.dumps(summary.as_dict(), indent=2))
    else:
        print_summary(summary, out, out_console(run.quiet))
    if not run.quiet:
        _warn(summary, out)
    return 1 if {"failed", "lost"} & set(summary.by_status) else 0


def folder_camera(
    camera: Path | None,
    focal: float | None,
    center: tuple[float, float] | None,
    max_bytes: int | None,
) -> "PinholeCamera | None":
    """The camera of all files of a folder, if one is given.

    Raises:
        ValueError, TypeError, OSError: a file that holds none; a focal length without a center.
    """
    if camera is None and focal is None and center is None:
        return None
    if camera is not None and (focal is not None or center is not None):
        raise ValueError("camera must be given as a file, or by focal and center: got both.")
    from spt_jax._camera import PinholeCamera
    from spt_jax.cli.annotated import read_camera

    if camera is not None:
        return read_camera(camera, max_bytes=max_bytes)
    if focal is None or center is None:
        raise ValueError("of a folder, focal and center must be given together: got one of them.")
    return PinholeCamera(focal, center)


def refuse_for_folder(**used: bool) -> None:
    """Raise ValueError where an option is given that is for one file."""
    for name, given in used.items():
        if given:
            raise ValueError(f"{name} is for a single file: got it with a folder; leave it out.")


def print_summary(summary: "Summary", out: Path, console: Console) -> None:
    """Print what came of a data set."""
    done = ", ".join(f"{count} {status}" for status, count in summary.by_status.items())
    kept = f", {summary.kept} of them done before" if summary.kept else ""
    show(console, f"{summary.files} files: {done or 'none'}{kept}; {summary.seconds:.0f} s")
    table = _table(summary.figures)
    if table is not None:
        console.print(table)
    show(console, f"in {out}: report.html, manifest.jsonl, manifest.csv, summary.json")


def _warn(summary: "Summary", out: Path) -> None:
    console = err_console()
    if summary.others:
        kinds = ", ".join(f"{count} {kind}" for kind, count in summary.others.items())
        show(console, f"note: left alone, being of another kind: {kinds}", "yellow")
    wrong = [one for one in summary.failures if one["status"] != "done"]
    for one in wrong[:5]:
        show(console, f"{one['status']}: {one['name']}: {one['message'][:300]}", "yellow")
    if len(wrong) > 5:
        show(console, f"and {len(wrong) - 5} more, in {out / 'summary.json'}", "yellow")
    if "failed" in summary.by_status:
        show(console, "note: with --retry, the same command tries failed files again", "yellow")
    if summary.missing:
        show(
            console, f"note: {summary.missing} files are not done: other shards', or left", "yellow"
        )


def _table(figures: Mapping[str, float]) -> Any:
    """Figures before and after beside each other, in units that people read."""
    from rich.table import Table

    names = [name.removesuffix("_before") for name in figures if name.endswith("_before")]
    both = bool(names)
    if not both:
        names = [n for n in figures if n.startswith(("mean_", "largest_")) or n.endswith("frames")]
        names = [n for n in names if n != "largest_memory_bytes"]
    if not names or not figures.get("frames"):
        return None
    table = Table(header_style="bold")
    table.add_column(f"of {figures['frames']:.0f} frames")
    for heading in ("before", "after") if both else ("",):
        table.add_column(heading, justify="right")
    for name in names:
        keys = (f"{name}_before", f"{name}_after") if both else (name,)
        unit, scale = next(
            (u for word, u in _UNITS.items() if word in name),
            ("mm", 1e3) if any(word in name for word in _LENGTHS) else ("", 1.0),
        )
        said = f"{name.replace('_', ' ')}{f', {unit}' if unit else ''}"
        if name == "rejected":
            said = "files that a filter by depth rejects"
        table.add_row(said, *(f"{figures[key] * scale:,.4g}" for key in keys))
    for name in ("mean_displacement", "largest_displacement"):
        if both and name in figures:
            table.add_row(f"{name.replace('_', ' ')}, mm", "", f"{1e3 * figures[name]:,.4g}")
    return table


@contextmanager
def _bars(quiet: bool) -> Iterator[Callable[[Any], None]]:
    """A bar of files, and one of frames for each that is worked on; nothing without a terminal."""
    from spt_jax.datasets import Finished

    console = err_console(quiet)
    columns = (
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(
        *columns, console=console, transient=True, disable=quiet or not console.is_terminal
    ) as progress:
        files = progress.add_task("files", total=None)
        own: dict[str, TaskID] = {}

        def on_event(event: Any) -> None:
            if isinstance(event, Finished):
                if event.item.name in own:
                    progress.remove_task(own.pop(event.item.name))
                progress.advance(files)
                return
            if event.name == "":
                progress.update(files, total=event.total, completed=event.done)
                return
            if event.name not in own and len(own) < _MOST_BARS:
                own[event.name] = progress.add_task(event.name, total=event.total)
            if event.name in own:
                said = f"{event.name}: {event.text}"
                progress.update(
                    own[event.name], completed=event.done, total=event.total, description=said
                )

        yield on_event


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """What schedulers send before they kill ends a run as Ctrl-C does, with its results written."""

    def interrupt(*_: Any) -> NoReturn:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
