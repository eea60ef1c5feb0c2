"""A CAN bus between processes of one machine whose kernel has no CAN: UDP on 127.0.0.1.

A python-can backend (``interface="gfmhil-udp"``, ``channel="127.0.0.1:port"``). The bus has four
places, UDP ports ``port`` to ``port + 3``. A node takes one place and sends each frame to the
other nodes, as one datagram that holds Linux' ``struct canfd_frame``. Like ``vcan`` the bus takes
no time and loses frames only when a receiver's buffer overflows; it never leaves the machine.
"""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import time
from typing import Any

import can

from gfm_hil.links.can.wire import pack, unpack

NODES = 4
_HOST = "127.0.0.1"
_BUFFER = 1 << 20  # bytes; the kernel may grant fewer
_RECHECK_S = 0.05  # how long to skip a place that was empty


class LoopbackBus(can.BusABC):
    """One node of the bus.

    Args:
        channel: ``"127.0.0.1:port"``.
        place: index of the place to take; None takes the last free one.

    Raises:
        can.CanInitializationError: the place is occupied, or all are.
    """

    def __init__(self, channel: Any, place: int | None = None, **more: Any) -> None:
        self._is_shutdown = True  # until there is something to shut down
        first = int(str(channel).removeprefix(f"{_HOST}:"))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        taken = self._take(first, reversed(range(NODES)) if place is None else [place])
        self._peers = [_Peer(first + k) for k in range(NODES) if k != taken]
        self.channel_info = f"loopback bus at {_HOST}:{first}, place {taken}"
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel=channel, **more)
        self._is_shutdown = False

    def _take(self, first: int, places: Any) -> int:
        for place in places:
            with contextlib.suppress(OSError):
                self._socket.bind((_HOST, first + place))
                return int(place)
        self._socket.close()
        raise can.CanInitializationError(f"occupied: {_HOST}:{first}")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to every other node on the bus."""
        datagram = pack(msg)
        for peer in self._peers:
            peer.send(datagram)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while True:
            try:
                datagram = self._socket.recv(128)
                break
            except BlockingIOError:
                if timeout == 0 or not select.select([self._socket], [], [], timeout)[0]:
                    return None, False
        return unpack(datagram), False

    def fileno(self) -> int:
        """File descriptor for select."""
        return self._socket.fileno()

    def others(self) -> list[int]:
        """File descriptors of the sockets that are connected to the other places."""
        return [peer.fileno() for peer in self._peers]

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._is_shutdown:
            super().shutdown()
            for peer in self._peers:
                peer.close()
            self._socket.close()


class _Peer:
    """Another place of the bus; after an empty one, sends are skipped for ``_RECHECK_S``."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect((_HOST, port))
        self._empty_until = 0.0

    def send(self, datagram: bytes) -> None:
        if self._empty_until and time.monotonic() < self._empty_until:
            return
        try:
            self._socket.send(datagram)
            self._empty_until = 0.0
        except ConnectionRefusedError:  # reports the previous datagram, not this one
            self._empty_until = time.monotonic() + _RECHECK_S
        except OSError as problem:  # a full buffer is like a CAN controller's overrun: drop
            if problem.errno not in (errno.EAGAIN, errno.ENOBUFS):
                raise can.CanOperationError(str(problem), problem.errno) from problem

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()
