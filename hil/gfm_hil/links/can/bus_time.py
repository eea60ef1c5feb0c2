"""Worst-case bus times: of a frame, and of y and u, which must fit the period every × T_s.

The time of a frame is exact, over every identifier and payload (ISO 11898-1). A stuff bit follows
five equal bits and counts as the first of the next five. The search finds the content with the most
stuff bits by dynamic programming, bit by bit: of all contents that end in the same bit, the same
run of it and, in classic CAN, the same CRC, it keeps only the longest. In CAN FD the CRC has stuff
bits at fixed positions, so that its value does not matter; stuff bits at the data bit rate take
less time. The interframe space is included. A recessive ESI, which an error-passive node sends,
makes no frame longer.

Both vectors share one bus, so that an exchange takes the sum of their frames. On a bus that is
almost full, an additional frame (a state that changed, see ``vectors``) makes one exchange late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.dbc import PAYLOADS, VECTORS
from gfm_hil.links.can.layout import Plan, load_plan
from gfm_runtime.compiled import cached

DATA_RATES = (2_000_000, 5_000_000, 8_000_000)  # bit/s of common transceivers
_CRC_15 = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
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


def frame_time(length: int, fd: bool, bitrate: float, data_bitrate: float) -> float:
    """Longest time of a frame with ``length`` bytes on CAN FD or classic CAN, s."""
    return fd_time(length, bitrate, data_bitrate) if fd else classic_time(length, bitrate)


@dataclass(frozen=True)
class Budget:
    """Worst-case cost of an exchange of y and u.

    Attributes:
        y, u: time on the bus, s.
        lengths: payloads of the frames of y, then of u, bytes.
    """

    y: float
    u: float
    lengths: tuple[int, ...]

    @property
    def exchange(self) -> float:
        """Bus time of y and u together, s."""
        return self.y + self.u

    def load(self, period: float) -> float:
        """Share of a period (s) for which y and u occupy the bus."""
        return self.exchange / period

    def every(self, T_s: float) -> int:
        """Smallest number of ticks per exchange that fits."""
        return max(1, math.ceil(self.exchange / T_s - 1e-9))


def budget(plan: Plan, bitrate: float, data_bitrate: float) -> Budget:
    """The budget of a DBC at these bit rates, bit/s; classic CAN ignores the second."""
    lengths = {name: [part.length for part in plan.vectors[name]] for name in VECTORS}
    y, u = (
        math.fsum(frame_time(n, plan.fd, bitrate, data_bitrate) for n in lengths[name])
        for name in VECTORS
    )
    return Budget(y, u, (*lengths["y"], *lengths["u"]))


def check_budget(options: CanOptions, T_s: float) -> None:
    """Check that every exchange fits the period.

    Raises:
        ValueError: it does not fit; the message says by how much, and the nearest settings that
            do. Or the DBC that the options name cannot be used.
    """
    plan = load_plan(options)
    need = budget(plan, options.bitrate, options.data_bitrate)
    period = options.every * T_s
    if need.exchange <= period * (1 + 1e-9):
        return
    fd, rates = options.fd, f"{options.bitrate / 1e6:g}"
    rates += f"/{options.data_bitrate / 1e6:g}" if fd else ""
    with_fd = plan if fd else load_plan(CanOptions().of_run(options.inner))
    faster = [r for r in DATA_RATES if not fd or r > options.data_bitrate]
    fits = [r for r in faster if budget(with_fd, options.bitrate, r).exchange <= period]
    nearest = [f"every = {need.every(T_s)}"]
    nearest += [f"{'' if fd else 'fd = true, '}data_bitrate = {r}" for r in fits[:1]]
    raise ValueError(
        f"y ({need.y * 1e6:.1f} µs) and u ({need.u * 1e6:.1f} µs) keep a bus of {rates} Mbit/s for "
        f"{need.exchange * 1e6:.1f} µs at worst, {need.load(period):.0%} of every × T_s = "
        f"{period * 1e6:g} µs; nearest that fits: {' or '.join(nearest)}"
    )
