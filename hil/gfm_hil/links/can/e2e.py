"""End-to-end protection of a frame: its first two bytes.

Byte 0: CRC-8 SAE J1850 (polynomial 0x1D, start 0xFF, inverted at the end) over the data id (low
byte, high byte) and then all bytes of the frame but this one, as in AUTOSAR E2E Profile 1A. The
data id does not travel: it is taken from the frame's definition, so that a frame of another
definition under the same identifier fails the check.
Byte 1: counter, six bits of the sequence and two about the tick (see ``vectors``). Profile
1 has four bits, which a stall of a general-purpose kernel (2 to 5 ms, 50 ticks at 10 kHz) would
overrun; a state, which could have had the other four, travels in a frame of its own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_POLYNOMIAL = 0x1D


def _table() -> np.ndarray:
    table = np.zeros(256, np.uint8)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x80 else 0)
        table[byte] = crc & 0xFF
    return table


_TABLE = _table()


@njit(cache=True, nogil=True)
def crc8(data_id, payload):
    """CRC of byte 0 over the data id and ``payload[1:]``."""
    crc = _TABLE[0xFF ^ (data_id & 0xFF)]
    crc = _TABLE[crc ^ (data_id >> 8)]
    for k in range(1, len(payload)):
        crc = _TABLE[crc ^ payload[k]]
    return crc ^ 0xFF
