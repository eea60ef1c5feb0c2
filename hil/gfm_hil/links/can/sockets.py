"""Frames to and from a socket, compiled: libc's ``send`` and ``recv`` without Python.

SocketCAN transfers whole structures; on the loopback bus (see ``loopback``) a frame goes to each
of the other places as a datagram.
"""

from __future__ import annotations

import errno
import select
import socket
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic as _numba_intrinsic

from gfm_hil.links.can.wire import FD, HEAD, MTU, MTU_FD
from gfm_hil.realtime.clock import now_ns
from gfm_runtime.compiled import cached

intrinsic: Any = _numba_intrinsic  # its stubs count typingctx among the caller's arguments

PORTABLE, SOCKETCAN, LOOPBACK = range(3)
_OTHERS = 3  # places of a loopback bus besides our own
_RECHECK_NS = 50_000_000  # how long to skip a place that was empty

socket_dtype = np.dtype(
    [
        ("kind", "i8"),  # of the bus; PORTABLE: compiled code does not access it
        ("fd", "i8"),
        ("others", "i8", (_OTHERS,)),  # sockets connected to the other places
        ("empty_until", "i8", (_OTHERS,)),  # ns
        ("poll", "i8"),  # struct pollfd: the socket and POLLIN
    ]
)
_POLL_AT = socket_dtype.itemsize - 8

_DONTWAIT = int(socket.MSG_DONTWAIT)
_NONE_NOW = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EINTR)
FULL = (errno.ENOBUFS, errno.EAGAIN)
_EVENTS = 32  # bit offset of ``events`` in struct pollfd

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_BYTES = ir.IntType(8).as_pointer()


def _libc(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    known = builder.module.globals.get(name)
    return known or ir.Function(builder.module, ir.FunctionType(result, arguments), name)


def _make_transfer(builder: Any, name: str, arguments: Any) -> Any:
    fd, address, size = arguments
    call = _libc(builder, name, _I64, [_I32, _BYTES, _I64, _I32])
    pointer = builder.inttoptr(address, _BYTES)
    return builder.call(call, [builder.trunc(fd, _I32), pointer, size, _I32(_DONTWAIT)])


@intrinsic
def _send(typingctx, fd, address, size):
    """send(2), non-blocking."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _make_transfer(builder, "send", arguments)

    return types.int64(types.int64, types.int64, types.int64), make


@intrinsic
def _recv(typingctx, fd, address, size):
    """recv(2), non-blocking."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _make_transfer(builder, "recv", arguments)

    return types.int64(types.int64, types.int64, types.int64), make


@intrinsic
def _errno(typingctx):
    """errno of the previous call."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = builder.call(_libc(builder, "__errno_location", _I32.as_pointer(), []), [])
        return builder.sext(builder.load(place), _I64)

    return types.int64(), make


@intrinsic
def _poll(typingctx, address, ms):
    """poll(2) of one struct pollfd."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, ms = arguments
        call = _libc(builder, "poll", _I32, [_BYTES, _I64, _I32])
        pointer = builder.inttoptr(address, _BYTES)
        return builder.call(call, [pointer, _I64(1), builder.trunc(ms, _I32)])

    return types.int32(types.int64, types.int64), make


def set_socket(record: np.ndarray, kind: int, fd: int, others: Sequence[int] = ()) -> None:
    """Initialise one record of ``socket_dtype``; its owner keeps the sockets open."""
    record["kind"], record["fd"], record["others"][0, : len(others)] = kind, fd, others
    record["poll"] = fd | select.POLLIN << _EVENTS


@cached
def write_frame(sockets, frame):
    """Send the frame in an array of ``wire.frame_dtype``; returns 0 or the errno."""
    s, address = sockets[0], frame.ctypes.data
    if s.kind == SOCKETCAN:
        size = MTU_FD if frame[0].flags & FD else MTU
        return 0 if _send(s.fd, address, size) == size else _errno()
    problem = 0
    size = HEAD + frame[0].length
    for k in range(_OTHERS):
        if s.empty_until[k] != 0 and now_ns() < s.empty_until[k]:
            continue
        s.empty_until[k] = 0
        if _send(s.others[k], address, size) != size:
            why = _errno()
            if why == errno.ECONNREFUSED:  # reports the previous datagram, not this one
                s.empty_until[k] = now_ns() + _RECHECK_NS
            else:
                problem = why
    return problem


@cached
def read_frame(sockets, frame):
    """Receive into the frame in an array of ``wire.frame_dtype``; returns 1, 0 if none is there,
    or the negative errno."""
    got = _recv(sockets[0].fd, frame.ctypes.data, MTU_FD)
    if got < 0:
        why = _errno()
        return 0 if why in _NONE_NOW else -why
    f = frame[0]
    f.length = max(0, min(np.int64(f.length), got - HEAD))
    return 1


@cached
def sleep_for_frame(sockets, ms):
    """Sleep until the socket is readable, at most ``ms``."""
    _poll(sockets.ctypes.data + _POLL_AT, ms)
