"""UDP as a link of ``gfmhil bench latency --to`` alone: it shows what the network loses.

It neither encrypts nor knows its peer, so no run uses it.
"""

import os
import select
import socket
import struct
from contextlib import suppress

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST, LinkKind, LinkOptions
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.links.system import DONTWAIT, recv, send

_SPINS = 1000
_PATIENCE = struct.pack("ll", 0, 1000)  # struct timeval: s, µs


@free_port_function
def _port_send(handle, message):
    return 1 if send(handle[0], message.ctypes.data, len(message), DONTWAIT) > 0 else 0


@free_port_function
def _port_receive(handle, message):
    return max(0, recv(handle[0], message.ctypes.data, len(message), handle[1]))


class UdpLink:
    """One end of UDP; implements ``gfm_hil.links.Link``. The controller answers the one from whom
    it last took a message by ``receive``."""

    def __init__(self, role: Role, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("udp://").rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _PATIENCE)
        self._serves = role == "controller"
        self.close = self._socket.close
        try:
            (self._socket.bind if self._serves else self._socket.connect)((host, int(port)))
        except OSError as problem:
            self.close()
            raise UserError(f"{endpoint}: cannot be used: {problem.strerror}") from None
        # on one processor a side that polls keeps all others waiting, the kernel's too
        how = DONTWAIT if (os.cpu_count() or 1) > 1 else 0
        handle = np.array([self._socket.fileno(), how])
        self.port = Port(handle, _port_send, _port_receive, _SPINS)

    def send(self, message: bytes) -> bool:
        with suppress(OSError):  # the other side has not opened its port yet
            return self._socket.send(message, DONTWAIT) > 0
        return False

    def receive(self) -> bytes | None:
        try:
            message, sender = self._socket.recvfrom(LONGEST + 1, DONTWAIT)
        except OSError:
            return None
        if self._serves:
            self._socket.connect(sender)
        return message

    def wait(self, seconds: float) -> bool:
        return bool(select.select([self._socket], [], [], seconds)[0])


KIND = LinkKind(
    name="udp",
    text="UDP, for the bench alone",
    pattern=r"udp://[^/\s]+:\d{1,5}",
    form="udp://host:port",
    fresh=lambda folder: "udp://127.0.0.1:0",
    open=lambda role, endpoint, options: UdpLink(role, endpoint),
    options=LinkOptions,
)
