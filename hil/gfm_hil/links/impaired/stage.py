"""The stage behind an impaired link: what arrives goes in, what is let through comes out.

All of it lives in one int64 array, which is the ``handle`` of the impaired port: settings, the
generator's state, counters, and a queue of messages that wait for their time. So one compiled
implementation serves every link, in Python and in compiled loops alike.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gfm_hil.links.impaired.settings import Impairment
from gfm_hil.realtime.clock import end_this_process, now_ns

INNER, INNER_WORDS = 0, 1  # address and length of the handle of the link underneath
_RANDOM, _LOSS, _LOSS_MORE, _CORRUPT, _BITS, _DUPLICATE, _REORDER = range(2, 9)
_DELAY, _JITTER, _PAUSE_AT, _PAUSE, _KILL_AT, _BURST, _SILENT_UNTIL, _LAST_DUE = range(9, 17)
SEEN, LOST, CORRUPTED, DUPLICATED, REORDERED, PAUSED, DROPPED, REFUSED, _HELD = range(17, 26)
COUNTED = {"seen": SEEN, "lost": LOST, "corrupted": CORRUPTED, "duplicated": DUPLICATED,
           "reordered": REORDERED, "paused": PAUSED, "dropped": DROPPED,
           "refused": REFUSED}  # fmt: skip
_QUEUE = 26

PLACES, _WORDS = 64, 64  # messages in the queue; words of 8 bytes in each
_DUE, _KEY, _SIZE, _DATA = range(4)  # of one place: ns, order, bytes (0: free), the message
_PLACE = _DATA + _WORDS
LONGEST = 8 * _WORDS

_ONE = 1 << 32  # probability 1
_LONG = 1_000_000_000  # ns that a frame waits at most for the next one to overtake it


def make_stage(settings: Impairment, side_number: int) -> NDArray[np.int64]:
    """A stage in which nothing waits; each side draws from a sequence of its own."""
    h = np.zeros(_QUEUE + PLACES * _PLACE, np.int64)
    seed = (settings.seed * 2 + side_number + 1) * 0x9E3779B97F4A7C15  # few bits to many
    h[_RANDOM] = np.uint64(seed % 2**64).astype(np.int64)
    loss, more = settings.loss, max(1 - 1 / settings.burst, settings.loss)
    for index, value in (
        (_LOSS, loss * (1 - more) / (1 - loss) if loss < 1 else 1.0),  # after a frame that came
        (_LOSS_MORE, more),  # after one that was lost
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


@njit(cache=True, nogil=True)
def _draw(h):
    """An integer of [0, 2^32) by xorshift64*."""
    x = np.uint64(h[_RANDOM])
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    h[_RANDOM] = np.int64(x)
    return np.int64((x * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(32))


@njit(cache=True, nogil=True)
def _keep(h, message, size, due, key):
    """Put a copy into a free place of the queue; -1 if there is none: it is gone and counted."""
    for n in range(PLACES):
        at = _QUEUE + n * _PLACE
        if h[at + _SIZE] == 0:
            h[at + _DUE], h[at + _KEY], h[at + _SIZE] = due, key, size
            for word in range((size + 7) // 8):
                value = np.uint64(0)
                for k in range(8 * word, min(8 * word + 8, size)):
                    value |= np.uint64(message[k]) << np.uint64(8 * (k % 8))
                h[at + _DATA + word] = np.int64(value)
            return at
    h[DROPPED] += 1
    return -1


@njit(cache=True, nogil=True)
def _flip(h, message, size):
    """Flip as many different bits as the settings say, each choice of them as likely."""
    left = min(h[_BITS], 8 * size)
    for bit in range(8 * size):
        if _draw(h) * (8 * size - bit) < left * _ONE:
            message[bit // 8] ^= np.uint8(1 << (bit % 8))
            left -= 1


@njit(cache=True, nogil=True)
def waiting(h):
    """How many messages are in the queue."""
    count = 0
    for n in range(PLACES):
        count += h[_QUEUE + n * _PLACE + _SIZE] > 0
    return count


@njit(cache=True, nogil=True)
def admit(h, message, size):
    """Decide the fate of a message that has arrived; what survives waits in the queue.

    Args:
        h: the stage.
        message, size: bytes, of which some are flipped in place if that is its fate.
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
    due = max(due, h[_LAST_DUE])  # a link keeps order, unless it is told not to
    h[_LAST_DUE] = due
    chance = _draw(h)
    limit = h[_LOSS_MORE] if h[_BURST] else h[_LOSS]
    lost = chance < limit
    h[_BURST] = lost
    if lost:
        h[LOST] += 1
        return
    chance -= limit
    if 0 <= chance < h[_CORRUPT]:  # nobody is overtaken by what nobody reads
        h[CORRUPTED] += 1
        _flip(h, message, size)
        _keep(h, message, size, due, 3 * n)
        return
    chance -= h[_CORRUPT]
    twice = 0 <= chance < h[_DUPLICATE]
    chance -= h[_DUPLICATE]
    held = h[_HELD]
    behind = held == 0 and 0 <= chance < h[_REORDER]  # one that waits is to be overtaken
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


@njit(cache=True, nogil=True)
def release(h, message):
    """The next message whose time has come, written to ``message``: its bytes, or 0."""
    best = -1
    now = now_ns()
    for n in range(PLACES):
        at = _QUEUE + n * _PLACE
        if (
            h[at + _SIZE] > 0
            and h[at + _DUE] <= now
            and (best < 0 or h[at + _KEY] < h[best + _KEY])
        ):
            best = at
    if best < 0:
        return 0
    size = h[best + _SIZE]
    h[best + _SIZE] = 0
    if h[_HELD] == best:  # nobody came to overtake it
        h[_HELD] = 0
        h[REORDERED] -= 1
    for k in range(min(size, len(message))):
        message[k] = (np.uint64(h[best + _DATA + k // 8]) >> np.uint64(8 * (k % 8))) & 0xFF
    return size
