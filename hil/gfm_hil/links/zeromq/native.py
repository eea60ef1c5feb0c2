"""libzmq for compiled loops: they call its functions by address, without pyzmq.

It is the library that pyzmq has loaded, so that both use the same socket. A socket may move to
another thread after a full memory fence; starting and joining a thread is one.
"""

import ctypes
from typing import Any

import numpy as np
import zmq
from llvmlite import ir
from numba import njit, types

from gfm_hil.links.port import Port, free_port_function
from gfm_runtime.compiled import FREE, intrinsic

#: elements of a port's handle: zmq_send, zmq_recv and the socket, as addresses; 0 once closed
_SEND, _RECEIVE, _SOCKET = range(3)

_DONTWAIT = int(zmq.DONTWAIT)
_PATIENCE = 1  # ms
_LOOKS = 500  # polls; each is a libzmq call and a yield, about a microsecond


def native_port(socket: zmq.Socket[bytes]) -> Port | None:
    """The port of an open socket, or None if pyzmq exposes no libzmq functions."""
    found = _functions()
    if found is None:
        return None
    handle = np.array([*found, socket.underlying], dtype=np.int64)
    socket.set(zmq.RCVTIMEO, _PATIENCE)
    return Port(handle, _send, _receive, 0, _await, _LOOKS)  # the I/O thread needs the processor


def warm_up() -> None:
    """Compile (or load from the cache) the functions of a port."""
    Port(np.zeros(3, np.int64), _send, _receive, 0, _await)


def _functions() -> tuple[int, int] | None:
    """Addresses of zmq_send and zmq_recv.

    They come from pyzmq's extension module, which resolves them in the library that it is linked
    to: that of its wheel, or the system's.
    """
    try:
        from zmq.backend.cython import _zmq

        library = ctypes.CDLL(_zmq.__file__)
        send, receive = (
            ctypes.cast(getattr(library, name), ctypes.c_void_p).value
            for name in ("zmq_send", "zmq_recv")
        )
    except (ImportError, AttributeError, OSError):  # PyPy; static and hidden; no such loader
        return None
    return (send, receive) if send and receive else None


@intrinsic
def _transfer(typingctx, address, socket, message, size, flags):
    """Call zmq_send or zmq_recv at an address; addresses and sizes are int64; returns int32."""
    int64 = ir.IntType(64)
    pointer = ir.IntType(8).as_pointer()

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        where, *pointers, size, flags = arguments
        kind = ir.FunctionType(ir.IntType(32), [pointer, pointer, int64, ir.IntType(32)])
        function = builder.inttoptr(where, kind.as_pointer())
        pointers = [builder.inttoptr(p, pointer) for p in pointers]
        return builder.call(function, [*pointers, size, builder.trunc(flags, ir.IntType(32))])

    return types.int32(*[types.int64] * 5), make


@free_port_function
def _send(handle, message):
    if handle[_SOCKET] == 0:
        return 0
    sent = _transfer(handle[_SEND], handle[_SOCKET], message.ctypes.data, message.size, _DONTWAIT)
    return 1 if sent == message.size else 0


@njit(**FREE)
def _take(handle, message, flags):
    if handle[_SOCKET] == 0:
        return 0
    got = _transfer(handle[_RECEIVE], handle[_SOCKET], message.ctypes.data, message.size, flags)
    return max(0, got)


@free_port_function
def _receive(handle, message):
    return _take(handle, message, _DONTWAIT)


@free_port_function
def _await(handle, message):
    return _take(handle, message, 0)
