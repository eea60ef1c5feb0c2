"""Joins a bus of python-can to a socket, so that a node works on a socket whatever the bus is."""

import contextlib
import os
import socket
import threading
import time

import can

from gfm_hil.links.can.sockets import FULL
from gfm_hil.links.can.wire import MTU_FD, pack, unpack

_YIELDS_NS = 10_000_000  # the thread yields for this long after a frame, then it sleeps
_SLEEP_S = 1e-3


class Bridge:
    """A thread that moves frames both ways.

    Attributes:
        socket: the node's end; it carries ``struct canfd_frame``, one a message.
        problem: why the bus was lost; the socket then has no other end.
        dropped: frames for which the bus had no room.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus, self.problem, self.dropped = bus, "", 0
        self.socket, self._end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._end.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="can-bridge", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """File descriptor of the node's end."""
        return self.socket.fileno()

    def _run(self) -> None:
        try:
            self._move()
        except (can.CanError, OSError) as problem:
            self.problem = str(problem)
        finally:
            self._end.close()

    def _move(self) -> None:
        """Move frames until the node's end is closed and all its frames are sent."""
        moved = time.monotonic_ns()
        while True:
            idle = time.monotonic_ns() - moved > _YIELDS_NS
            came = self._bus.recv(_SLEEP_S if idle else 0.0)
            if came is not None:
                with contextlib.suppress(BlockingIOError):  # an overrun, as of a CAN controller
                    self._end.send(pack(came))
            sent = self._send()
            if sent is None:
                return
            if came is not None or sent:
                moved = time.monotonic_ns()
            elif not idle:
                os.sched_yield()

    def _send(self) -> bool | None:
        """Send a frame of the node, if there is one; None if its end is closed."""
        try:
            datagram = self._end.recv(MTU_FD)
        except BlockingIOError:
            return False
        if not datagram:
            return None
        try:
            self._bus.send(unpack(datagram))
        except can.CanOperationError as problem:
            if problem.error_code not in (*FULL, None):  # no number: a full buffer, too
                raise
            self.dropped += 1
        return True

    def shutdown(self) -> None:
        """Leave the bus once the frames of the node are sent."""
        self.socket.close()
        self._thread.join()
        self._bus.shutdown()
