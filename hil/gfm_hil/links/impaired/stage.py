"""The fault-injection stage of an impaired link: it admits received messages and releases them.

All its state lies in one int64 array, which is the ``handle`` of the impaired port: settings, the
generator's state, counters, and a queue of delayed messages. One compiled implementation serves
every link, in Python and in compiled loops.
"""

import numpy as np
from numpy.typing import NDArray

from gfm_hil.links.base import LONGEST
from gfm_hil.links.impaired import Impairment
from gfm_hil.realtime.atomics import copy
from gfm_hil.realtime.clock import end_this_process, now_ns
from gfm_runtime.compiled import cached

INNER, INNER_WORDS = 0, 1  # address and length of the wrapped link's handle
_RANDOM, _LOSS, _LOSS_MORE, _CORRUPT, _BITS, _DUPLICATE, _REORDER = range(2, 9)
_DELAY, _JITTER, _PAUSE_AT, _PAUSE, _KILL_AT, _BURST, _SILENT_UNTIL, _LAST_DUE = range(9, 17)
SEEN, LOST, CORRUPTED, DUPLICATED, REORDERED, PAUSED, DROPPED, REFUSED, _HELD = range(17, 26)
COUNTED = {"seen": SEEN, "lost": LOST, "corrupted": CORRUPTED, "duplicated": DUPLICATED,
           "reordered": REORDERED, "paused": PAUSED, "dropped": DROPPED,
           "refused": REFUSED}  # fmt: skip
_QUEUE = 26

PLACES, _WORD = 64, 8  # messages in the queue; bytes
_DUE, _KEY, _SIZE, _DATA = range(4)  # of one place: ns, order, bytes (0: free), message
_PLACE = _DATA + LONGEST // _WORD

_ONE = 1 << 32  # probability 1
_LONG = 1_000_000_000  # ns: longest time that a frame waits for the next one to overtake it


def make_stage(settings: Impairment, role_number: int) -> NDArray[np.int64]:
    """A stage with an empty queue; each side draws its own random sequence."""
    h = np.zeros(_QUEUE + PLACES * _PLACE, np.int64)
    seed = (settings.seed * 2 + role_number + 1) * 0x9E3779B97F4A7C15  # spreads a small seed's bits
    h[_RANDOM] = np.uint64(seed % 2**64).astype(np.int64)
    loss, more = settings.loss, max(1 - 1 / settings.burst, settings.loss)
    for index, value in (
        (_LOSS, loss * (1 - more) / (1 - loss) if loss < 1 else 1.0),  # after a received frame
        (_LOSS_MORE, more),  # after a lost frame
        (_CORRUPT, settings.corrupt),
        (_DUPLICATE, settings.duplicate),
        (_REORDER, settings.reorder),
    ):
        h[index] = round(value * _ONE)
    h[_BITS] = settings.bits
    h[_DELAY], h[_JITTER] = round(settings.delay * 1e9), round(settings.jitter * 1e9)
    h[_PAUSE_AT] = -1 if settings.pause_at is None else settings.pause_at
    h[_KILL_AT] = -1 if settings.kill_at is None else settings.kill_at
    h[_PAUSE] = round(settings.pause * 1e9)
    return h


@cached
def _draw(h):
    """An integer of [0, 2^32) by xorshift64*."""
    x = np.uint64(h[_RANDOM])
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    h[_RANDOM] = np.int64(x)
    return np.int64((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(32))


@cached
def _keep(h, message, size, due, key):
    """Copy a message into a free place of the queue; if there is none, count it as dropped and
    return -1."""
    to, origin = h.ctypes.data, message.ctypes.data  # in a branch numba would count references
    for n in range(PLACES):
        at = _QUEUE + n * _PLACE
        if h[at + _SIZE] == 0:
            h[at + _DUE], h[at + _KEY], h[at + _SIZE] = due, key, size
            copy(to + _WORD * (at + _DATA), origin, size)
            return at
    h[DROPPED] += 1
    return -1


@cached
def _flip(h, message, size):
    """Flip the set number of different bits, all choices equally likely."""
    left = min(h[_BITS], 8 * size)
    for bit in range(8 * size):
        if _draw(h) * (8 * size - bit) < left * _ONE:
            message[bit // 8] ^= np.uint8(1 << (bit % 8))
            left -= 1


@cached
def waiting(h):
    """How many messages are in the queue."""
    count = 0
    for n in range(PLACES):
        count += h[_QUEUE + n * _PLACE + _SIZE] > 0
    return count


@cached
def admit(h, message, size):
    """Apply the faults to a received message; if it is not lost, put it into the queue.

    Args:
        h: the stage.
        message, size: bytes; a corruption flips bits in place.
    """
    if size > LONGEST:
        return
    n = h[SEEN]
    h[SEEN] += 1
    now = now_ns()
    if n == h[_KILL_AT]:
        end_this_process()
    if n == h[_PAUSE_AT]:
        h[_SILENT_UNTIL] = now + h[_PAUSE]
    due = now + h[_DELAY]
    if h[_JITTER] > 0:
        due += (_draw(h) * h[_JITTER]) >> 32
    if now < h[_SILENT_UNTIL]:
        h[PAUSED] += 1
        due = max(due, h[_SILENT_UNTIL])
    due = max(due, h[_LAST_DUE])  # keep the order; only ``reorder`` changes it
    h[_LAST_DUE] = due
    chance = _draw(h)
    limit = h[_LOSS_MORE] if h[_BURST] else h[_LOSS]
    lost = chance < limit
    h[_BURST] = lost
    if lost:
        h[LOST] += 1
        return
    chance -= limit
    if 0 <= chance < h[_CORRUPT]:  # the reader refuses it, so it overtakes no waiting frame
        h[CORRUPTED] += 1
        _flip(h, message, size)
        _keep(h, message, size, due, 3 * n)
        return
    chance -= h[_CORRUPT]
    twice = 0 <= chance < h[_DUPLICATE]
    chance -= h[_DUPLICATE]
    held = h[_HELD]
    behind = held == 0 and 0 <= chance < h[_REORDER]  # at most one frame waits
    h[_HELD] = 0
    if behind:
        h[REORDERED] += 1
        h[_HELD] = max(_keep(h, message, size, due + _LONG, 3 * n), 0)
    else:
        _keep(h, message, size, due, 3 * n)
    if twice:
        h[DUPLICATED] += 1
        _keep(h, message, size, due, 3 * n + 1)
    if held:
        h[held + _DUE], h[held + _KEY] = due, 3 * n + 2


@cached
def release(h, message):
    """Write the next message that is due to ``message``; returns its length in bytes, or 0."""
    to, origin = message.ctypes.data, h.ctypes.data
    best = -1
    now = now_ns()
    for n in range(PLACES):
        at = _QUEUE + n * _PLACE
        due = h[at + _SIZE] > 0 and h[at + _DUE] <= now
        if due and (best < 0 or h[at + _KEY] < h[best + _KEY]):
            best = at
    if best < 0:
        return 0
    size = h[best + _SIZE]
    h[best + _SIZE] = 0
    if h[_HELD] == best:  # no frame arrived to overtake it
        h[_HELD] = 0
        h[REORDERED] -= 1
    copy(to, origin + _WORD * (best + _DATA), min(size, len(message)))
    return size
