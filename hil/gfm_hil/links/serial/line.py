"""Messages to and from the file descriptor of a line, compiled: libc's ``read`` and ``write``.

All state is in one int64 array, the ``handle`` of the port: numbers first, then the bytes of what
came, of the piece of a message up to its zero, of the message, and of what is still to be written.
"""

import termios
from functools import partial
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from gfm_hil.links.base import LONGEST
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.links.serial.framing import DAMAGED, MOST, stuff, unstuff
from gfm_hil.links.system import NONE_NOW, errno_now, poll, pollfd
from gfm_hil.realtime.atomics import copy
from gfm_runtime.compiled import compiled

#: numbers of the handle: the open line (-1: none), counts, errno of a line that is gone, ends
(FD, COUNT_DAMAGED, DROPPED, GONE, _CAME_AT, _CAME_END, _PIECE_END, _REST_AT, _REST_END, _POLL,
 _WAITING, _EMPTY, _MOST_EMPTY, _NAP, _NAP_NS, _SINCE, _MORE) = range(17)  # fmt: skip
_NUMBERS = 17
_WORD = 8
_AT_ONCE = 4096  # bytes of a read
_ROOM = 256  # bytes that may wait in the kernel when another message is sent
_WORDS = (MOST + 2 + _WORD) // _WORD
_CAME = _NUMBERS
_PIECE = _CAME + _AT_ONCE // _WORD
_MESSAGE = _PIECE + _WORDS
_REST = _MESSAGE + _WORDS
_SIZE = _REST + _WORDS

_TIOCOUTQ = termios.TIOCOUTQ
_PATIENCE_MS = 1
# A worker of the kernel, of ordinary priority, moves the bytes (flush_to_ldisc of Linux): two loops
# of SCHED_FIFO that only read leave it no processor. So they read so often, and then sleep: in
# lockstep seldom, since a read moves the bytes too (n_tty_read) if both sides read at once.
_LOOKS, _LOOKS_PACED, _SLEEP_NS = 100, 2, 20_000

# read(2), write(2), ppoll(2) and ioctl(2) of libc; addresses are int64
_transfer = types.int64(types.int32, types.int64, types.int64)
_read: Any = types.ExternalFunction("read", _transfer)
_write: Any = types.ExternalFunction("write", _transfer)
_ppoll: Any = types.ExternalFunction(
    "ppoll", types.int32(types.int64, types.int64, types.int64, types.int64)
)
_ioctl: Any = types.ExternalFunction("ioctl", types.int32(types.int32, types.int64, types.int64))


def make_line() -> NDArray[np.int64]:
    """The handle of a line that is not open yet."""
    h = np.zeros(_SIZE, np.int64)
    h[FD], h[_NAP_NS] = -1, _SLEEP_NS
    set_paced(h, False)
    return h


def set_paced(h: NDArray[np.int64], paced: bool) -> None:
    """Say whether there are pauses between the messages."""
    h[_MOST_EMPTY], h[_MORE] = (_LOOKS_PACED, 0) if paced else (_LOOKS // 4, 3)


def set_line(h: NDArray[np.int64], fd: int) -> None:
    """The line is open; its owner keeps it so, and it does not block. -1: it is closed."""
    h[FD], h[_POLL] = fd, pollfd(max(fd, 0))


@compiled
def flush(h):
    """Write what is left to write as far as there is room; whether that was all. If the line is
    gone, GONE says why, and nothing is left to write."""
    left = h[_REST_END] - h[_REST_AT]
    if left == 0:
        return True
    done = _write(h[FD], h.ctypes.data + _WORD * _REST + h[_REST_AT], left)
    if done < 0:
        why = errno_now()
        if why not in NONE_NOW:
            h[GONE] = why
            h[_REST_AT] = h[_REST_END]
        return False
    h[_REST_AT] += done
    return done == left


@compiled
def _ask_how_many_wait(h):
    """Ask the kernel how many bytes wait to leave; whether the line is still there."""
    if _ioctl(h[FD], _TIOCOUTQ, h.ctypes.data + _WORD * _WAITING) < 0:
        h[GONE] = errno_now()  # the other side closed its pseudo terminal
        return False
    h[_WAITING] &= 0xFFFFFFFF
    h[_SINCE] = 0
    return True


@compiled
def send(h, message):
    """Send a message; 0 if the line has no room for it, or is gone."""
    if h[FD] < 0 or len(message) > LONGEST:
        return 0
    if flush(h):
        # no more can wait than at the last question and what was written since
        if h[_WAITING] + h[_SINCE] > _ROOM and not _ask_how_many_wait(h):
            return 0
        if h[_WAITING] + h[_SINCE] <= _ROOM:
            size = stuff(message, h[_REST:].view(np.uint8))
            h[_REST_AT], h[_REST_END] = 0, size
            h[_SINCE] += size
            flush(h)
            # The question takes 0.5 µs: asked now, it delays no message, for the other side
            # is at work on this one.
            if h[GONE] == 0 and h[_WAITING] + h[_SINCE] > _ROOM:
                _ask_how_many_wait(h)
            return 0 if h[GONE] else 1
    if h[GONE] == 0:
        h[DROPPED] += 1
    return 0


@compiled
def take(h, message):
    """The next message of the bytes that came: its length, or 0 if none is whole."""
    if h[_CAME_AT] == h[_CAME_END]:
        return 0
    came, piece = h[_CAME:_PIECE].view(np.uint8), h[_PIECE:_MESSAGE].view(np.uint8)
    whole = h[_MESSAGE:_REST].view(np.uint8)
    at, end, n, size = h[_CAME_AT], h[_CAME_END], h[_PIECE_END], 0
    while at < end and size == 0:
        zero = at
        while zero < end and came[zero] != 0:
            zero += 1
        if n > 0 or zero == end:  # else the message stands whole in what came
            for k in range(at, min(zero, at + MOST + 1 - n)):  # a longer piece is damaged
                piece[n] = came[k]
                n += 1
        if zero < end and (n > 0 or zero > at):
            if n > MOST or zero - at > MOST:
                size = DAMAGED
            elif n > 0:
                size = unstuff(piece, n, whole)
            else:
                size = unstuff(came[at:], zero - at, whole)
            n = 0
            if size == DAMAGED:
                h[COUNT_DAMAGED] += 1
                size = 0
        at = zero + 1
    h[_CAME_AT], h[_PIECE_END] = min(at, end), n
    copy(message.ctypes.data, whole.ctypes.data, min(size, len(message)))
    return size


@compiled
def receive(h, message):
    """The next message: its length, 0 if none is there, -1 if the line is gone."""
    size = take(h, message)
    if size != 0 or h[FD] < 0:
        return size
    flush(h)
    if h[GONE] != 0:
        return -1
    got = _read(h[FD], h.ctypes.data + _WORD * _CAME, _AT_ONCE)
    if got < 0:
        why = errno_now()
        if why in NONE_NOW:
            return 0
        h[GONE] = why
        return -1
    h[_CAME_AT], h[_CAME_END] = 0, got
    return take(h, message)


def feed(h: NDArray[np.int64], some: bytes) -> None:
    """Take up to 4096 bytes as if they had come over the line, once all before are taken."""
    h[_CAME:_PIECE].view(np.uint8)[: len(some)] = np.frombuffer(some, np.uint8)
    h[_CAME_AT], h[_CAME_END] = 0, len(some)


@free_port_function
def _port_send(handle, message):
    return send(handle, message)


@free_port_function
def _port_receive(handle, message):
    size = receive(handle, message)
    for _ in range(handle[_MORE]):  # between two calls their loop pauses, for a sixth of a read
        if size != 0:
            break
        size = receive(handle, message)
    if size == 0 and handle[_EMPTY] >= handle[_MOST_EMPTY]:
        at = handle.ctypes.data
        _ppoll(at + _WORD * _POLL, 1, at + _WORD * _NAP, 0)
        size = receive(handle, message)
    handle[_EMPTY] = handle[_EMPTY] + 1 if size == 0 else 0
    return size


@free_port_function
def _port_await(handle, message):
    size = receive(handle, message)
    if size == 0:
        poll(handle.ctypes.data + _WORD * _POLL, 1, _PATIENCE_MS)
        size = receive(handle, message)
    return size


def line_port(h: NDArray[np.int64]) -> Port:
    """The port of a line."""
    return Port(h, _port_send, _port_receive, _LOOKS, _port_await, _LOOKS, partial(set_paced, h))


def warm_up() -> None:
    """Compile (or load from the cache) what an end calls."""
    h, message = make_line(), np.zeros(1, np.uint8)
    line_port(h)
    send(h, message)
    receive(h, message)
