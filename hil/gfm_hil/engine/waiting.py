"""Waits for messages during the handshake, and says goodbye at the end of a run."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import PeerLost
from gfm_hil.links import Link
from gfm_hil.links.frame import LAST_TIMES, FrameError, FrameReader, FrameWriter
from gfm_runtime.signals import names
from gfm_runtime.states import SAFE, STOPPED

_SPIN_NS = 50_000  # longer would starve the threads that bring the answer

_LAST_NS = 500_000_000  # how long to go on sending, or waiting for, last frames


def await_message(link: Link, deadline_ns: int, stopped: Callable[[], bool]) -> bytes | None:
    """The next message, or None at the deadline (CLOCK_MONOTONIC, ns) or once ``stopped()``.

    It yields after every poll, because a pure spin would starve libzmq's own thread on two cores,
    and sleeps between two polls after 50 us.
    """
    spin_until = time.monotonic_ns() + _SPIN_NS
    while True:
        message = link.receive()
        if message is not None:
            return message
        now = time.monotonic_ns()
        if now >= deadline_ns or stopped():
            return None
        if now < spin_until:
            os.sched_yield()
        else:
            link.wait(min(0.02, (deadline_ns - now) * 1e-9))


def send_last(
    link: Link, writer: FrameWriter, tick: int, state: int, reason: int, values: NDArray[np.float64]
) -> None:
    """Send the frame that ends a run several times, because one alone might be lost.

    If the link is full because the other side is behind, retry for a while.
    """
    give_up = time.monotonic_ns() + _LAST_NS
    for _ in range(LAST_TIMES):
        message = writer.pack(tick, state, reason, values)
        while not link.send(message) and time.monotonic_ns() < give_up:
            time.sleep(0.001)


def part_from(
    link: Link,
    writer: FrameWriter,
    reader: FrameReader,
    tick: int,
    state: int,
    reason: int,
    values: NDArray[np.float64],
) -> None:
    """Send the frames that end a run and wait a moment for the other side's.

    A side that closed at once could lose its last frames: libzmq drops what a peer that is 64
    frames behind has not read yet.
    """
    send_last(link, writer, tick, state, reason, values)
    give_up = time.monotonic_ns() + _LAST_NS
    unused = np.empty(len(names(reader.group)))
    with contextlib.suppress(PeerLost):
        while reader.state not in (SAFE, STOPPED) and time.monotonic_ns() < give_up:
            message = link.receive()
            if message is None:
                link.wait(0.01)
                continue
            with contextlib.suppress(FrameError):
                reader.unpack(message, unused)
