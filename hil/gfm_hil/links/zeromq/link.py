"""ZeroMQ link: a PAIR socket at each end; the controller binds, the plant connects.

PAIR accepts one peer only; a second peer that connects to a DEALER would get every second frame.
libzmq's I/O thread starts here and inherits priority and processor of the thread that opens the
link. Do not raise its priority: above the loop's, each wake-up preempts the loop, and a round trip
takes twice as long.
"""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST, unusable, wait_until
from gfm_hil.links.port import Port
from gfm_hil.links.zeromq.native import native_port
from gfm_hil.links.zeromq.options import ZmqOptions
from gfm_hil.links.zeromq.unix_socket import SCHEME, is_served, path_of

if TYPE_CHECKING:
    from gfm_hil.links.zeromq.curve import Curve

_LAST_WORDS, _FAREWELL = 500, 50  # ms
_NEVER = 10**9  # ms, 11 days; -1 would drop received messages that are not read yet
_POLL_S = 0.01  # poll interval while no controller listens

# The queues for a stalled peer are bounded, and further messages are dropped: each end holds
_ROOM = 64
# messages, and the kernel 500 to 800 more. A Unix socket has this limit by default; TCP gets a
# buffer size in bytes (its default holds 40,000). A frame's tick says how old it is; PAIR ignores
# CONFLATE.
_KERNEL_ROOM = 16384
# libzmq disconnects a peer that announces a longer message before it allocates memory for it; CURVE
# adds 33 bytes to a message
_LARGEST = LONGEST + 64

_DEFAULT = ZmqOptions()


def pair_socket(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
    """A PAIR socket with the link's settings, neither bound nor connected."""
    made = context.socket(zmq.PAIR)
    for option, value in (
        (zmq.SNDHWM, _ROOM),
        (zmq.RCVHWM, _ROOM),
        (zmq.SNDBUF, _KERNEL_ROOM),
        (zmq.RCVBUF, _KERNEL_ROOM),
        (zmq.MAXMSGSIZE, _LARGEST),
        (zmq.LINGER, _LAST_WORDS),  # also of a connection that ``again`` ends
    ):
        made.set(option, value)
    return made


class ZmqLink:
    """One end of the link; implements ``gfm_hil.links.Link``. Raises UserError: the endpoint cannot
    be bound, for example because it is in use; another user owns it or could take it over; keys are
    missing. If the controller starts later, the plant's ``send``, ``receive`` and ``wait`` may
    raise it too.

    Args:
        role: the controller binds, the plant connects; either may start first.
        endpoint: ``ipc:///path`` or ``tcp://host:port``.
        options: of the link.

    Attributes:
        port: calls libzmq directly on the same socket; None if the options leave the frames to
            pyzmq, or if no libzmq can be called (a warning says so).
    """

    port: Port | None = None

    def __init__(self, role: Role, endpoint: str, options: ZmqOptions = _DEFAULT) -> None:
        self._role, self._endpoint, self._ipc = role, endpoint, endpoint.startswith(SCHEME)
        if role == "controller" and self._ipc and is_served(endpoint):
            # libzmq would replace the file, and the other run would receive nothing more
            raise unusable(endpoint, "bound", "occupied by another run")
        self._context = zmq.Context()
        self._socket = pair_socket(self._context)
        self._curve: Curve | None = None
        self._open = False
        try:
            if options.curve is not None:
                from gfm_hil.links.zeromq.curve import Curve  # takes 0.1 s, few runs need it

                self._curve = Curve(self._socket, role, Path(options.curve))
            if role == "controller":
                self._bind()
            else:
                if self._ipc:  # only ``_there`` reconnects: it checks who owns the socket
                    self._socket.set(zmq.RECONNECT_IVL, _NEVER)
                self._there()
        except UserError:
            self.close()
            raise
        except zmq.ZMQError as problem:
            self.close()
            verb = "bound" if role == "controller" else "connected to"
            raise unusable(endpoint, verb, zmq.strerror(problem.errno or 0)) from None
        if not options.portable:
            self.port = native_port(self._socket)
            if self.port is None:
                warnings.warn("no libzmq that could be called: frames go by pyzmq", stacklevel=2)

    def _bind(self) -> None:
        """Listen; an ipc endpoint accepts only processes of our own user."""
        if self._ipc:
            self._socket.set(zmq.IPC_FILTER_UID, os.geteuid())  # by SO_PEERCRED
        self._socket.bind(self._endpoint)
        if self._ipc:
            path_of(self._endpoint).chmod(0o600)
        self._open = True

    def _there(self) -> bool:
        """Whether the socket is bound or connected; connects it as soon as possible."""
        if not self._open and (not self._ipc or is_served(self._endpoint)):
            self._socket.connect(self._endpoint)
            self._open = True
        return self._open

    def connected(self) -> bool | None:
        """Whether a peer is at the other end; None for a plant on tcp, which cannot know."""
        if self._role == "plant" and not self._ipc:
            return None
        return self._open and bool(self._socket.poll(0, zmq.POLLOUT))

    def send(self, message: bytes) -> bool:
        if len(message) > LONGEST or not self._there():
            return False
        try:
            self._socket.send(message, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> bytes | None:
        if self._there():
            with contextlib.suppress(zmq.Again):
                return self._socket.recv(zmq.NOBLOCK)
        return None

    def wait(self, seconds: float) -> bool:
        until = time.monotonic() + seconds
        if not wait_until(self._there, until, _POLL_S, _POLL_S):
            return False
        left = until - time.monotonic()
        return bool(self._socket.poll(max(1, round(left * 1000)), zmq.POLLIN))

    def again(self) -> None:
        """Reconnect: libzmq refuses a second plant for good, even if the first one, of a previous
        run, is about to leave."""
        if self._role == "plant" and self._open:
            self._socket.disconnect(self._endpoint)
            self._socket.poll(_FAREWELL)  # a PAIR accepts no new peer while it disconnects
            self._open = False
            self._there()

    def close(self) -> None:
        """Free the endpoint; the last messages get 500 ms to be sent."""
        if self.port is not None:
            self.port.handle[:] = 0  # makes its functions do nothing
        self._socket.close()
        if self._curve is not None:
            self._curve.close()
        self._context.term()
