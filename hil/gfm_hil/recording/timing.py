"""What the time stamps of a run tell: slack, round trip, lateness, misses, and percentiles.

A stamp is ns of CLOCK_MONOTONIC; -1 says that it never happened, as deadlines in lockstep.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import PIECE, Columns, pieces

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}
MISS_NEEDS = ("plant_scheduled", "plant_received")


@dataclass(frozen=True)
class Spread:
    """How many ticks took how long.

    Attributes:
        ns: the different durations in order.
        count: how many ticks took each. Both take little memory, as ticks outnumber durations.
    """

    ns: NDArray[np.int64]
    count: NDArray[np.int64]

    @staticmethod
    def of(durations: Iterable[NDArray[np.int64]]) -> Spread:
        """Of durations in ns, in pieces of any length."""
        ns, count = np.empty(0, np.int64), np.empty(0, np.int64)
        for piece in durations:
            new, many = np.unique(piece, return_counts=True)
            every = np.concatenate([count, many])
            ns, at = np.unique(np.concatenate([ns, new]), return_inverse=True)
            count = np.zeros(len(ns), np.int64)
            np.add.at(count, at, every)
        return Spread(ns, count)

    def __len__(self) -> int:
        return int(self.count.sum())

    def percentile(self, q: float) -> float:
        """The percentile of all durations as ``np.percentile`` has it, ns."""
        behind = np.cumsum(self.count)
        at = q / 100 * (behind[-1] - 1)
        low, high = self.ns[np.searchsorted(behind, [np.floor(at), np.ceil(at)], side="right")]
        return float(low + (high - low) * (at - np.floor(at)))

    def percentiles_us(self) -> dict[str, float]:
        """``PERCENTILES`` in µs, rounded to 10 ns; empty if there is no duration."""
        if not len(self):
            return {}
        return {n: round(self.percentile(q) / 1e3, 2) for n, q in PERCENTILES.items()}


@dataclass(frozen=True)
class Duration:
    """A time that the loop took or had left in each tick, from one stamp to another.

    Attributes:
        name: for labels.
        meaning: in a few words.
        begin, end: columns of timing.npz.
        periods: T_s to be added: the stamp meant at the end is that of so many ticks later.
    """

    name: str
    meaning: str
    begin: str
    end: str
    periods: int = 0

    @property
    def needs(self) -> tuple[str, str]:
        """The columns that it is made of."""
        return self.begin, self.end

    def us(
        self, columns: Columns, T_s: float, first: int = 0, last: int | None = None
    ) -> NDArray[np.float64]:
        """Of each of the ticks [first, last), µs; NaN where a stamp is missing."""
        begin, end = (columns[name][first:last] for name in self.needs)
        there = (begin >= 0) & (end >= 0)
        found = np.full(len(there), np.nan)
        found[there] = self._ns(begin[there], end[there], T_s) * 1e-3
        return found

    def spread(
        self, columns: Columns, T_s: float, first: int = 0, last: int | None = None
    ) -> Spread:
        """Of those of the ticks [first, last) that have both stamps; read piece by piece."""
        last = len(columns[self.end]) if last is None else last
        both = zip(*(pieces(columns[name], first, last) for name in self.needs), strict=True)
        known = ((a, b, (a >= 0) & (b >= 0)) for a, b in both)
        return Spread.of(self._ns(a[there], b[there], T_s) for a, b, there in known)

    def _ns(
        self, begin: NDArray[np.int64], end: NDArray[np.int64], T_s: float
    ) -> NDArray[np.int64]:
        """From stamps that both happened: those of a run that is going on may appear meanwhile."""
        return end + self.periods * round(T_s * 1e9) - begin


SLACK = Duration(
    "slack", "time left when u had arrived", "plant_received", "plant_scheduled", periods=1
)
ROUND_TRIP = Duration("round trip", "from y sent to u received", "plant_sent", "plant_received")
LATE = Duration("late", "start of the tick after its deadline", "plant_scheduled", "plant_woke")


def missed(columns: Columns, first: int = 0, last: int | None = None) -> NDArray[np.bool_]:
    """Which of the ticks [first, last) had a deadline, and no u that came in time."""
    due, received = (columns[name][first:last] for name in MISS_NEEDS)
    return np.asarray((due >= 0) & (received < 0))


def count_misses(columns: Columns, last: int | None = None) -> int:
    """How many ticks before ``last`` were missed; 0 without a recording of the plant's times."""
    if any(name not in columns for name in MISS_NEEDS):
        return 0
    last = len(columns[MISS_NEEDS[0]]) if last is None else last
    spans = ((first, min(first + PIECE, last)) for first in range(0, last, PIECE))
    return sum(int(missed(columns, *span).sum()) for span in spans)
