"""Timing that is robust on a noisy machine: rivals take turns, and the median counts.

A turn is the fastest of a few short runs, since other work on the machine only adds time. A ratio
is computed per turn, between runs that follow each other at once; then the median is taken.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from time import perf_counter_ns
from typing import Any, TypeVar

RUNS = 20  # in a turn
REST = 0.15  # of a round: the kernel takes 5 % of each second from SCHED_FIFO that only spins

T = TypeVar("T")
ShowProgress = Callable[[str, float], None]  # the present work, and the share done


def in_turn(
    rivals: Sequence[T], rounds: int, until: float = math.inf
) -> Iterator[tuple[int, float, T]]:
    """Every rival once a round, as (round, share done before it, rival). Every second round has the
    reverse order, so that no rival always follows the same one.

    There are as many rounds as asked, or as will end by ``until`` (``time.monotonic``), judged by
    the rounds so far, at least one: on a busy machine rounds take several times longer.
    """
    begin = time.monotonic()
    for number in range(rounds):
        now = time.monotonic()
        if number and now + (now - begin) / number > until:
            return
        for k, rival in enumerate(rivals[:: -1 if number % 2 else 1]):
            yield number, (number + k / len(rivals)) / rounds, rival


def take_turns(jobs: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Run every job once to warm up, then all of them in turn; returns each job's results."""
    for job in jobs.values():
        job()
    results: dict[str, list[float]] = {name: [] for name in jobs}
    for _, _, name in in_turn(list(jobs), rounds):
        results[name].append(jobs[name]())
    return results


def seconds(work: Callable[[], object]) -> float:
    """Duration of one call, s."""
    begin = perf_counter_ns()
    work()
    return (perf_counter_ns() - begin) * 1e-9


def quickest(run: Callable[[], float], runs: int = RUNS) -> float:
    """The minimum of the results of ``runs`` calls of ``run``."""
    return min(run() for _ in range(runs))


def ratios(over: Sequence[float], under: Sequence[float]) -> list[float]:
    """over/under, turn by turn."""
    return [a / b for a, b in zip(over, under, strict=True)]


def spread(values: Sequence[float]) -> dict[str, Any]:
    """``median``, ``min``, ``max`` and the value of each of the ``turns``, for JSON: four digits
    after the point. At least one value."""
    turns = [round(value, 4) for value in values]
    middle = round(statistics.median(values), 4)
    return {"median": middle, "min": min(turns), "max": max(turns), "turns": turns}


def spread_text(values: Sequence[float], digits: int) -> str:
    """``median (min–max)`` with ``digits`` digits after the point."""
    middle, low, high = statistics.median(values), min(values), max(values)
    return f"{middle:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"
