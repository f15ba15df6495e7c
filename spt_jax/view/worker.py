"""The one thread that computes: what users do is handed to it, and the newest wins."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

Change = Callable[[], None]


class Worker:
    """Runs changes one at a time on its own thread, and refreshes when it has caught up.

    A change posted under the key of one that still waits takes its place, so that dragging a
    handle leaves one change waiting, never a queue. XLA's programs with callbacks must not run on
    two threads at a time: all JAX work of the view is done here.

    Args:
        refresh: called with the keys of the changes done since it was last called.
        on_error: called with what a change or `refresh` raised; the thread goes on.
    """

    def __init__(
        self,
        refresh: Callable[[set[Hashable]], None],
        on_error: Callable[[Exception], None],
    ):
        self._refresh, self._on_error = refresh, on_error
        self._waiting: OrderedDict[Hashable, Change] = OrderedDict()
        self._news = threading.Condition()
        self._busy = self._leaving = False
        self._thread = threading.Thread(target=self._run, name="spt_jax view", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def post(self, key: Hashable, change: Change) -> None:
        """Hand over a change; from any thread, without waiting."""
        with self._news:
            self._waiting.pop(key, None)
            self._waiting[key] = change
            self._news.notify_all()

    def wait_until_idle(self, timeout: float) -> bool:
        """Whether everything posted is done and shown within so many seconds."""
        with self._news:
            return self._news.wait_for(lambda: not (self._waiting or self._busy), timeout)

    def stop(self, timeout: float) -> bool:
        """Take no more changes; whether the thread ended within so many seconds."""
        with self._news:
            self._leaving = True
            self._waiting.clear()
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        done: set[Hashable] = set()
        while True:
            with self._news:
                self._busy = bool(done)
                if not self._waiting and not done:
                    self._news.notify_all()
                    self._news.wait_for(lambda: self._waiting or self._leaving)
                if self._leaving:
                    return
                self._busy = True
                key, change = self._waiting.popitem(last=False) if self._waiting else (None, None)
            try:
                if change is None:
                    keys, done = done, set()
                    self._refresh(keys)
                else:
                    done.add(key)
                    change()
            except Exception as error:  # nothing that one change does may end the view
                self._on_error(error)
