"""Longest times on the bus: of a frame, and of y and u, which must fit the period every × T_s.

They hold for every identifier (11 bits) and content, with stuff bits and the interframe space
(ISO 11898-1), and they are exact: ``tests/hil/links/test_can_time.py`` finds the same by
enumeration. A recessive ESI, which an error-passive node sends, makes no frame longer.

Both vectors share one bus, so that an exchange takes the sum of their frames. On a bus that is
almost full, an additional frame (a state that changed, see ``vectors``) makes one exchange late.
"""

import math
from dataclasses import dataclass

from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.dbc import PAYLOADS, VECTORS
from gfm_hil.links.can.layout import Plan, load_plan

DATA_RATES = (2_000_000, 5_000_000, 8_000_000)  # bit/s of common transceivers

#: bits of the longest classic frames of 0 to 8 bytes: up to 3 fewer than the bound of Davis et al.,
#: 8 n + 47 + floor((8 n + 33) / 4) (Real-Time Systems 35, 2007): the CRC cannot have every value
_CLASSIC_BITS = (53, 62, 72, 83, 93, 102, 113, 124, 133)

# CAN FD: bits at the slow rate: SOF, identifier, RRS, IDE, FDF, res and BRS with 3 stuff bits; ACK,
# its delimiter, end of frame and interframe space
_SLOW_BITS = 17 + 3 + 12
#: how many equal bits end ESI and the DLC, which come before the data
_RUN = [5, 1, 1, 2, 2, 1, 1, 3, 3, 1, 1, 2, 2, 1, 1, 4]


def frame_time(length: int, fd: bool, bitrate: float, data_bitrate: float) -> float:
    """Longest time of a classic frame, or of one of CAN FD with BRS, s.

    A stuff bit follows five equal bits and counts as the first of the next five. In CAN FD one that
    would follow the last data bit is replaced by the CRC field's first fixed one.

    Args:
        length: payload in bytes, one of ``PAYLOADS``.
        fd: CAN FD rather than classic.
        bitrate, data_bitrate: bit/s; a classic frame has the first alone.
    """
    if not fd:
        return _CLASSIC_BITS[length] / bitrate
    data = 8 * length
    stuffed = max(0, _RUN[PAYLOADS.index(length)] + data - 2) // 4
    checked = 4 + (17 if length <= 16 else 21)  # stuff count and CRC, with a stuff bit every 4 bits
    fast = 5 + data + stuffed + checked + 1 + checked // 4 + 1  # ESI and DLC; the CRC delimiter
    return _SLOW_BITS / bitrate + fast / data_bitrate


@dataclass(frozen=True)
class Budget:
    """Worst-case cost of an exchange of y and u."""

    # y, u: time on the bus, s
    y: float
    u: float
    lengths: tuple[int, ...]  # payloads of the frames of y, then of u, bytes

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
    """Check that every exchange fits the period. Raises ValueError: it does not fit; the message
    says by how much, and the nearest settings that do. Or the DBC that the options name cannot be
    used."""
    plan = load_plan(options)
    need = budget(plan, options.bitrate, options.data_bitrate)
    period = options.every * T_s
    if need.exchange <= period * (1 + 1e-9):
        return
    fd, rates = options.fd, f"{options.bitrate / 1e6:g}"
    rates += f"/{options.data_bitrate / 1e6:g}" if fd else ""
    with_fd = plan if fd else load_plan(CanOptions().of_run(options.signal_set))
    faster = [r for r in DATA_RATES if not fd or r > options.data_bitrate]
    fits = [r for r in faster if budget(with_fd, options.bitrate, r).exchange <= period]
    nearest = [f"every = {need.every(T_s)}"]
    nearest += [f"{'' if fd else 'fd = true, '}data_bitrate = {r}" for r in fits[:1]]
    raise ValueError(
        f"y ({need.y * 1e6:.1f} µs) and u ({need.u * 1e6:.1f} µs) keep a bus of {rates} Mbit/s for "
        f"{need.exchange * 1e6:.1f} µs at worst, {need.load(period):.0%} of every × T_s = "
        f"{period * 1e6:g} µs; nearest that fits: {' or '.join(nearest)}"
    )
