"""ZeroMQ link: a PAIR socket at each end, the controller binds, the plant connects.

PAIR, because it takes one peer and no other: a stranger that connects to a DEALER would get every
second frame. libzmq's I/O thread is started here and inherits the scheduling of the thread that
opens the link, priority and processor. Leave it at that: with a higher priority than the loop's,
each wake-up preempts the loop, and a round trip takes twice as long.
"""

from __future__ import annotations

import contextlib
import socket
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from gfm_hil.errors import UserError
from gfm_hil.links.base import Side
from gfm_hil.links.port import Port
from gfm_hil.links.zeromq.native import native_port
from gfm_hil.links.zeromq.options import ZmqOptions

if TYPE_CHECKING:
    from gfm_hil.links.zeromq.curve import Curve

_LAST_WORDS, _FAREWELL = 500, 50  # ms

# What a stalled peer leaves unread is bounded, and more is dropped: at each end so many messages,
_ROOM = 64
# and in the kernel 500 to 800 more: a Unix socket takes no more by itself, tcp is told (bytes; by
# itself it takes 40,000). A frame's tick says how old it is; PAIR ignores CONFLATE.
_KERNEL_ROOM = 16384

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
        UserError: it cannot be bound, as when it is in use; keys are missing.
    """

    port: Port | None = None

    def __init__(self, side: Side, endpoint: str, options: ZmqOptions = _DEFAULT) -> None:
        if side == "controller" and endpoint.startswith("ipc://"):
            _refuse_if_served(endpoint)
        self._side, self._endpoint = side, endpoint
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PAIR)
        self._socket.set(zmq.SNDHWM, _ROOM)
        self._socket.set(zmq.RCVHWM, _ROOM)
        self._socket.set(zmq.SNDBUF, _KERNEL_ROOM)
        self._socket.set(zmq.RCVBUF, _KERNEL_ROOM)
        self._curve: Curve | None = None
        try:
            if options.curve is not None:
                from gfm_hil.links.zeromq.curve import Curve  # 0.1 s, most runs need none

                self._curve = Curve(self._socket, side, Path(options.curve))
            if side == "controller":
                self._socket.bind(endpoint)
            else:
                self._socket.connect(endpoint)
        except UserError:
            self.close()
            raise
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

    def again(self) -> None:
        """Reach out anew: libzmq turns a second plant away once and for all, even if the first
        one, of a run before, is about to leave."""
        if self._side == "plant":
            self._socket.disconnect(self._endpoint)
            self._socket.poll(_FAREWELL)  # a PAIR takes no other peer while it parts from one
            self._socket.connect(self._endpoint)

    def close(self) -> None:
        """Free the endpoint; the last words get a moment to leave."""
        if self.port is not None:
            self.port.handle[:] = 0  # its functions then do nothing
        self._socket.close(linger=_LAST_WORDS)
        if self._curve is not None:
            self._curve.close()
        self._context.term()


def _refuse_if_served(endpoint: str) -> None:
    """See that nobody listens there: libzmq would take the file over and leave them deaf.

    Raises:
        UserError: somebody does.
    """
    with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
        probe.connect(endpoint.removeprefix("ipc://"))
        raise UserError(f"link.endpoint = {endpoint!r}: cannot be bound: occupied by another run")
