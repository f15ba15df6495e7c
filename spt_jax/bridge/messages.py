"""Messages between two processes, each in a frame that says what it is, how long, and its checksum.

A frame is b"SPT1", the message's number, its length in bytes and its CRC-32, then the pickled
message. What is no such frame ends the connection: nothing is made of it.
"""

import pickle
import select
import socket
import struct
import time
import zlib
from typing import Any

_HEADER = struct.Struct("<4sQQI")
_MAGIC = b"SPT1"

# Bytes of a message: a mesh of 40 million vertices in float64.
_LONGEST = 1 << 30
_STEP = 1 << 20


class BrokenError(Exception):
    """The connection has ended, or what came through it is no message."""


class Frames:
    """One end of a connection, for one thread at a time.

    Args:
        connection: a stream socket, which is the object's own from then on.
    """

    def __init__(self, connection: socket.socket):
        connection.setblocking(False)
        self._socket = connection
        self._read, self._write, self._both = (select.poll() for _ in range(3))
        self._read.register(connection, select.POLLIN)
        self._write.register(connection, select.POLLOUT)
        self._both.register(connection, select.POLLIN | select.POLLOUT)
        self._buffer, self._left = bytearray(), bytearray()

    def send(self, number: int, message: Any, seconds: float) -> None:
        """Send one message.

        What could not be sent in time is sent by the next calls of either method.

        Raises:
            TimeoutError: the other end did not take it all within so many seconds.
            BrokenError: the other end is gone.
        """
        body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        self._left += _HEADER.pack(_MAGIC, number, len(body), zlib.crc32(body))
        self._left += body
        deadline = time.monotonic() + seconds
        while self._left:
            self._push()
            if self._left and not self._write.poll(_milliseconds(deadline)):
                raise TimeoutError

    def receive(self, seconds: float) -> tuple[int, Any]:
        """The number of the next message, and the message.

        What has come of it stays here, should it not be whole in time.

        Raises:
            TimeoutError: it is not here within so many seconds.
            BrokenError: the other end is gone, or what it sent is no message.
        """
        deadline = time.monotonic() + seconds
        while True:
            self._push()
            found = self._whole()
            if found is not None:
                return found
            waiting = self._both if self._left else self._read
            if not waiting.poll(_milliseconds(deadline)):
                raise TimeoutError
            try:
                came = self._socket.recv(_STEP)
            except BlockingIOError:
                continue
            except (OSError, ValueError) as error:
                raise BrokenError from error
            if not came:
                raise BrokenError
            self._buffer += came

    def _push(self) -> None:
        try:
            while self._left:
                del self._left[: self._socket.send(self._left[:_STEP])]
        except BlockingIOError:
            pass
        except (OSError, ValueError) as error:
            raise BrokenError from error

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def _whole(self) -> tuple[int, Any] | None:
        if len(self._buffer) < _HEADER.size:
            return None
        magic, number, length, checksum = _HEADER.unpack_from(self._buffer)
        if magic != _MAGIC or length > _LONGEST:
            raise BrokenError
        end = _HEADER.size + length
        if len(self._buffer) < end:
            return None
        body = bytes(self._buffer[_HEADER.size : end])
        del self._buffer[:end]
        if zlib.crc32(body) != checksum:
            raise BrokenError
        try:
            return number, pickle.loads(body)
        except Exception as error:
            raise BrokenError from error


def _milliseconds(deadline: float) -> int:
    return max(0, int(1e3 * (deadline - time.monotonic()) + 0.999))
