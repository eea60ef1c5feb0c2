"""Messages on a line of bytes: stuffed by COBS, with a zero byte after each.

Consistent Overhead Byte Stuffing (S. Cheshire and M. Baker, IEEE/ACM Transactions on Networking
7(2), 1999) takes the zeros out of a message for one byte in 254. A zero therefore ends a message
wherever a reader begins, and whatever was lost or damaged before. A frame has a CRC of its own; a
greeting, which has none, gets one here.
"""

from __future__ import annotations

import zlib
from collections import deque

from gfm_hil.links.base import LONGEST

_RUN = 254  # bytes without a zero that one code byte covers
_CRC = 4  # bytes, little-endian
_GREETING = b"GFMHIL "
#: bytes on the line of the longest message, without its zero
_MOST = LONGEST + _CRC + (LONGEST + _CRC) // _RUN + 1


def stuffed(message: bytes) -> bytes:
    """A message as it goes to the line, with the zero that ends it."""
    if message.startswith(_GREETING):
        message += zlib.crc32(message).to_bytes(_CRC, "little")
    out = bytearray()
    for part in message.split(b"\0"):
        while len(part) >= _RUN:
            out += b"\xff" + part[:_RUN]
            part = part[_RUN:]
        out.append(len(part) + 1)
        out += part
    out.append(0)
    return bytes(out)


def unstuffed(piece: bytes) -> bytes | None:
    """The message of what stood between two zeros of the line; None if it is damaged."""
    out, at = bytearray(), 0
    while at < len(piece):
        code = piece[at]
        part = piece[at + 1 : at + code]
        if code == 0 or len(part) != code - 1:
            return None
        out += part
        at += code
        if code <= _RUN and at < len(piece):
            out.append(0)
    message = bytes(out)
    if message.startswith(_GREETING):
        message, crc = message[:-_CRC], message[-_CRC:]
        if zlib.crc32(message).to_bytes(_CRC, "little") != crc:
            return None
    return message


class Unstuffer:
    """Takes bytes as they come from a line, and gives whole messages.

    Attributes:
        damaged: what stood between two zeros and was no message.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._piece = bytearray()
        self._found: deque[bytes] = deque()

    def feed(self, came: bytes) -> None:
        """Take the next bytes of the line."""
        *whole, rest = came.split(b"\0")
        for end in whole:
            self._piece += end[: _MOST + 1]
            if self._piece:
                self._end()
        self._piece += rest[: _MOST + 1]
        del self._piece[_MOST + 1 :]  # too long for a message: the rest, up to a zero, is one too

    def _end(self) -> None:
        message = unstuffed(bytes(self._piece)) if len(self._piece) <= _MOST else None
        self._piece.clear()
        if not message or len(message) > LONGEST:
            self.damaged += 1
        else:
            self._found.append(message)

    def next(self) -> bytes | None:
        """The next message, or None if none is whole yet."""
        return self._found.popleft() if self._found else None
