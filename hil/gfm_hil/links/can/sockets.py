"""Frames to and from a socket, compiled: libc's ``send`` and ``recv`` without Python.

SocketCAN, and a ``Bridge`` in its place, transfer whole structures; on the loopback bus (see
``loopback``) a frame goes to each of the other places as a datagram.
"""

import errno
from collections.abc import Sequence

import numpy as np

from gfm_hil.links.can import LOOPBACK_PLACES
from gfm_hil.links.can.wire import FD, HEAD, MTU, MTU_FD
from gfm_hil.links.system import DONTWAIT, NONE_NOW, errno_now, pollfd, recv, send
from gfm_hil.realtime.clock import now_ns
from gfm_runtime.compiled import compiled

SOCKETCAN, LOOPBACK = range(2)
_OTHERS = LOOPBACK_PLACES - 1  # besides our own
_RECHECK_NS = 50_000_000  # how long to skip a place that was empty

socket_dtype = np.dtype(
    [
        ("kind", "i8"),  # of the bus
        ("fd", "i8"),
        ("others", "i8", (_OTHERS,)),  # sockets connected to the other places
        ("empty_until", "i8", (_OTHERS,)),  # ns
        ("poll", "i8"),  # ``pollfd`` of the socket
    ]
)
POLL_AT = socket_dtype.itemsize - 8

FULL = (errno.ENOBUFS, errno.EAGAIN)


def set_socket(record: np.ndarray, kind: int, fd: int, others: Sequence[int] = ()) -> None:
    """Initialise one record of ``socket_dtype``; its owner keeps the sockets open."""
    record["kind"], record["fd"], record["others"][0, : len(others)] = kind, fd, others
    record["poll"] = pollfd(fd)


@compiled
def write_frame(sockets, frame):
    """Send the frame in an array of ``wire.frame_dtype``; returns 0 or the errno."""
    s, address = sockets[0], frame.ctypes.data
    if s.kind == SOCKETCAN:
        size = MTU_FD if frame[0].flags & FD else MTU
        return 0 if send(s.fd, address, size, DONTWAIT) == size else errno_now()
    problem = now = 0
    size = HEAD + frame[0].length
    for k in range(_OTHERS):
        if s.empty_until[k] != 0:
            now = now or now_ns()
            if now < s.empty_until[k]:
                continue
        s.empty_until[k] = 0
        if send(s.others[k], address, size, DONTWAIT) != size:
            why = errno_now()
            if why == errno.ECONNREFUSED:  # reports the previous datagram, not this one
                s.empty_until[k] = now_ns() + _RECHECK_NS
            else:
                problem = why
    return problem


@compiled
def read_frame(sockets, frame):
    """Receive into the frame in an array of ``wire.frame_dtype``; returns 1, 0 if none is there,
    or the negative errno."""
    got = recv(sockets[0].fd, frame.ctypes.data, MTU_FD, DONTWAIT)
    if got < 0:
        why = errno_now()
        return 0 if why in NONE_NOW else -why
    if got == 0 and sockets[0].kind == SOCKETCAN:  # the bridge has left
        return -errno.ENOTCONN
    f = frame[0]
    f.length = max(0, min(np.int64(f.length), got - HEAD))
    return 1
