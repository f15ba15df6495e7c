"""Ctrl-C, wherever it is heard: it ends a command with one line and no file half-written."""

import os
import signal
import sys
import threading
from _thread import interrupt_main
from typing import NoReturn


def is_interruption(error: BaseException) -> bool:
    """Whether an error is Ctrl-C, or Ctrl-C that was heard within a callback of a computation.

    The latter JAX hands on as a ValueError or a RuntimeError, as it dispatches at once or not, with
    the callback's traceback as its text.
    """
    if isinstance(error, KeyboardInterrupt):
        return True
    if not isinstance(error, ValueError | RuntimeError):
        return False
    return "CpuCallback error" in str(error) and "KeyboardInterrupt" in str(error)


def hear_again() -> None:
    """Raise Ctrl-C again where Python ignored it, for as long as the process lives.

    What a finalizer or a callback of the garbage collector raises, Python prints and ignores, and
    JAX has such a callback: in one of some twenty interrupted demos the demo went on to its end. It
    is raised again a moment later, since raising it here would be ignored in turn.
    """
    before = sys.unraisablehook

    def hook(unraisable: "sys.UnraisableHookArgs") -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            again = threading.Timer(0.05, _interrupt)
            again.daemon = True
            again.start()
        else:
            before(unraisable)

    sys.unraisablehook = hook


def _interrupt() -> None:
    if hasattr(signal, "pthread_kill"):  # this ends what the main thread waits for, too
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        interrupt_main()


def say_interrupted() -> int:
    """Print the line, and return the exit code."""
    print("spt-jax: interrupted; no file is left half-written", file=sys.stderr)
    return 130


def leave_at_once(code: int) -> NoReturn:
    """End the process without shutting the interpreter down.

    An interrupted computation goes on in XLA's threads and calls back into Python; one that does so
    while the interpreter shuts down ends the process with a segmentation fault (3 of 4 interrupted
    demos). Files are whole by now, so there is nothing that shutting down would do.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
