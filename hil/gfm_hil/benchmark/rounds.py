"""Timing that a noisy machine cannot fool easily: rivals take turns, and the median counts.

A turn is the quickest of a few short runs, since what else the machine does only adds time. A
ratio is taken turn by turn, between runs that follow each other at once, before its median is.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any

RUNS = 20  # in a turn


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest of one measured quantity over all turns, and what each gave."""

    median: float
    min: float
    max: float
    turns: tuple[float, ...]

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        return Spread(statistics.median(values), min(values), max(values), tuple(values))

    def text(self, digits: int) -> str:
        """``median (min–max)`` with so many digits after the point."""
        return f"{self.median:.{digits}f} ({self.min:.{digits}f}–{self.max:.{digits}f})"

    def plain(self) -> dict[str, Any]:
        """The same for JSON, four digits after the point."""
        found = {name: round(getattr(self, name), 4) for name in ("median", "min", "max")}
        return {**found, "turns": [round(value, 4) for value in self.turns]}


def seconds(work: Callable[[], object]) -> float:
    """How long one call takes, in s."""
    begin = perf_counter_ns()
    work()
    return (perf_counter_ns() - begin) * 1e-9


def quickest(run: Callable[[], float], runs: int = RUNS) -> float:
    """The least of what so many calls of ``run`` return."""
    return min(run() for _ in range(runs))


def take_turns(jobs: Mapping[str, Callable[[], float]], turns: int) -> dict[str, list[float]]:
    """Run every job once unrecorded, then all of them in turn; what each returned, per turn.

    Every second turn runs backwards, so that none always follows the same rival.
    """
    for job in jobs.values():
        job()
    found: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(turns):
        for name in list(jobs)[:: -1 if turn % 2 else 1]:
            found[name].append(jobs[name]())
    return found


def rounds(count: int, until: float) -> Iterator[int]:
    """Numbers of rounds: ``count`` of them, or as many as by their length so far end in time.

    At least one. On a machine that is busy with other things rounds take several times longer.

    Args:
        count: wanted.
        until: time of ``time.monotonic``, s.
    """
    begin = time.monotonic()
    for number in range(count):
        now = time.monotonic()
        if number and now + (now - begin) / number > until:
            return
        yield number


def ratio(over: Sequence[float], under: Sequence[float]) -> Spread:
    """The spread of over/under, turn by turn."""
    return Spread.of([a / b for a, b in zip(over, under, strict=True)])
