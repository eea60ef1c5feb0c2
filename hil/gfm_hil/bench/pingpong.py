"""Round trips over one link between two processes: ``ping`` sends, ``pong`` answers at once.

The compiled loops call a link through its port, as the loops of a run do; a link without a port is
called through its Python methods. ``pingpong.c`` is the same in C.

A loop fills ``took`` (capacity,) with the ns of its round trips and returns their number, or -1 if
the peer stopped answering. With ``period_ns`` 0 they follow each other. Else one begins every
period, at absolute deadlines, and its time counts from the deadline, so that a late start is
included. ``stop`` is one number in memory that both processes share.
"""

from __future__ import annotations

import os
import time
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gfm_hil.links import Port
from gfm_hil.links.frame import FrameWriter
from gfm_hil.realtime.clock import now_ns, spin_or_yield, wait_until
from gfm_runtime.compiled import cached
from gfm_runtime.signals import Vector, names

SILENCE_NS = 1_000_000_000
LONGEST = 512  # bytes
_DIFFERENT = 256  # messages in turn, so that a link that checks the sequence accepts all
_LOOKS = 1024  # polls between two reads of the clock

Messages = NDArray[np.uint8]


def frames(group: Vector) -> Messages:
    """The bench's frames with consecutive sequences; shape (256, bytes)."""
    writer, values = FrameWriter(group), np.ones(len(names(group)))
    packed = b"".join(writer.pack(k, 0, 0, values) for k in range(_DIFFERENT))
    return np.frombuffer(packed, np.uint8).reshape(_DIFFERENT, -1)


def plain(size: int) -> Messages:
    """Messages of any other size in bytes, shape (256, size)."""
    return np.resize(np.arange(251, dtype=np.uint8), (_DIFFERENT, size))


@cached
def ping_port(handle, send, receive, spins, messages, stop, period_ns, duration_ns, took):
    """``ping`` through a port's functions."""
    answer = np.empty(LONGEST, np.uint8)
    message = np.empty(messages.shape[1], np.uint8)
    while receive(handle, answer) > 0:  # late answers of an aborted round
        pass
    begin = now_ns()
    end, due, n = begin + duration_ns, begin + period_ns, 0
    while n < len(took) and begin < end:
        if period_ns > 0:
            wait_until(due, spins)
            begin = due
            due += period_ns
        for i in range(len(message)):
            message[i] = messages[n % len(messages), i]
        send(handle, message)
        looks = 0
        while receive(handle, answer) == 0:
            looks += 1
            spin_or_yield(looks, spins)
            if looks % _LOOKS == 0 and now_ns() - begin > SILENCE_NS:
                return -1
        now = now_ns()
        took[n] = now - begin
        begin = now
        n += 1
    return n


@cached
def pong_port(handle, send, receive, spins, messages, stop):
    """``pong`` through a port's functions, until ``stop[0]``."""
    heard = np.empty(LONGEST, np.uint8)
    message = np.empty(messages.shape[1], np.uint8)
    n = looks = 0
    while stop[0] == 0:
        if receive(handle, heard) == 0:
            looks += 1
            spin_or_yield(looks, spins)
            continue
        for i in range(len(message)):
            message[i] = messages[n % len(messages), i]
        send(handle, message)
        n += 1
        looks = 0
    return n


class Carrier(Protocol):
    """The part of ``gfm_hil.links.Link`` that a ping-pong uses."""

    @property
    def port(self) -> Port | None:
        """The port for compiled loops, or None."""

    def send(self, message: bytes) -> bool:
        """Send a message."""

    def receive(self) -> bytes | None:
        """The next message, or None."""

    def close(self) -> None:
        """Free all resources."""


class LinkEnd:
    """One end of an open link; uses its port if it has one."""

    def __init__(self, link: Carrier, messages: Messages) -> None:
        self._link, self._messages = link, messages
        self._bytes = [row.tobytes() for row in messages]

    @property
    def compiled(self) -> bool:
        """Whether it has a port."""
        return self._link.port is not None

    def ping(
        self,
        stop: NDArray[np.int64],
        period_ns: int,
        duration_ns: int,
        took: NDArray[np.int64],
    ) -> int:
        """Send requests; see the module."""
        if (p := self._link.port) is not None:
            return int(ping_port(*_call(p), self._messages, stop, period_ns, duration_ns, took))
        while self._link.receive() is not None:
            pass
        begin = time.monotonic_ns()
        end, due, n = begin + duration_ns, begin + period_ns, 0
        while n < len(took) and begin < end:
            if period_ns:
                wait_until(due, 0)
                begin, due = due, due + period_ns
            self._link.send(self._bytes[n % _DIFFERENT])
            while self._link.receive() is None:
                os.sched_yield()
                if time.monotonic_ns() - begin > SILENCE_NS:
                    return -1
            now = time.monotonic_ns()
            took[n] = now - begin
            begin = now
            n += 1
        return n

    def pong(self, stop: NDArray[np.int64]) -> None:
        """Answer until stopped."""
        if (p := self._link.port) is not None:
            pong_port(*_call(p), self._messages, stop)
            return
        n = 0
        while not stop[0]:
            if self._link.receive() is None:
                os.sched_yield()
                continue
            self._link.send(self._bytes[n % _DIFFERENT])
            n += 1

    def close(self) -> None:
        """Close the link."""
        self._link.close()


def _call(port: Port) -> tuple[Any, Any, Any, int]:
    return port.handle, port.send, port.receive, port.spins
