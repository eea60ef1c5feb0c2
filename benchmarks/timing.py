"""Timing that a noisy machine cannot fool easily: rivals take turns, and the median counts.

A turn is the quickest of a few short runs, since what else the machine does only adds time. A
ratio is taken turn by turn, between runs that follow each other at once, before its median is.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from time import perf_counter_ns
from typing import Any

from rich.console import Console
from rich.table import Table

RUNS = 20  # in a turn
WIDTH = 120  # columns


@dataclass(frozen=True)
class Spread:
    """Median, least and greatest of one measured quantity over all turns."""

    median: float
    min: float
    max: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        """The spread of at least one value."""
        return Spread(statistics.median(values), min(values), max(values))

    def text(self, digits: int) -> str:
        """``median (min–max)`` with so many digits after the point."""
        return f"{self.median:.{digits}f} ({self.min:.{digits}f}–{self.max:.{digits}f})"


def seconds(work: Callable[[], object]) -> float:
    """How long one call takes, in s."""
    begin = perf_counter_ns()
    work()
    return (perf_counter_ns() - begin) * 1e-9


def quickest(run: Callable[[], float]) -> float:
    """The least of what ``RUNS`` calls of ``run`` return."""
    return min(run() for _ in range(RUNS))


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


def ratio(over: Sequence[float], under: Sequence[float]) -> Spread:
    """The spread of over/under, turn by turn."""
    return Spread.of([a / b for a, b in zip(over, under, strict=True)])


def machine(*packages: str) -> dict[str, str]:
    """What the figures depend on, without naming a host."""
    found = {
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs",
        "python": platform.python_version(),
    }
    return found | {name: version(name) for name in ("numpy", "numba", *packages)}


def arguments(about: str, turns: int) -> argparse.ArgumentParser:
    """A parser with the options that every benchmark has."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--turns", type=int, default=turns, help="turns of each (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="hardly any work: only try it out")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser


def show(result: dict[str, Any], tables: Sequence[Table], as_json: bool) -> None:
    """Print a result: JSON, or tables and under them the remarks."""
    if as_json:
        print(json.dumps(result, indent=2, default=asdict))
        return
    console = Console()
    console.width = max(console.width, WIDTH)  # a table cut short is no use in a file
    for table in tables:
        console.print(table)
    for remark in result.get("remarks", ()):
        console.print(f"• {remark}", highlight=False)
    console.print(", ".join(f"{k} {v}" for k, v in result["machine"].items()), style="dim")
