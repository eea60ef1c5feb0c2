"""Timing that is robust on a noisy machine: rivals take turns, and the median counts.

A turn is the fastest of a few short runs, since other work on the machine only adds time. A ratio
is computed per turn, between runs that follow each other at once; then the median is taken.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any, Literal

from gfm_hil.bench.cpu_load import Load
from gfm_hil.bench.pair import Policy

RUNS = 20  # in a turn
REST = 0.15  # of a round: the kernel takes 5 % of each second from SCHED_FIFO that only spins


@dataclass(frozen=True)
class Plan:
    """What to measure; a benchmark uses those that concern it.

    Attributes:
        links, laws: names; no laws: the benchmark's own choice.
        modes: lockstep: one round trip after the other; realtime: one every 100 µs.
        loads: idle, or busy: with a CPU load on each processor.
        policies: scheduling of the two processes, the best one first.
        payload: bytes of a request; ``FRAME`` means the bench's frames, 64 there and 48 back.
        cflags: for the C compiler.
        seconds: of one round.
        rounds: of each; fewer if they would not end by ``until`` (``time.monotonic``).
    """

    links: Sequence[str]
    modes: Sequence[Literal["lockstep", "realtime"]]
    loads: Sequence[Load]
    policies: Sequence[Policy]
    payload: int
    laws: Sequence[str]
    cflags: str
    seconds: float
    rounds: int
    until: float


@dataclass(frozen=True)
class Spread:
    """Median, minimum and maximum of one quantity over all turns, and the value of each turn."""

    median: float
    min: float
    max: float
    turns: tuple[float, ...]

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        return Spread(statistics.median(values), min(values), max(values), tuple(values))

    def text(self, digits: int) -> str:
        """``median (min–max)`` with ``digits`` digits after the point."""
        return f"{self.median:.{digits}f} ({self.min:.{digits}f}–{self.max:.{digits}f})"

    def plain(self) -> dict[str, Any]:
        """The same for JSON, four digits after the point."""
        found = {name: round(getattr(self, name), 4) for name in ("median", "min", "max")}
        return {**found, "turns": [round(value, 4) for value in self.turns]}


def seconds(work: Callable[[], object]) -> float:
    """Duration of one call, s."""
    begin = perf_counter_ns()
    work()
    return (perf_counter_ns() - begin) * 1e-9


def quickest(run: Callable[[], float], runs: int = RUNS) -> float:
    """The minimum of the results of ``runs`` calls of ``run``."""
    return min(run() for _ in range(runs))


def take_turns(jobs: Mapping[str, Callable[[], float]], turns: int) -> dict[str, list[float]]:
    """Run every job once to warm up, then all of them in turn; returns each job's results.

    Every second turn has the reverse order, so that no job always follows the same rival.
    """
    for job in jobs.values():
        job()
    found: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(turns):
        for name in list(jobs)[:: -1 if turn % 2 else 1]:
            found[name].append(jobs[name]())
    return found


def rounds(count: int, until: float) -> Iterator[int]:
    """Numbers of rounds: ``count``, or as many as will end in time, judged by the rounds so far.

    At least one. On a busy machine rounds take several times longer.

    Args:
        count: requested rounds.
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
