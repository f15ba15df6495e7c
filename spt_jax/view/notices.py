"""What a view tells browsers beside its figures: notes on a file, and what did not work."""

import sys
import traceback
from collections.abc import Iterable
from typing import Any

_SECONDS = 15.0


def tell_notes(client: Any, notes: Iterable[str]) -> None:
    """Tell one browser what the user should know of the file that is shown."""
    for note in notes:
        client.add_notification("Note", note, auto_close_seconds=_SECONDS)


def tell_error(server: Any, error: Exception) -> str:
    """Tell every browser what did not work; the message. What nobody expects is printed too."""
    message = " ".join(str(error).split())
    # ImportError: a package that a format needs.
    if not isinstance(error, ImportError | OSError | TypeError | ValueError):
        traceback.print_exception(error, file=sys.stderr)
        message = f"{type(error).__name__}: {message}"
    for client in server.get_clients().values():
        client.add_notification(
            "That did not work", message, auto_close_seconds=_SECONDS, color="red"
        )
    return message
