"""A ring of messages between one writer and one reader, both compiled.

A slot is a stamp (one word) and up to 504 bytes. The writer fills the bytes and then writes the
stamp with a release store: the number of the message and its length in one word. The reader polls
the stamp of the next slot, and so waits on the cache line that brings the message; the writer
publishes no other position. The reader releases the head, the number of messages it has taken. The
writer loads it only when its last copy says that the ring is full. Stamps and head are the whole
state: a process that takes over an end continues from them.
"""

from __future__ import annotations

import numpy as np

from gfm_hil.links.base import LONGEST
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.realtime.atomics import copy, load_acquire, pause, store_release
from gfm_runtime.compiled import compiled

SLOTS = 64  # messages: 6 ms at 10 kHz; a full ring drops frames instead of delivering stale ones
WORD = 8  # bytes
SLOT = WORD + LONGEST  # bytes
RING = SLOTS * SLOT  # bytes

#: bits of the stamp for the length; the number of the message, from 1, is above them
LENGTH_BITS = 16
_LENGTH = (1 << LENGTH_BITS) - 1

#: the handle: addresses of the ring to write and of its head (0: not open), messages sent, and
#: the last copy of the head; addresses of the ring to read and of its head, messages taken
OUT, OUT_HEAD, SENT, SEEN, IN, IN_HEAD, TAKEN, HANDLE = range(8)


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
        pause()
        return 0
    size = stamp & _LENGTH
    if size <= room:
        copy(to, slot + WORD, size)
    handle[TAKEN] = taken + 1
    store_release(handle[IN_HEAD], taken + 1)
    return size


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


def warm_up() -> None:
    """Compile (or load from the cache) all functions, on a handle that is not open."""
    handle, message = np.zeros(HANDLE, np.int64), np.zeros(1, np.uint8)
    put(handle, message)
    take(handle, message)
    waiting(handle)
    Port(handle, port_send, port_receive, 0)
