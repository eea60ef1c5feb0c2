"""Frames with a good CRC and wrong content."""

import struct
import zlib
from typing import Any

import numpy as np

from gfm_hil.links.frame import FrameWriter
from gfm_runtime.signals import Group


def resealed(good: bytes, at: int, value: int) -> bytes:
    """A frame with one header byte changed and a CRC that fits it."""
    body = bytearray(good[:-4])
    body[at] = value
    return bytes(body) + struct.pack("<I", zlib.crc32(body))


ONES = {"y": np.array([1.0, 0.5, 1.0, 0.0, 1.0]), "u": np.array([0.3, 1.0, 1.0])}


HOLD = 500


FAR = 39_995  # in a run of 40,000 ticks


REALTIME = {
    "mode": "realtime",
    "duration": 4.0,
    "link": {"type": "shm"},
    "late_policy": {"hold": HOLD},
}


T_NS = 100_000


class Forger(FrameWriter):
    """Packs frames with a good CRC and any tick below 2**64."""

    def __init__(self, group: Group, sequence: int = 0) -> None:
        super().__init__(group)
        self.usual, self.sequence[0] = (ONES[group], sequence % 2**32)

    def forge(self, tick: int, state: int, reason: int = 0, values: Any = None) -> bytes:
        good = self.pack(0, state, reason, self.usual if values is None else values)
        body = good[:12] + struct.pack("<Q", tick % 2**64) + good[20:-4]
        return body + struct.pack("<I", zlib.crc32(body))
