"""ZeroMQ link: a PAIR socket at each end, the controller binds, the plant connects."""

from __future__ import annotations

import contextlib
import socket
import warnings

import zmq

from gfm_hil.errors import UserError
from gfm_hil.links.base import Side
from gfm_hil.links.port import Port
from gfm_hil.links.zeromq.native import native_port
from gfm_hil.links.zeromq.options import ZmqOptions

_LAST_WORDS = 500  # ms
_ROOM = 64  # messages; 6 ms at 10 kHz, then frames are dropped rather than delivered stale
_DEFAULT = ZmqOptions()


class ZmqLink:
    """One end of the link; implements ``gfm_hil.links.Link``.

    Args:
        side: the controller binds, the plant connects (and keeps trying while nobody listens).
        endpoint: ``ipc:///path`` or ``tcp://host:port``.
        options: of the link.

    Attributes:
        port: libzmq itself on the same socket; None if the options leave the frames to pyzmq, or
            if it has no library that could be called (it says so).

    Raises:
        UserError: it cannot be bound, as when it is in use.
    """

    port: Port | None = None

    def __init__(self, side: Side, endpoint: str, options: ZmqOptions = _DEFAULT) -> None:
        if side == "controller" and endpoint.startswith("ipc://"):
            _refuse_if_served(endpoint)
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PAIR)
        self._socket.set(zmq.SNDHWM, _ROOM)
        self._socket.set(zmq.RCVHWM, _ROOM)
        try:
            if side == "controller":
                self._socket.bind(endpoint)
            else:
                self._socket.connect(endpoint)
        except zmq.ZMQError as problem:
            self.close()
            verb = "bound" if side == "controller" else "connected to"
            why = zmq.strerror(problem.errno or 0)
            raise UserError(f"link.endpoint = {endpoint!r}: cannot be {verb}: {why}") from None
        if not options.portable:
            self.port = native_port(self._socket)
            if self.port is None:
                warnings.warn("no libzmq that could be called: frames go by pyzmq", stacklevel=2)

    def send(self, message: bytes) -> bool:
        """Hand a message over; False if the peer has no room or is not there."""
        try:
            self._socket.send(message, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        """The next message, or None."""
        with contextlib.suppress(zmq.Again):
            return self._socket.recv(zmq.NOBLOCK)
        return None

    def wait(self, seconds: float) -> bool:
        """Sleep until a message is there, at most ``seconds`` (rounded up to a millisecond)."""
        return bool(self._socket.poll(max(1, round(seconds * 1000)), zmq.POLLIN))

    def close(self) -> None:
        """Free the endpoint; the last words get a moment to leave."""
        if self.port is not None:
            self.port.handle[:] = 0  # its functions then do nothing
        self._socket.close(linger=_LAST_WORDS)
        self._context.term()


def _refuse_if_served(endpoint: str) -> None:
    """See that nobody listens there: libzmq would take the file over and leave them deaf.

    Raises:
        UserError: somebody does.
    """
    with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
        probe.connect(endpoint.removeprefix("ipc://"))
        raise UserError(f"link.endpoint = {endpoint!r}: cannot be bound: occupied by another run")
