"""A bus as slow as a real one, over a virtual one that takes no time.

Every node keeps the same account: it knows when it sent and sees what others send within
microseconds. While a frame is on the bus, others wait; of those that wait, the lowest identifier
goes next; each takes its longest time (``frame_time``), and is delivered no earlier than at its
end. It is the time of the wall clock, so that it matters in real time: a run in lockstep takes
longer and gives the same.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import can

from gfm_hil.links.can.frame_time import PAYLOADS, classic_time, fd_time

_LOOK_S = 20e-6  # while something is on the bus, how long to wait for more


@dataclass(frozen=True)
class _Waiting:
    """A frame that has not had the bus yet: since when (s), and what is to be delivered."""

    since: float
    number: int
    length: int
    message: can.Message | None


class EmulatedBus:
    """What the link needs of a ``can.BusABC``, as late as with these bit rates.

    Args:
        bus: a virtual one.
        fd, bitrate, data_bitrate: bit/s.
        clock: s.
    """

    def __init__(
        self,
        bus: Any,
        fd: bool,
        bitrate: int,
        data_bitrate: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bus, self._clock = bus, clock
        self._duration = {
            n: fd_time(n, bitrate, data_bitrate) if fd else classic_time(n, bitrate)
            for n in PAYLOADS
            if fd or n <= 8
        }
        self._waiting: list[_Waiting] = []
        self._free = 0.0  # when the frame on the bus ends
        self._sent: deque[tuple[float, can.Message]] = deque()  # to be delivered, and when

    def send(self, message: can.Message) -> None:
        """Send; it waits for the bus behind what was sent before."""
        self._bus.send(message)
        self._queue(message, deliver=False)

    def _queue(self, message: can.Message, deliver: bool) -> None:
        if message.is_error_frame:  # tells of the node itself, takes no part in arbitration
            self._sent.appendleft((0.0, message))
            return
        length = next(n for n in PAYLOADS if n >= len(message.data))
        kept = message if deliver else None
        self._waiting.append(_Waiting(self._clock(), message.arbitration_id, length, kept))

    def _arbitrate(self, now: float) -> None:
        """Give the bus to all that have had their turn by now."""
        while self._waiting:
            start = max(self._free, min(frame.since for frame in self._waiting))
            if start > now:
                return
            ready = [frame for frame in self._waiting if frame.since <= start]
            frame = min(ready, key=lambda f: (f.number, f.since))
            self._waiting.remove(frame)
            self._free = start + self._duration[frame.length]
            if frame.message is not None:
                self._sent.append((self._free, frame.message))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame whose end has come, or None after ``timeout`` s."""
        until = self._clock() + (timeout or 0.0)
        while True:
            while (message := self._bus.recv(0)) is not None:
                self._queue(message, deliver=True)
            now = self._clock()
            self._arbitrate(now)
            if self._sent and self._sent[0][0] <= now:
                return self._sent.popleft()[1]
            if now >= until:
                return None
            busy = self._sent or self._waiting
            message = self._bus.recv(min(until - now, _LOOK_S) if busy else until - now)
            if message is not None:
                self._queue(message, deliver=True)

    def shutdown(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
