"""A process that works on files of a data set, one after the other, as it is instructed.

It is started by command line, not forked, because a fork of a process with threads may hang, and
not through `multiprocessing`, which runs the user's main script once more. It ends at once when its
driver has gone: what it was at is done again by whoever comes next.
"""

import os
import pickle
import signal
import sys
import threading
from queue import SimpleQueue
from typing import Any

from spt_jax.datasets.engines.messages import receive, send
from spt_jax.datasets.items.inventory import Item
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.items.work import RoomError, Task, work


def serve() -> None:
    """Answer messages on standard input until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver's to answer
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed belongs to the errors
    orders: SimpleQueue[Any] = SimpleQueue()
    threading.Thread(target=_listen, args=(orders,), daemon=True).start()
    try:
        store, task = pickle.loads(orders.get())
        task.start()
    except Exception as error:
        send(answers, ("failed", f"{type(error).__name__}: {' '.join(str(error).split())}"))
        os._exit(1)  # at once: the thread that listens holds a lock that Python would wait for
    send(answers, ("ready", None))
    while True:
        send(answers, _answer(store, task, orders.get(), answers))


def _listen(orders: "SimpleQueue[Any]") -> None:
    try:
        while True:
            orders.put(receive(sys.stdin.buffer))
    except (EOFError, OSError, ValueError):
        os._exit(0)


def _answer(store: Store, task: Task, item: Item, answers: Any) -> tuple[str, Any]:
    def report(done: int, total: int, text: str) -> None:
        send(answers, ("progress", (done, total, text)))

    try:
        return "row", work(store, task, item, report)
    except RoomError as error:
        return "full", str(error.strerror)
