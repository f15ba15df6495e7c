"""What the commands share towards the terminal: errors in one line, tables, progress."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

# state(text) says what is being done now; state(text, done=n) also how many items are finished.
State = Callable[..., None]


class CommandError(Exception):
    """What the user can put right: shown as one line, without a traceback, exit code 2."""


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn the errors of reading input and writing output into `CommandError`.

    It wraps only these, never the work between them: an error there is ours and wants its
    traceback.
    """
    try:
        yield
    except (OSError, TypeError, ValueError) as error:
        raise CommandError(" ".join(str(error).split())) from error


@contextmanager
def warnings_as(notes: list[str]) -> Iterator[None]:
    """Collect what is warned of as notes, one sentence each, without a place in the code."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    notes += [str(one.message).rstrip(".") for one in caught]


@contextmanager
def measurable(what: str) -> Iterator[None]:
    """Turn the error about a surface that cannot be measured into `CommandError`, with its name."""
    from spt_jax.overlap.measure import Unmeasurable

    try:
        yield
    except Unmeasurable as error:
        raise CommandError(f"{what}: {' '.join(str(error).split())}") from error


def show(console: Console, text: str, style: str | None = None) -> None:
    """Print one line as it is: paths and messages may hold brackets, and may be long."""
    console.print(text, style=style, markup=False, soft_wrap=True)


def out_console(quiet: bool = False) -> Console:
    """Standard output, for results."""
    return Console(quiet=quiet, highlight=False)


def err_console(quiet: bool = False) -> Console:
    """The standard error stream, for notes and progress."""
    return Console(stderr=True, quiet=quiet, highlight=False)


class SpeedColumn(ProgressColumn):
    """How many items are done a second, over the last ones."""

    def render(self, task: Task) -> Text:
        """The speed, or nothing as long as none is known."""
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s", style="progress.data.speed")


@contextmanager
def progress_bar(total: int, quiet: bool = False) -> Iterator[State]:
    """A bar on the standard error stream or in a notebook, gone when done; else nothing.

    Where it is nothing: output that is no terminal, `quiet`, a notebook without ipywidgets.

    Example:
        >>> with progress_bar(2) as state:
        ...     state("walk/0005", done=1)  # in a notebook also from on_step=... of a search
        ...     state("walk/0006", done=2)
    """
    console = err_console(quiet)
    columns = (
        SpinnerColumn(),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        SpeedColumn(),
        TimeRemainingColumn(compact=True),
        TextColumn("{task.description}", markup=False),
    )
    # rich draws in notebooks by ipywidgets, and warns at every refresh where there are none.
    in_notebook = console.is_jupyter and find_spec("ipywidgets") is not None
    disable = quiet or not (console.is_terminal or in_notebook)
    with Progress(*columns, console=console, transient=True, disable=disable) as progress:
        task = progress.add_task("starting", total=total)

        def state(text: str, done: float | None = None) -> None:
            progress.update(task, description=text, completed=done)

        yield state
