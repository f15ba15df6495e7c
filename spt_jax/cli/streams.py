"""The standard streams of a command, and what becomes of it when nobody takes what it prints."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class OutputLostError(Exception):
    """A standard stream takes no more: its disk is full, or its reader has gone.

    Attributes:
        stream: "standard output" or "standard error".
        closed: whether it is a pipe whose reader has gone.
    """

    def __init__(self, stream: str, error: OSError):
        super().__init__(f"{stream} must be writable: got {error.strerror}; send it elsewhere")
        self.stream, self.closed = stream, isinstance(error, BrokenPipeError)


class _Guarded:
    """A text stream that says by its own error that it takes no more."""

    def __init__(self, stream: Any, name: str):
        self._stream, self._name = stream, name

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except UnicodeEncodeError as error:  # a file's name, or a unit, that its encoding lacks
            plain = text.encode(error.encoding, "backslashreplace").decode(error.encoding)
            return self._stream.write(plain)
        except OSError as error:
            raise self._lost(error) from error

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            raise self._lost(error) from error

    def _lost(self, error: OSError) -> OutputLostError:
        # What is left in the buffer must go somewhere, or the interpreter complains as it ends.
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError, AttributeError):
            pass
        return OutputLostError(self._name, error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def guarded_streams() -> Iterator[None]:
    """Guard the standard streams while a command runs, and see that all is written at its end.

    Raises:
        OutputLostError: a stream takes no more.
    """
    before = sys.stdout, sys.stderr
    names = "standard output", "standard error"
    guarded = [s and _Guarded(s, name) for s, name in zip(before, names, strict=True)]
    sys.stdout, sys.stderr = guarded  # pyright: ignore[reportAttributeAccessIssue]
    try:
        try:
            yield
        except SystemExit:  # a command's help is written, too
            _flush(guarded)
            raise
        _flush(guarded)
    finally:
        sys.stdout, sys.stderr = before


def _flush(streams: list[Any]) -> None:
    for stream in streams:
        if stream is not None:
            stream.flush()
