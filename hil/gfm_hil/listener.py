"""A listening socket with room for so many peers: a new one takes the place of the most silent.

The servers of asyncio take every connection that comes, to the last descriptor of the process. They
call ``accept`` of the socket that they are given, and here that socket counts: connections that
nobody vouches for are at most ``limit``, and those that stay silent are ended.
"""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from typing import Any

_KEEPALIVE = (  # the kernel finds out within a minute that the other machine is gone
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 30),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 10),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


@dataclass
class _Peer:
    """A connection; ``heard`` is when it last sent something whole, s, and ``limit_s`` how long it
    may be silent after that. The server keeps a connection that is ``kept`` however silent it is.
    """

    connection: socket.socket
    heard: float
    limit_s: float
    kept: bool = False


class Listener(socket.socket):
    """A listening TCP socket, bound.

    Args:
        host, port: to listen at; the first address that the name stands for.
        limit: connections at a time, beside those that are kept.
        half_open_s: how long a peer may take to send its first whole message.
        idle_s: how long a peer may be silent after a message.

    Raises:
        OSError: the address is not to be had.
    """

    def __init__(self, host: str, port: int, limit: int, half_open_s: float, idle_s: float) -> None:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        super().__init__(family, kind, protocol)
        self._limit, self._half_open_s, self._idle_s = limit, half_open_s, idle_s
        self._peers: dict[int, _Peer] = {}  # by descriptor, the most silent first
        try:
            self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind(address)
        except OSError:
            self.close()
            raise

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.getsockname()[1])

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; ends the most silent one if there are too many.

        Raises:
            OSError: there is none (BlockingIOError), or no descriptor for it.
        """
        connection, address = super().accept()
        for option in _KEEPALIVE:
            connection.setsockopt(*option)
        self._peers = {n: p for n, p in self._peers.items() if p.connection.fileno() == n}
        self._peers[connection.fileno()] = _Peer(connection, time.monotonic(), self._half_open_s)
        ordinary = [n for n, peer in self._peers.items() if not peer.kept]
        for number in ordinary[: max(len(ordinary) - self._limit, 0)]:
            self._end(number)
        return connection, address

    def heard(self, number: int) -> None:
        """The peer of this descriptor has sent something whole."""
        peer = self._peers.pop(number, None)
        if peer is not None:
            peer.heard, peer.limit_s = time.monotonic(), self._idle_s
            self._peers[number] = peer

    def keep(self, number: int, kept: bool = True) -> None:
        """Keep the connection of this descriptor however silent it is, or no longer do so."""
        if number in self._peers:
            self._peers[number].kept = kept

    def reap(self) -> None:
        """End the connections that have been silent for too long; to be called now and then."""
        now = time.monotonic()
        for number, peer in list(self._peers.items()):
            if not peer.kept and now - peer.heard > peer.limit_s:
                self._end(number)

    def _end(self, number: int) -> None:
        """Both ways at once, so that its server sees the end of it and closes the descriptor."""
        connection = self._peers.pop(number).connection
        try:
            connection.shutdown(socket.SHUT_RDWR)
        except OSError:  # the peer or its server was first
            return
