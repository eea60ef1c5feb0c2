"""Durations from the time stamps of a run: slack, round trip, lateness, misses, percentiles.

A stamp is in ns of CLOCK_MONOTONIC; -1: it never happened, like deadlines in lockstep.
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
class DurationHistogram:
    """A histogram of durations, which takes little memory: many ticks have the same duration."""

    ns: NDArray[np.int64]  # the different durations in order
    count: NDArray[np.int64]  # number of ticks with each duration

    @staticmethod
    def of(durations: Iterable[NDArray[np.int64]]) -> DurationHistogram:
        """The histogram of durations in ns, given in pieces of any length."""
        ns, count = np.empty(0, np.int64), np.empty(0, np.int64)
        for piece in durations:
            new, many = np.unique(piece, return_counts=True)
            every = np.concatenate([count, many])
            ns, at = np.unique(np.concatenate([ns, new]), return_inverse=True)
            count = np.zeros(len(ns), np.int64)
            np.add.at(count, at, every)
        return DurationHistogram(ns, count)

    def __len__(self) -> int:
        return int(self.count.sum())

    def percentile(self, q: float) -> float:
        """The percentile of all durations, as ``np.percentile`` computes it, ns."""
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
    """A duration in each tick, from one stamp to another."""

    # name, meaning: for labels
    name: str
    meaning: str
    # begin, end: columns of timing.npz
    begin: str
    end: str
    periods: int = 0  # number of T_s to add: the stamp at the end belongs to that many ticks later

    @property
    def needs(self) -> tuple[str, str]:
        """The columns from which it is computed."""
        return self.begin, self.end

    def us(
        self, columns: Columns, T_s: float, first: int = 0, last: int | None = None
    ) -> NDArray[np.float64]:
        """The duration in each of the ticks [first, last), µs; NaN where a stamp is missing."""
        begin, end = (columns[name][first:last] for name in self.needs)
        there = (begin >= 0) & (end >= 0)
        found = np.full(len(there), np.nan)
        found[there] = self._ns(begin[there], end[there], T_s) * 1e-3
        return found

    def histogram(
        self, columns: Columns, T_s: float, first: int = 0, last: int | None = None
    ) -> DurationHistogram:
        """The histogram over the ticks [first, last) with both stamps; read piece by piece."""
        last = len(columns[self.end]) if last is None else last
        both = zip(*(pieces(columns[name], first, last) for name in self.needs), strict=True)
        known = ((a, b, (a >= 0) & (b >= 0)) for a, b in both)
        return DurationHistogram.of(self._ns(a[there], b[there], T_s) for a, b, there in known)

    def _ns(
        self, begin: NDArray[np.int64], end: NDArray[np.int64], T_s: float
    ) -> NDArray[np.int64]:
        """The duration from stamps that were both present; a run in progress may add stamps."""
        return end + self.periods * round(T_s * 1e9) - begin


SLACK = Duration(
    "slack", "time left when u had arrived", "plant_received", "plant_scheduled", periods=1
)
ROUND_TRIP = Duration("round trip", "from y sent to u received", "plant_sent", "plant_received")
LATE = Duration("late", "start of the tick after its deadline", "plant_scheduled", "plant_woke")


def missed(columns: Columns, first: int = 0, last: int | None = None) -> NDArray[np.bool_]:
    """Which of the ticks [first, last) had a deadline but no u in time."""
    due, received = (columns[name][first:last] for name in MISS_NEEDS)
    return np.asarray((due >= 0) & (received < 0))


def count_misses(columns: Columns, last: int | None = None) -> int:
    """How many ticks before ``last`` were missed; 0 without a recording of the plant's times."""
    if any(name not in columns for name in MISS_NEEDS):
        return 0
    last = len(columns[MISS_NEEDS[0]]) if last is None else last
    spans = ((first, min(first + PIECE, last)) for first in range(0, last, PIECE))
    return sum(int(missed(columns, *span).sum()) for span in spans)
