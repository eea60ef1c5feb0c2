"""Worst-case bus time of a frame: exact, over every identifier and payload (ISO 11898-1).

A stuff bit follows five equal bits and counts as the first of the next five. The search finds the
content with the most stuff bits by dynamic programming, bit by bit: of all contents that end in
the same bit, the same run of it and, in classic CAN, the same CRC, it keeps only the longest. In
CAN FD the CRC has stuff bits at fixed positions, so that its value does not matter; stuff bits at
the data bit rate take less time. The interframe space is included. A recessive ESI, which an
error-passive node sends, makes no frame longer.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from gfm_runtime.compiled import cached

_CRC_15 = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
PAYLOADS = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # bytes; the index is the DLC
_TAIL = 12  # ACK, its delimiter, end of frame, interframe space
_NEVER = -9999
_RUN = 5
#: bits to send: each a value, or None for any value
_Bits = list[int | None]


def _dlc(length: int) -> _Bits:
    return [PAYLOADS.index(length) >> k & 1 for k in (3, 2, 1, 0)]


def _identifier(number: int | None) -> _Bits:
    return [None] * 11 if number is None else [number >> k & 1 for k in range(10, -1, -1)]


@cache
def fd_time(length: int, bitrate: float, data_bitrate: float, number: int | None = None) -> float:
    """Longest time of a CAN FD frame of ``length`` bytes, 11-bit identifier, with BRS, s.

    Args:
        length: payload in bytes, one of 0 … 8, 12, 16, 20, 24, 32, 48, 64.
        bitrate, data_bitrate: bit/s.
        number: the identifier; None for the worst case over all identifiers.
    """
    slow, fast = 1.0 / bitrate, 1.0 / data_bitrate
    # SOF, identifier, RRS, IDE, FDF, res, BRS; then ESI, DLC, data
    head: _Bits = [0, *_identifier(number), 0, 0, 1, 0, 1]
    body: _Bits = [0, *_dlc(length), *[None] * (8 * length)]
    times = [slow] * len(head) + [fast] * len(body)
    best = {(1, 0): 0.0}  # (bit, run): longest time so far
    for k, bit in enumerate([*head, *body]):
        after: dict[tuple[int, int], float] = {}
        last = k == len(times) - 1  # here the CRC's first fixed stuff bit replaces a stuff bit
        for (before, run), time in best.items():
            for value in (0, 1) if bit is None else (bit,):
                now, length_now = time + times[k], run + 1 if value == before else 1
                state = (value, length_now)
                if length_now == _RUN and not last:  # a stuff bit after BRS has the fast rate
                    state, now = (1 - value, 1), now + times[k + 1]
                after[state] = max(after.get(state, 0.0), now)
        best = after
    crc = 17 if length <= 16 else 21
    field = 4 + crc  # with the stuff count
    fixed = 1 + field // 4
    return max(best.values()) + (field + fixed + 1) * fast + _TAIL * slow  # 1: CRC delimiter


@cache
def classic_time(length: int, bitrate: float, number: int | None = None) -> float:
    """Longest time of a classic CAN frame of ``length`` bytes with 11-bit identifier, s."""
    # SOF, identifier, RTR, IDE, r0, DLC, data
    bits: _Bits = [0, *_identifier(number), 0, 0, 0, *_dlc(length), *[None] * (8 * length)]
    wire = np.array([-1 if bit is None else bit for bit in bits])
    return float(len(bits) + 15 + _most_stuffed(wire) + 1 + _TAIL) / bitrate


@cached
def _most_stuffed(bits):
    """Most stuff bits that a classic frame's bits (-1: any) and their CRC can need."""
    # by CRC, last bit and its run 1 … 4: a stuff bit follows the fifth
    most = np.full((1 << 15, 2, _RUN), _NEVER, np.int16)
    most[0, 1, 0] = 0  # before the start of frame: run 0
    for k in range(len(bits) + 15):
        after = np.full_like(most, _NEVER)
        place = len(bits) + 14 - k  # below 15: the number of the CRC bit being sent
        for crc in range(1 << 15):
            for value in range(2):
                to = crc
                if place >= 15:
                    if bits[k] == 1 - value:
                        continue
                    to = (crc << 1 & 0x7FFF) ^ (_CRC_15 if crc >> 14 != value else 0)
                elif crc >> place & 1 != value:
                    continue
                other = most[crc, 1 - value].max()
                after[to, value, 1] = max(after[to, value, 1], other)
                for run in range(_RUN - 1):
                    after[to, value, run + 1] = max(
                        after[to, value, run + 1], most[crc, value, run]
                    )
                stuffed = most[crc, value, _RUN - 1] + 1
                after[to, 1 - value, 1] = max(after[to, 1 - value, 1], stuffed)
        most = after
    return most.max()
