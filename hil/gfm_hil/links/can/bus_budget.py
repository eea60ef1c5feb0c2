"""Whether y and u fit the period: their worst-case bus time against every × T_s.

Both vectors share one bus, so that an exchange takes the sum of their frames. On a bus that is
almost full, an additional frame (a state that changed, see ``vectors``) makes one exchange late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gfm_hil.links.can.dbc import VECTORS
from gfm_hil.links.can.frame_time import classic_time, fd_time
from gfm_hil.links.can.layout import Plan, load_plan
from gfm_hil.links.can.options import CanOptions

DATA_RATES = (2_000_000, 5_000_000, 8_000_000)  # bit/s of common transceivers


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

    def time(length: int) -> float:
        if plan.fd:
            return fd_time(length, bitrate, data_bitrate)
        return classic_time(length, bitrate)

    lengths = {name: [part.length for part in plan.vectors[name]] for name in VECTORS}
    total = {name: math.fsum(map(time, lengths[name])) for name in VECTORS}
    return Budget(total["y"], total["u"], (*lengths["y"], *lengths["u"]))


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
    nearest = [f"every = {need.every(T_s)}"]
    if options.fd:
        faster = [r for r in DATA_RATES if r > options.data_bitrate]
        fits = [r for r in faster if budget(plan, options.bitrate, r).exchange <= period]
        nearest += [f"data_bitrate = {r}" for r in fits[:1]]
    else:
        fd = load_plan(CanOptions())
        fits = [r for r in DATA_RATES if budget(fd, options.bitrate, r).exchange <= period]
        nearest += [f"fd = true, data_bitrate = {r}" for r in fits[:1]]
    rates = f"{options.bitrate / 1e6:g}" + (
        f"/{options.data_bitrate / 1e6:g}" if options.fd else ""
    )
    raise ValueError(
        f"y ({need.y * 1e6:.1f} µs) and u ({need.u * 1e6:.1f} µs) keep a bus of {rates} Mbit/s for "
        f"{need.exchange * 1e6:.1f} µs at worst, {need.load(period):.0%} of every × T_s = "
        f"{period * 1e6:g} µs; nearest that fits: {' or '.join(nearest)}"
    )
