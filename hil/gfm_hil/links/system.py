"""What the links' compiled functions share of libc: errno and poll."""

import errno
import select
import socket
from typing import Any

from numba import int64, types

from gfm_hil.realtime.atomics import load32
from gfm_runtime.compiled import compiled

NONE_NOW = (errno.EAGAIN, errno.EINTR)  # nothing has come, or there is no room

_errno_place: Any = types.ExternalFunction("__errno_location", types.int64())

#: poll(2): address of the structures ``pollfd``, how many, and ms
poll: Any = types.ExternalFunction("poll", types.int32(types.int64, types.int64, types.int32))

#: send(2) and recv(2); addresses are int64
DONTWAIT = int(socket.MSG_DONTWAIT)
_transfer = types.int64(types.int32, types.int64, types.int64, types.int32)
send: Any = types.ExternalFunction("send", _transfer)
recv: Any = types.ExternalFunction("recv", _transfer)


def pollfd(fd: int) -> int:
    """struct pollfd as one word: the file descriptor is to be readable."""
    return fd | select.POLLIN << 32


@compiled
def errno_now():
    """errno of the previous call."""
    return int64(load32(_errno_place()))
