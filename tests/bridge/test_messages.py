"""Framed messages: whole, in order, or the connection ends; never something that was not sent."""

import os
import pickle
import socket
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from spt_jax.bridge import worker as module
from spt_jax.bridge.messages import _HEADER, BrokenError, Frames

pytestmark = pytest.mark.skipif(os.name != "posix", reason="no workers on this system")


@pytest.fixture
def ends():
    one, other = socket.socketpair()
    with one, other:
        yield one, other


def test_messages_come_whole_and_in_order(ends):
    one, other = (Frames(end) for end in ends)
    for number in range(3):
        one.send(number, ("measure", np.arange(number)), 1.0)
    for number in range(3):
        found, (word, array) = other.receive(1.0)
        assert (found, word, array.tolist()) == (number, "measure", list(range(number)))
    with pytest.raises(TimeoutError):
        other.receive(0.0)


def test_half_a_message_waits_for_the_rest(ends):
    body = pickle.dumps("hello")
    frame = _HEADER.pack(b"SPT1", 7, len(body), zlib.crc32(body)) + body
    reader = Frames(ends[1])
    for part in (frame[:3], frame[3:20], frame[20:-1]):
        ends[0].sendall(part)
        with pytest.raises(TimeoutError):
            reader.receive(0.0)
    ends[0].sendall(frame[-1:] + frame)
    assert reader.receive(1.0) == reader.receive(1.0) == (7, "hello")


def frame(magic=b"SPT1", length=None, checksum=None, body=None):
    body = pickle.dumps(("hello", 1)) if body is None else body
    length = len(body) if length is None else length
    checksum = zlib.crc32(body) if checksum is None else checksum
    return struct.pack("<4sQQI", magic, 1, length, checksum) + body


@pytest.mark.parametrize(
    "sent",
    [
        frame(magic=b"HTTP"),
        frame(length=1 << 40),
        frame(checksum=5),
        frame(body=b"no pickle"),
        b"Traceback (most recent call last):",
    ],
)
def test_what_is_no_message_ends_the_connection(ends, sent):
    ends[0].sendall(sent)
    with pytest.raises(BrokenError):
        Frames(ends[1]).receive(1.0)


def test_an_end_that_is_gone_or_takes_nothing_is_told(ends):
    writer, reader = Frames(ends[0]), Frames(ends[1])
    with pytest.raises(TimeoutError):
        writer.send(3, bytes(5 << 20), 0.0)
    # The rest goes with the next calls.
    with ThreadPoolExecutor(1) as other:
        both = other.submit(lambda: [reader.receive(20.0), reader.receive(20.0)])
        writer.send(4, "more", 20.0)
        assert both.result() == [(3, bytes(5 << 20)), (4, "more")]
    ends[1].close()
    with pytest.raises(BrokenError):
        writer.send(0, "hello", 0.01)
    with pytest.raises(BrokenError):
        Frames(ends[0]).receive(0.01)


def test_a_worker_that_answers_what_nobody_asked_is_lost(ends):
    worker = object.__new__(module.Worker)
    worker._frames, worker._awaited = Frames(ends[0]), {1: 1e9}
    for answer in (frame(body=pickle.dumps((True, None))), frame(body=pickle.dumps("nonsense"))):
        ends[1].sendall(answer)
    assert worker._take(1.0) == (1, None)
    with pytest.raises(module.LostError):
        worker._take(1.0)
    ends[1].sendall(frame(body=pickle.dumps((True, None))))
    with pytest.raises(module.LostError):  # the same answer twice
        worker._take(1.0)
