"""Messages longer than a CAN frame, such as the handshake's, travel in segments, whole or not.

Each message begins with a digest of the sender's DBC and a CRC-32 of the rest. There is no flow
control (ISO-TP has it): a message has a few hundred bytes, and the sender repeats a lost one.
Python cuts messages, since only the handshake sends them; joining is compiled, since a late
message may arrive during a run.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.wire import number
from gfm_hil.links.crc import crc32
from gfm_runtime.compiled import cached

NOTHING, OTHER_DBC = -1, -2

_HEAD = struct.Struct("<II")  # digest of the DBC, CRC-32 of the message
_HEAD_BYTES = 8
_DATA = 4  # first data byte in a segment, after Message, Index, Segments and Used
_MOST = 255  # segments
LONGEST = _MOST * (64 - _DATA)  # bytes of a message

joiner_dtype = np.dtype(
    [
        ("number", "i8"),  # identifier
        ("length", "i8"),
        ("at", "i8", (_DATA,)),  # where Message, Index, Segments and Used lie
        ("digest", "i8"),  # of our DBC
        ("theirs", "i8"),  # digest that the last joined message carried
        ("message", "i8"),  # number of the message being joined, -1 for none
        ("next", "i8"),  # index of the segment expected
        ("used", "i8"),  # bytes so far
        ("damaged", "i8"),  # messages with a missing or wrong segment
        ("text", "u1", ((LONGEST + 7) // 8 * 8,)),
    ]
)


class SegmentSender:
    """Cuts one side's messages."""

    def __init__(self, plan: Plan, role: Role) -> None:
        self._layout, self._digest, self._number = plan.segment[role], plan.digest, 0
        self._room = self._layout.length - _DATA
        self.most = _MOST * self._room - _HEAD.size  # bytes of the longest message

    def frames(self, message: bytes) -> list[tuple[int, bytes]]:
        """Identifier and payload of the CAN frames of a message.

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


def set_joiner(joiner: np.ndarray, plan: Plan, role: Role) -> None:
    """Initialise one record of ``joiner_dtype`` for the segments that the other side sends."""
    layout, j = plan.segment[ROLES[1 - ROLES.index(role)]], joiner[0]
    fields = layout.dtype.fields
    assert fields is not None
    j["number"], j["length"], j["digest"] = layout.number, layout.length, plan.digest
    j["at"] = [fields[name][1] for name in ("Message", "Index", "Segments", "Used")]
    j["message"] = NOTHING


@cached
def join(joiner, frame, message):
    """Add a segment to its message.

    Args:
        joiner: one record of ``joiner_dtype``.
        frame: one record of ``wire.frame_dtype`` with its identifier.
        message: bytes, written; a longer message is cut off.

    Returns:
        The length of the message that it completes, NOTHING, or OTHER_DBC.
    """
    j = joiner[0]
    if frame.length != j.length:
        j.damaged += 1
        return NOTHING
    data = frame.data
    of, index = np.int64(data[j.at[0]]), np.int64(data[j.at[1]])
    segments, used = np.int64(data[j.at[2]]), np.int64(data[j.at[3]])
    if index == 0:
        j.message, j.next, j.used = of, 0, 0
    if of != j.message or index != j.next:
        j.damaged += j.message >= 0
        j.message = NOTHING
        return NOTHING
    for k in range(min(used, j.length - _DATA)):
        j.text[j.used] = data[_DATA + k]
        j.used += 1
    j.next += 1
    if j.next < segments:
        return NOTHING
    j.message = NOTHING
    return _whole(j, message)


@cached
def _whole(j, message):
    size = j.used - _HEAD_BYTES
    if size < 0 or number(j.text, 4, 4) != crc32(j.text[_HEAD_BYTES:], size):
        j.damaged += 1
        return NOTHING
    j.theirs = number(j.text, 0, 4)
    if j.theirs != j.digest:
        return OTHER_DBC
    for k in range(min(size, len(message))):
        message[k] = j.text[_HEAD_BYTES + k]
    return size
