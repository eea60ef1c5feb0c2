"""A ring of messages between one writer and one reader, both compiled.

A slot is a stamp (one word) and up to 504 bytes. The writer fills the bytes and then writes the
stamp with a release store: the number of the message and its length in one word. The reader polls
the stamp of the next slot, and so waits on the cache line that brings the message; the writer
publishes no other position. The reader releases the head, the number of messages it has taken. The
writer loads it only when its last copy says that the ring is full. Stamps and head are the whole
state: a process that takes over an end continues from them.

A ring may have a bell, a word by which a reader that sleeps is woken: not 0 while it sleeps. A
writer that does not know it only lets the reader sleep for longer.
"""

import platform
import sys
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from gfm_hil.links.base import LONGEST
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.realtime.atomics import copy, load_acquire, store_release
from gfm_runtime.compiled import compiled

SLOTS = 64  # messages: 6 ms at 10 kHz; a full ring drops frames instead of delivering stale ones
WORD = 8  # bytes
SLOT = WORD + LONGEST  # bytes
RING = SLOTS * SLOT  # bytes

#: bits of the stamp for the length; the number of the message, from 1, is above them
LENGTH_BITS = 16
_LENGTH = (1 << LENGTH_BITS) - 1

#: the handle: addresses of the ring to write and of its head (0: not open), messages sent, and
#: the last copy of the head; addresses of the ring to read and of its head, messages taken;
#: addresses of the bells of both (0: it has none); the longest sleep, a struct timespec
OUT, OUT_HEAD, SENT, SEEN, IN, IN_HEAD, TAKEN, OUT_BELL, IN_BELL, SLEEP, SLEEP_NS, HANDLE = range(
    12
)

_LONGEST_NS = 200_000
_WAIT, _WAKE = 0, 1  # FUTEX_WAIT and FUTEX_WAKE of linux/futex.h
_FUTEX = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), -1)  # number of the system call

HAS_BELLS = _FUTEX > 0 and sys.platform == "linux"

_int64 = types.int64
_syscall: Any = types.ExternalFunction("syscall", _int64(*[_int64] * 5))


@compiled
def put(handle, message):
    """Write a message to the ring: 1, or 0 if it is full, closed, or the message does not fit."""
    size = message.size
    sent = handle[SENT]
    if size == 0 or size > LONGEST or handle[OUT] == 0:
        return 0
    if sent - handle[SEEN] >= SLOTS:
        handle[SEEN] = load_acquire(handle[OUT_HEAD])
        if sent - handle[SEEN] >= SLOTS:
            return 0
    slot = handle[OUT] + sent % SLOTS * SLOT
    copy(slot + WORD, message.ctypes.data, size)
    handle[SENT] = sent + 1
    store_release(slot, (sent + 1) << LENGTH_BITS | size)
    bell = handle[OUT_BELL]
    if bell != 0 and load_acquire(bell) != 0:
        store_release(bell, 0)
        _syscall(_FUTEX, bell, _WAKE, 1, 0)
    return 1


@compiled
def take(handle, message):
    """Read the next message: returns its length in bytes, or 0 if none has arrived. A message
    longer than ``message`` is dropped, and its length returned."""
    room, to = message.size, message.ctypes.data  # in a branch numba would count references
    if handle[IN] == 0:
        return 0
    taken = handle[TAKEN]
    slot = handle[IN] + taken % SLOTS * SLOT
    stamp = load_acquire(slot)
    if stamp >> LENGTH_BITS != taken + 1:
        return 0
    size = stamp & _LENGTH
    if size <= room:
        copy(to, slot + WORD, size)
    handle[TAKEN] = taken + 1
    store_release(handle[IN_HEAD], taken + 1)
    return size


@compiled
def patient(handle, message):
    """As ``take``, but sleeps for up to 0.2 ms until a message arrives.

    The writer may have looked at the bell just before it was set: the reader then oversleeps the
    message by that time.
    """
    size = take(handle, message)
    bell = handle[IN_BELL]
    if size != 0 or bell == 0:
        return size
    store_release(bell, 1)
    if not waiting(handle):
        _syscall(_FUTEX, bell, _WAIT, 1, handle.ctypes.data + WORD * SLEEP)
    store_release(bell, 0)
    return take(handle, message)


@compiled
def waiting(handle):
    """Whether a message has arrived."""
    taken = handle[TAKEN]
    if handle[IN] == 0:
        return False
    return load_acquire(handle[IN] + taken % SLOTS * SLOT) >> LENGTH_BITS == taken + 1


@free_port_function
def port_send(handle, message):
    return put(handle, message)


@free_port_function
def port_receive(handle, message):
    return take(handle, message)


@free_port_function
def port_patient(handle, message):
    return patient(handle, message)


def make_handle() -> NDArray[np.int64]:
    """A handle that is not open."""
    handle = np.zeros(HANDLE, np.int64)
    handle[SLEEP_NS] = _LONGEST_NS
    return handle


def warm_up() -> None:
    """Compile (or load from the cache) all functions, on a handle that is not open."""
    handle, message = make_handle(), np.zeros(1, np.uint8)
    put(handle, message)
    take(handle, message)
    waiting(handle)
    patient(handle, message)
    Port(handle, port_send, port_receive, 0, port_patient)
