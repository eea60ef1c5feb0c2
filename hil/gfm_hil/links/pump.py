"""Connects a link that has only Python methods to the compiled loops: a thread pumps messages.

The compiled loop writes to and reads from two rings in this process's memory. The thread owns the
link: it takes what the loop sends from one ring and puts what arrives into the other.
"""

import os
import threading
import time

import numpy as np

from gfm_hil.links import ring
from gfm_hil.links.base import LONGEST, Link, wait_until
from gfm_hil.links.port import Port, free_port_function

_LOST = ring.HANDLE  # an additional word after a ring's handle: not 0 once the link is lost
_HEADS = 128  # bytes from one head to the next: processors fetch cache lines in pairs
_YIELDS_NS = 10_000_000  # the thread yields for this long after a message, then it sleeps
_SLEEP_S = 1e-3
_FAREWELL_S = 0.5  # most time to send the loop's last messages


class PumpedLink:
    """Wraps a link without a port and gives it one; implements ``gfm_hil.links.Link``.

    The thread owns the link from ``start`` to ``stop``; before (in the handshake) and after, the
    link may be called directly.
    """

    def __init__(self, link: Link) -> None:
        self._link, self.every = link, getattr(link, "every", 1)
        self._memory = np.zeros((2 * ring.RING + 2 * _HEADS) // ring.WORD, np.int64)
        base = self._memory.ctypes.data
        rings, heads = [base, base + ring.RING], [base + 2 * ring.RING + _HEADS * k for k in (0, 1)]
        self._loop, self._pump = np.zeros((2, _LOST + 1), np.int64)
        for handle, out in ((self._loop, 0), (self._pump, 1)):
            handle[ring.OUT], handle[ring.OUT_HEAD] = rings[out], heads[out]
            handle[ring.IN], handle[ring.IN_HEAD] = rings[1 - out], heads[1 - out]
        self.port = Port(self._loop, ring.port_send, _receive, 0)  # the thread needs the processor
        self._message = np.empty(LONGEST, np.uint8)
        self._problem: Exception | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pump", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread once it has sent the loop's last messages."""
        self._stopping.set()
        self._thread.join()

    def send(self, message: bytes) -> bool:
        return bool(ring.put(self._loop, np.frombuffer(bytearray(message), np.uint8)))

    def receive(self) -> bytes | None:
        """The next message, or None. Raises PeerLost, UserError: the link raised it in the
        thread."""
        size = ring.take(self._loop, self._message)
        if size == 0 and self._problem is not None:
            raise self._problem
        return self._message[:size].tobytes() if size else None

    def wait(self, seconds: float) -> bool:
        def over() -> bool:
            return ring.waiting(self._loop) or self._problem is not None

        wait_until(over, time.monotonic() + seconds, _SLEEP_S, _SLEEP_S)
        return bool(ring.waiting(self._loop))

    def close(self) -> None:
        self._link.close()

    def _run(self) -> None:
        try:
            self._move()
        except Exception as problem:  # ``receive`` raises it in the caller's thread
            self._problem = problem
            self._loop[_LOST] = 1

    def _move(self) -> None:
        link, handle, message = self._link, self._pump, np.empty(LONGEST, np.uint8)
        moved, give_up = time.monotonic_ns(), float("inf")
        while time.monotonic() < give_up:
            stopping = self._stopping.is_set()  # before looking: what the loop sent last is there
            size = ring.take(handle, message)
            if size:
                link.send(message[:size].tobytes())
            came = link.receive()
            if came is not None and len(came) <= LONGEST:  # as over shm: drop a longer message
                ring.put(handle, np.frombuffer(bytearray(came), np.uint8))
            now = time.monotonic_ns()
            if size or came is not None:
                moved = now
            elif stopping:
                return
            elif now - moved < _YIELDS_NS:
                os.sched_yield()
            else:
                link.wait(_SLEEP_S)
            if stopping:
                give_up = min(give_up, time.monotonic() + _FAREWELL_S)


def warm_up() -> None:
    """Compile (or load from the cache) what the loop and the thread call."""
    ring.warm_up()
    Port(np.zeros(_LOST + 1, np.int64), ring.port_send, _receive, 0)


def with_port(link: Link) -> Link:
    """The link itself, or a ``PumpedLink`` around it if it has no port."""
    return link if link.port is not None else PumpedLink(link)


@free_port_function
def _receive(handle, message):
    size = ring.take(handle, message)
    return -1 if size == 0 and handle[_LOST] != 0 else size
