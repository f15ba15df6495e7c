"""The events that engines report while files are processed.

An engine takes a store, a task and files, and gives `Finished` and `Progress` as they come. It has
no state worth keeping: what is done stands in the store.
"""

from typing import Any, NamedTuple

from spt_jax.datasets.items.inventory import Item


class Progress(NamedTuple):
    """What is done of a file.

    Attributes:
        name: the file; "" says how many files are done of how many, once, at the start.
        done, total: how many of its frames, or people.
        text: what is done now.
    """

    name: str
    done: int
    total: int
    text: str


class Finished(NamedTuple):
    """A file has its row.

    Attributes:
        item: the file.
        row: None where another run works on it.
    """

    item: Item
    row: dict[str, Any] | None


class StartError(RuntimeError):
    """A process cannot start on the task at all; the message says why."""
