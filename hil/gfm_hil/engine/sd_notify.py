"""Tells systemd how a process fares, by sd_notify(3), if ``NOTIFY_SOCKET`` is set.

READY after the handshake, WATCHDOG only while ticks go on, STATUS for ``systemctl status``,
STOPPING when the loop has ended and the data are still to be written.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading

import numpy as np
from numpy.typing import NDArray

from gfm_hil.realtime.priority import restore_priority
from gfm_hil.scenario import Scenario

_PATIENCE_S = 1.0  # the service manager does not read; the next message says it again
_STATUS_S = 1.0


def notify(*lines: str) -> None:
    """Send lines ``KEY=value`` in one datagram; a path that begins with @ is an abstract one."""
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = "\0" + path[1:] if path.startswith("@") else path
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock, contextlib.suppress(OSError):
        sock.settimeout(_PATIENCE_S)
        sock.sendto("\n".join(lines).encode(), address)


def watchdog_s() -> float | None:
    """Seconds without WATCHDOG=1 after which systemd ends this process; None if it does not."""
    ours = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    given = os.environ.get("WATCHDOG_USEC", "")
    return int(given) / 1e6 if ours and given.isdecimal() and int(given) else None


class Watched:
    """Context around a loop after the handshake: a thread of ordinary priority feeds the watchdog.

    The thread watches whether the count of ticks grows. A side that waits for a silent peer does
    no ticks and ends by itself after ``link.peer_timeout_s``; the thread feeds a shorter watchdog
    until then.

    Args:
        scenario: of the run.
        progress: of the recording, (ticks done, misses), written by the loop.
    """

    def __init__(self, scenario: Scenario, progress: NDArray[np.int64]) -> None:
        self._ticks, self._progress = scenario.ticks, progress
        self._least_s = 2 * scenario.peer_timeout_s
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Watched:
        if os.environ.get("NOTIFY_SOCKET"):
            self._limit_s = watchdog_s()
            ready = ["READY=1", "STATUS=met the other side"]
            if self._limit_s is not None and self._limit_s < self._least_s:
                self._limit_s = self._least_s
                ready.append(f"WATCHDOG_USEC={round(self._limit_s * 1e6)}")
            notify(*ready)
            self._thread = threading.Thread(target=self._look, name="watchdog", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is not None:
            self._over.set()
            self._thread.join()
            notify("STOPPING=1", f"STATUS=ended after {self._done} ticks; writing its data")

    @property
    def _done(self) -> int:
        return int(self._progress[0])

    def _look(self) -> None:
        restore_priority()  # the thread inherited the loop's priority and processor
        seen = 0
        every = min(_STATUS_S, (self._limit_s or 4 * _STATUS_S) / 4)
        while not self._over.wait(every):
            done = self._done
            if done > seen:
                seen = done
                misses = f", {self._progress[1]} misses" if self._progress[1] else ""
                notify("WATCHDOG=1", f"STATUS=tick {done} of {self._ticks}{misses}")
