"""Messages on a line of bytes: stuffed by COBS, with a zero byte after each; compiled.

Consistent Overhead Byte Stuffing (S. Cheshire and M. Baker, IEEE/ACM Transactions on Networking
7(2), 1999) takes the zeros out of a message for one byte in 254. A zero therefore ends a message
wherever a reader begins, and whatever was lost or damaged before. A frame has a CRC of its own; a
greeting, which has none, gets one here.
"""

from typing import Any

import numpy as np

from gfm_hil.links.base import LONGEST
from gfm_hil.links.crc import crc32
from gfm_runtime.compiled import compiled, inlined

_RUN = 254  # bytes without a zero that one code byte covers
_CRC = 4  # bytes, little-endian
_GREETING = np.frombuffer(b"GFMHIL ", np.uint8)
_LONG = LONGEST + _CRC  # bytes of the longest message with its CRC
#: bytes on the line of the longest message, without its zero
MOST = _LONG + _LONG // _RUN + 1
DAMAGED = -1


@compiled
def _is_greeting(message, size):
    same = size >= len(_GREETING)
    for k in range(min(size, len(_GREETING))):
        same = same and message[k] == _GREETING[k]
    return same


@inlined
def _put(byte, out, code_at, at):
    """Write a byte of a message; returns where its code byte and the next byte stand."""
    if byte == 0:
        out[code_at] = at - code_at
        return at, at + 1
    out[at] = byte
    if at - code_at == _RUN:
        out[code_at] = _RUN + 1
        return at + 1, at + 2
    return code_at, at + 1


@compiled
def stuff(message, out):
    """Write a message as it goes to the line, with the zero that ends it; returns the bytes.

    Args:
        message: at most ``LONGEST`` bytes.
        out: room for ``MOST`` + 1 bytes.
    """
    code_at, at = 0, 1
    for byte in message:
        code_at, at = _put(byte, out, code_at, at)
    if _is_greeting(message, len(message)):
        crc = np.int64(crc32(message, len(message)))
        for k in range(_CRC):
            code_at, at = _put(np.uint8((crc >> (8 * k)) & 0xFF), out, code_at, at)
    out[code_at], out[at] = at - code_at, 0
    return at + 1


@compiled
def unstuff(piece, size, message):
    """Write the message of ``size`` > 0 bytes that stood between two zeros of the line, at most
    ``MOST``, into ``message``, room for as many; returns its length, or ``DAMAGED``."""
    at, n = 0, 0
    while at < size:
        code: Any = np.int64(piece[at])
        if code == 0 or at + code > size:
            return DAMAGED
        for k in range(at + 1, at + code):
            message[n] = piece[k]
            n += 1
        at += code
        if code <= _RUN and at < size:
            message[n] = 0
            n += 1
    if _is_greeting(message, n):
        n -= _CRC
        if n < len(_GREETING):
            return DAMAGED
        crc = np.int64(crc32(message, n))
        for k in range(_CRC):
            if message[n + k] != (crc >> (8 * k)) & 0xFF:
                return DAMAGED
    return n if 0 < n <= LONGEST else DAMAGED


def encoded(message: bytes) -> bytes:
    """A message as it goes to the line, with the zero that ends it."""
    out = np.zeros(MOST + 1, np.uint8)
    return out[: stuff(np.frombuffer(bytearray(message), np.uint8), out)].tobytes()
