"""Round trips over one link between two processes: ``ping`` sends, ``pong`` answers at once.

The compiled loops call a link through its port, as the loops of a run do; a link without a port is
called through its Python methods. ``contenders/pingpong.h`` is the same in C.

A loop fills ``took`` (capacity,) with the ns of its round trips and returns their number, or -1 if
the peer stopped answering. With ``period_ns`` 0 they follow each other. Else one begins every
period, at absolute deadlines, and its time counts from the deadline, so that a late start is
included. ``stop`` are three numbers in memory that both processes share: not 0 to stop, how to
wait for a deadline, and ``period_ns``.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.links.frame import FrameWriter
from gfm_hil.realtime.clock import now_ns, sleep_until, spin_or_yield, wait_until
from gfm_runtime.compiled import cached
from gfm_runtime.signals import VectorName, names

SILENCE_NS = 1_000_000_000
LONGEST = 65536  # bytes
HYBRID, SPIN, SLEEP = range(3)  # ways to wait
_DIFFERENT = 256  # messages in turn, so that a link that checks the sequence accepts all
_POLLS = 1024  # between two reads of the clock

Messages = NDArray[np.uint8]
Numbers = NDArray[np.int64]


def frames(group: VectorName) -> Messages:
    """The bench's frames with consecutive sequences; shape (256, bytes)."""
    writer, values = FrameWriter(group), np.ones(len(names(group)))
    packed = b"".join(writer.pack(k, 0, 0, values) for k in range(_DIFFERENT))
    return np.frombuffer(packed, np.uint8).reshape(_DIFFERENT, -1)


def plain(size: int) -> Messages:
    """Messages of any other size in bytes, shape (256, size)."""
    return np.resize(np.arange(251, dtype=np.uint8), (_DIFFERENT, size))


@dataclass(frozen=True)
class PingPong:
    """One end of a contender."""

    # sends requests: (stop, period_ns, duration_ns, took); see the module
    ping: Callable[[Numbers, int, int, Numbers], int]
    pong: Callable[[Numbers], object]  # answers until stopped: (stop)
    close: Callable[[], object]  # frees all resources
    compiled: bool  # whether its loops are compiled
    # of the last round: ``gfm_hil.bench.one_way.delays``, empty if its exchanges carry no clock
    sides: Callable[[], dict[str, Any]] = dict


@cached
def wait_for(due, spins, how):
    """Wait for a deadline: sleep until shortly before it and spin the rest, only spin, or sleep."""
    if how == HYBRID:
        wait_until(due, spins)
    elif how == SLEEP:
        sleep_until(due)
    while now_ns() < due:
        pass


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
            wait_for(due, spins, stop[1])
            begin = due
            due += period_ns
        for i in range(len(message)):
            message[i] = messages[n % len(messages), i]
        send(handle, message)
        polls = 0
        while receive(handle, answer) == 0:
            polls += 1
            spin_or_yield(polls, spins)
            if polls % _POLLS == 0 and now_ns() - begin > SILENCE_NS:
                return -1
        now = now_ns()
        took[n] = now - begin
        begin = now
        n += 1
    return n


@cached
def pong_port(handle, send, receive, spins, messages, stop):
    """``pong`` through a port's functions, until ``stop[0]``."""
    request = np.empty(LONGEST, np.uint8)
    message = np.empty(messages.shape[1], np.uint8)
    n = polls = 0
    while stop[0] == 0:
        if receive(handle, request) == 0:
            polls += 1
            spin_or_yield(polls, spins)
            continue
        for i in range(len(message)):
            message[i] = messages[n % len(messages), i]
        send(handle, message)
        n += 1
        polls = 0
    return n


def over_link(link: Any, own: Messages) -> PingPong:
    """The end of an open link: a ``gfm_hil.links.Link``, of which ``wait`` is not needed."""
    if (port := link.port) is not None:
        call = (port.handle, port.send, port.receive, port.spins, own)

        def paced(loop: Callable[..., int], stop: Numbers, *more: Any) -> int:
            port.paced(bool(stop[2]))
            return loop(*call, stop, *more)

        ping, pong = partial(paced, ping_port), partial(paced, pong_port)
        return PingPong(ping, pong, link.close, True)
    sent = [row.tobytes() for row in own]
    return PingPong(
        partial(_ping_python, link, sent), partial(_pong_python, link, sent), link.close, False
    )


def _ping_python(
    link: Any, sent: list[bytes], stop: Numbers, period_ns: int, duration_ns: int, took: Numbers
) -> int:
    while link.receive() is not None:
        pass
    begin = time.monotonic_ns()
    end, due, n = begin + duration_ns, begin + period_ns, 0
    while n < len(took) and begin < end:
        if period_ns:
            wait_for(due, 0, stop[1])
            begin, due = due, due + period_ns
        link.send(sent[n % _DIFFERENT])
        while link.receive() is None:
            os.sched_yield()
            if time.monotonic_ns() - begin > SILENCE_NS:
                return -1
        now = time.monotonic_ns()
        took[n], begin = now - begin, now
        n += 1
    return n


def _pong_python(link: Any, sent: list[bytes], stop: Numbers) -> None:
    n = 0
    while not stop[0]:
        if link.receive() is None:
            os.sched_yield()
            continue
        link.send(sent[n % _DIFFERENT])
        n += 1
