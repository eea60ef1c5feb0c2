"""A CAN bus between processes of one machine whose kernel has no CAN: UDP on 127.0.0.1.

A python-can backend (``interface="gfmhil-udp"``, ``channel="127.0.0.1:port"``). The bus has four
places, UDP ports ``port`` to ``port + 3``. A node takes one place and sends each frame to the
other nodes, as one datagram that holds Linux' ``struct canfd_frame``. Like ``vcan`` the bus takes
no time and loses frames only when a receiver's buffer overflows; it never leaves the machine.
"""

import contextlib
import os
import select
import socket
from collections.abc import Iterable
from typing import Any

import can
import numpy as np

from gfm_hil.links.can import LOOPBACK_PLACES
from gfm_hil.links.can.sockets import FULL, LOOPBACK, set_socket, socket_dtype, write_frame
from gfm_hil.links.can.wire import frame_dtype, pack, unpack

_HOST = "127.0.0.1"
_BUFFER = 1 << 20  # bytes; the kernel may grant fewer


class LoopbackBus(can.BusABC):
    """One node of the bus.

    Args:
        channel: ``"127.0.0.1:port"``.
        place: index of the place to take; None takes the last free one.

    Raises:
        can.CanInitializationError: the place is occupied, or all are.
    """

    def __init__(self, channel: Any, place: int | None = None, **more: Any) -> None:
        self._is_shutdown = True  # else python-can's __del__ shuts down a bus that failed to open
        first = int(str(channel).removeprefix(f"{_HOST}:"))
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        own = self._bind(first, reversed(range(LOOPBACK_PLACES)) if place is None else [place])
        self._others = [_connect(first + k) for k in range(LOOPBACK_PLACES) if k != own]
        self.record = np.zeros(1, socket_dtype)
        set_socket(self.record, LOOPBACK, self.fileno(), [other.fileno() for other in self._others])
        self._frame = np.zeros(1, frame_dtype)
        self.channel_info = f"loopback bus at {_HOST}:{first}, place {own}"
        self._can_protocol = can.CanProtocol.CAN_FD
        super().__init__(channel=channel, **more)
        self._is_shutdown = False

    def _bind(self, first: int, places: Iterable[int]) -> int:
        """Bind the socket to the first free one of these places, and return its index."""
        for place in places:
            with contextlib.suppress(OSError):
                self._socket.bind((_HOST, first + place))
                return place
        self._socket.close()
        raise can.CanInitializationError(f"occupied: {_HOST}:{first}")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to every other node on the bus; a full buffer drops it, like an overrun of
        a CAN controller."""
        datagram = np.frombuffer(pack(msg), np.uint8)
        self._frame.view(np.uint8)[: len(datagram)] = datagram
        problem = write_frame(self.record, self._frame)
        if problem and problem not in FULL:
            raise can.CanOperationError(os.strerror(problem), problem)

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

    def shutdown(self) -> None:
        """Leave the bus."""
        if not self._is_shutdown:
            super().shutdown()
            for end in (*self._others, self._socket):
                end.close()


def _connect(port: int) -> socket.socket:
    """A socket that sends to another place of the bus."""
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.setblocking(False)
    end.connect((_HOST, port))
    return end
