"""A ring of messages between one writer and one reader, both compiled.

A slot is a word, the stamp, and up to 504 bytes. The writer fills the bytes and then releases the
stamp: the number of the message and its length in one. The reader looks at the stamp of the slot
that comes next, and so waits on the very line that brings the message; where the writer stands is
told by nothing else. The reader releases the number of messages it has taken, the head, which the
writer looks at only when its last copy of it says that the ring is full. Stamps and head make the
whole state: whoever takes an end over goes on from them.
"""

from __future__ import annotations

import numpy as np

from gfm_hil.links.base import LONGEST
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.realtime.atomics import copy, load_acquire, pause, store_release
from gfm_runtime.compiled import compiled

SLOTS = 64  # messages; 6 ms at 10 kHz, then frames are dropped rather than delivered stale
WORD = 8  # bytes
SLOT = WORD + LONGEST  # bytes
RING = SLOTS * SLOT  # bytes

#: bits of the stamp for the length; the number of the message, from 1, is above them
LENGTH_BITS = 16
_LENGTH = (1 << LENGTH_BITS) - 1

#: the handle: addresses of the ring written to and of its head (0: not open), messages sent, and
#: the head as last seen; addresses of the ring read from and of its head, messages taken
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
    """Read the next message: its bytes, or 0 if none has come. A longer one is gone."""
    room, to = message.size, message.ctypes.data  # here: in a branch numba would count references
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
    """Whether a message has come."""
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
