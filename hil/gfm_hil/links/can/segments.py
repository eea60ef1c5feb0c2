"""Messages longer than a CAN frame, as those of the handshake: cut into segments, whole or not.

Each begins with a digest of the sender's DBC and a CRC-32 of what follows. There is no flow
control (ISO-TP has it): a message has a few hundred bytes, and one that is lost is said again.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from gfm_hil.errors import PeerLost
from gfm_hil.links.base import SIDES, Side
from gfm_hil.links.can.layout import Plan

_HEAD = struct.Struct("<II")  # digest of the DBC, CRC-32 of the message
_DATA = 4  # first byte of data in a segment: Message, Index, Segments, Used lie before
_MOST = 255  # segments


class SegmentSender:
    """Cuts one side's messages.

    Args:
        plan: of the DBC.
        side: the sender's.
    """

    def __init__(self, plan: Plan, side: Side) -> None:
        self._layout, self._digest, self._number = plan.segment[side], plan.digest, 0
        self._room = self._layout.length - _DATA
        self.most = _MOST * self._room - _HEAD.size  # bytes of the longest message

    def frames(self, message: bytes) -> list[tuple[int, bytes]]:
        """The CAN frames of a message.

        Raises:
            ValueError: it is too long.
        """
        if len(message) > self.most:
            raise ValueError(f"a message of {len(message)} bytes; at most {self.most} fit")
        whole = _HEAD.pack(self._digest, zlib.crc32(message)) + message
        pieces = [whole[k : k + self._room] for k in range(0, len(whole), self._room)]
        self._number = (self._number + 1) & 0xFF
        out = []
        for k, piece in enumerate(pieces):
            record = np.zeros(1, self._layout.dtype)
            record["Message"], record["Index"] = self._number, k
            record["Segments"], record["Used"] = len(pieces), len(piece)
            record.view(np.uint8)[_DATA : _DATA + len(piece)] = np.frombuffer(piece, np.uint8)
            out.append((self._layout.number, record.tobytes()))
        return out


class SegmentReceiver:
    """Puts the other side's messages together.

    Args:
        plan: of the DBC.
        side: ours.
    """

    def __init__(self, plan: Plan, side: Side) -> None:
        other = SIDES[1 - SIDES.index(side)]
        self._layout, self._digest, self._other = plan.segment[other], plan.digest, other
        self.number = self._layout.number
        self._message, self._pieces = -1, b""
        self._next = 0
        self.damaged = 0  # messages of which a segment is missing or wrong

    def take(self, payload: bytes) -> bytes | None:
        """A segment: the message that it completes, if it does.

        Raises:
            PeerLost: the other side uses another DBC.
        """
        if len(payload) != self._layout.length:
            self.damaged += 1
            return None
        s = np.frombuffer(payload, self._layout.dtype)[0]
        if s["Index"] == 0:
            self._message, self._pieces, self._next = int(s["Message"]), b"", 0
        if (int(s["Message"]), int(s["Index"])) != (self._message, self._next):
            self.damaged += self._message >= 0
            self._message = -1
            return None
        self._pieces += payload[_DATA : _DATA + int(s["Used"])]
        self._next += 1
        if self._next < int(s["Segments"]):
            return None
        self._message = -1
        return self._whole(self._pieces)

    def _whole(self, text: bytes) -> bytes | None:
        if len(text) < _HEAD.size:
            self.damaged += 1
            return None
        digest, crc = _HEAD.unpack_from(text)
        message = text[_HEAD.size :]
        if crc != zlib.crc32(message):
            self.damaged += 1
            return None
        if digest != self._digest:
            raise PeerLost(
                f"the {self._other} uses another DBC ({digest:08x}, ours is {self._digest:08x})"
            )
        return message
