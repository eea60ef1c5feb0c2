"""A listening socket with a limit of peers: a new peer replaces the one that was silent longest.

asyncio's servers accept every connection, up to the last descriptor of the process. They call
``accept`` of the given socket, and this socket counts. Peers that have not yet sent a whole message
have a limit of their own, so that any number of them takes no place from those that have.
"""

import contextlib
import resource
import socket
import time
from dataclasses import dataclass
from typing import Any

_KEEPALIVE = (  # the kernel detects within a minute that the other machine is gone
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 30),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


@dataclass
class _Peer:
    """A connection; ``since`` is the time of its last whole message or, if it never ``spoke``, of
    its accept, s. A connection that is ``exempt`` may be silent for ever and is not counted."""

    connection: socket.socket
    since: float
    spoke: bool = False
    exempt: bool = False


class Listener(socket.socket):
    """A listening TCP socket, bound. Raises OSError: the address cannot be bound.

    Args:
        host, port: to listen at; the first address that the name stands for.
        limit: most connections that have not spoken yet, and as many that have; never more than a
            quarter of the descriptors that the process may have.
        half_open_s: how long a peer may take to send its first whole message.
        idle_s: how long a peer may be silent after a message.

    Attributes:
        port: on which it listens.
    """

    def __init__(self, host: str, port: int, limit: int, half_open_s: float, idle_s: float) -> None:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        super().__init__(family, kind, protocol)
        self._limit = min(limit, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 4)
        self._silence_s = {False: half_open_s, True: idle_s}  # by ``spoke``
        self._peers: dict[int, _Peer] = {}  # by descriptor, longest silent first
        try:
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind(address)
        except OSError:
            self.close()
            raise
        self.port = int(self.getsockname()[1])

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection; if too many have not spoken yet, close the oldest of them. Raises
        OSError: there is none (BlockingIOError), or no descriptor for it."""
        connection, address = super().accept()
        for option in _KEEPALIVE:
            connection.setsockopt(*option)
        self._peers = {n: p for n, p in self._peers.items() if p.connection.fileno() == n}
        self._peers[connection.fileno()] = _Peer(connection, time.monotonic())
        self._make_room(spoke=False)
        return connection, address

    def heard(self, number: int) -> None:
        """Note that the peer of this descriptor sent a whole message; if too many peers have
        spoken, close the one that was silent longest."""
        peer = self._peers.pop(number, None)
        if peer is not None:
            peer.since, first, peer.spoke = time.monotonic(), not peer.spoke, True
            self._peers[number] = peer
            if first:
                self._make_room(spoke=True)

    def exempt(self, number: int, exempt: bool = True) -> None:
        """Exempt the connection of this descriptor from all limits, or no longer do so."""
        if number in self._peers:
            self._peers[number].exempt = exempt

    def reap(self) -> None:
        """Close the connections that have been silent too long; call this periodically."""
        now = time.monotonic()
        for number, peer in list(self._peers.items()):
            if not peer.exempt and now - peer.since > self._silence_s[peer.spoke]:
                self._end(number)

    def _make_room(self, spoke: bool) -> None:
        same = [n for n, p in self._peers.items() if p.spoke == spoke and not p.exempt]
        for number in same[: max(len(same) - self._limit, 0)]:
            self._end(number)

    def _end(self, number: int) -> None:
        """Shut down both directions, so that its server sees EOF and closes the descriptor."""
        with contextlib.suppress(OSError):  # the peer or its server has closed it
            self._peers.pop(number).connection.shutdown(socket.SHUT_RDWR)
