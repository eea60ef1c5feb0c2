"""How late a loop begins its ticks: the clock and the scheduler alone, without other work.

Both processors pace at the same time, as the two sides of a run do. No link and no law can recover
the ticks lost here: they are the host's share of the misses.
"""

import os
import statistics
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from gfm_hil.bench import outside
from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.cpu_load import Load, cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.pair import Pair, Policy, pair
from gfm_hil.bench.pingpong import HYBRID, SLEEP, SPIN, wait_for
from gfm_hil.bench.rounds import REST, ShowProgress, in_turn
from gfm_hil.bench.tail import median_interval
from gfm_hil.realtime.clock import AHEAD_NS, now_ns
from gfm_hil.run.attribution import Times, bursts
from gfm_hil.run.stalls import ProcessorWatch
from gfm_runtime.compiled import cached

#: the kernel's trace itself costs microseconds a wake-up, so it has a row of its own
WATCHED = "sleep+spin, watched"
#: ``nanosleep`` last: the programs of others follow it, and are compared with it
WAITS = {"sleep+spin": HYBRID, "spin": SPIN, WATCHED: HYBRID, "nanosleep": SLEEP}
PERIOD_NS = 100_000
_LEAD_NS = 2_000_000  # between the call and the first deadline


@cached
def pace(first_ns, period_ns, how, late):
    """Fill ``late`` (ticks,) with the ns from each deadline to the loop's wake-up."""
    for k in range(len(late)):
        due = first_ns + k * period_ns
        wait_for(due, 1, how)
        late[k] = now_ns() - due


def pace_here(first_ns: int, period_ns: int, how: int, ticks: int) -> Times:
    """``pace`` in a process of the pair."""
    late = np.full(ticks, -1, np.int64)
    pace(first_ns, period_ns, how, late)
    return late


def pace_both(two: Pair, period_ns: int, how: int, seconds: float, first_ns: int = 0) -> Times:
    """Lateness on both processors at the same time, ns, shape (2, ticks); the first tick is soon,
    or at ``first_ns``."""
    ticks = max(1, round(seconds * 1e9 / period_ns))
    first = first_ns or time.monotonic_ns() + _LEAD_NS
    return np.stack(list(two.both(pace_here, first, period_ns, how, ticks).values()))


def loop_here() -> tuple[int, int]:
    """Processor and thread of a process of the pair."""
    return min(os.sched_getaffinity(0)), threading.get_native_id()


def lost(late: Times, allowed_ns: float) -> Times:
    """Ticks at which either of the two, (2, ticks), was later than allowed."""
    return np.flatnonzero((late > allowed_ns).any(axis=0))


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add a row per policy, load and way to wait to ``jitter``, and one per program of others."""
    absent = {name: why for name in outside.PROGRAMS if (why := outside.missing(name))}
    others = [name for name in outside.PROGRAMS if name not in absent]
    cells = list(product(options.policies, options.loads, [*WAITS, *others]))
    rows = {cell: _Late() for cell in cells}
    with ExitStack() as stack:
        load_is = stack.enter_context(cpu_load())
        two = {p: stack.enter_context(pair(p, memory_folder(stack))) for p in options.policies}
        loops = {p: dict(each.both(loop_here).values()) for p, each in two.items()}
        for each in two.values():
            each.both(pace_here, 0, 1, HYBRID, 1)  # compile before timing
        for _, share, cell in in_turn(cells, options.rounds, options.until):
            policy, load, wait = cell
            seconds = options.seconds
            show(", ".join(cell), share)
            with load_is(load), ProcessorWatch() as watch:
                if wait == WATCHED:
                    watch.begin(loops[policy])
                first = time.monotonic_ns() + _LEAD_NS
                if wait in others:
                    late = outside.measure(wait, loops[policy], policy, PERIOD_NS, seconds)[None]
                else:
                    late = pace_both(two[policy], PERIOD_NS, WAITS[wait], seconds, first)
            rows[cell].add(first, late, watch)
            time.sleep(REST * seconds)
    content["jitter"] = [_row(*cell, rows) for cell in cells]
    content["remarks"] += absent.values()


@dataclass
class _Late:
    """Lateness by round, (2, ticks) or of others (1, times), ns; who took the ticks that were
    lost, and how it is known."""

    rounds: list[Times] = field(default_factory=list)
    names: Counter[str] = field(default_factory=Counter)
    method: str | None = None

    def add(self, first_ns: int, late: Times, watch: ProcessorWatch) -> None:
        """Take a round in, whose first tick was due at ``first_ns``."""
        self.rounds.append(late)
        if watch.taken is None:
            return
        self.method = watch.taken.method
        for cpu, each in zip(watch.loops, late, strict=True):
            gone = np.flatnonzero(each > PERIOD_NS)
            starts = np.flatnonzero(np.diff(gone, prepend=-2) != 1)
            for some in np.split(gone, starts[1:]) if len(gone) else ():
                due, ns = first_ns + PERIOD_NS * int(some[0]), int(each[some[0]])
                self.names[watch.taken.who(due - AHEAD_NS, due + ns, ns, [cpu])] += len(some)


def _row(
    policy: Policy, load: Load, wait: str, every: Mapping[tuple[Policy, Load, str], _Late]
) -> dict[str, Any]:
    late = every[policy, load, wait]
    ours = wait in WAITS
    ticks = sum(each.shape[1] for each in late.rounds)
    gone = [lost(each, PERIOD_NS) for each in late.rounds] if ours else []
    count = sum(map(len, gone))
    return {
        "policy": policy, "load": load, "wait": wait, "period_us": PERIOD_NS / 1e3,
        **summary([each.ravel() for each in late.rounds]),
        "ticks": ticks, "lost": count if ours else None,
        "lost_pct": round(100 * count / ticks, 4) if ours and ticks else None,
        "bursts": bursts(gone), "names": dict(late.names.most_common()), "method": late.method,
        "to_ours": None if ours else _ratios(late, every[policy, load, "nanosleep"]),
    }  # fmt: skip


def _ratios(other: _Late, ours: _Late) -> dict[str, list[float]]:
    """p50 and p99 of another program to those of our ``nanosleep``: of the ratios of the rounds the
    median, and the interval in which that lies with 95 %.

    The others skip each deadline that passed while they were late, so a stall of ten periods is one
    of their times. Ours here are those of the same deadlines.
    """
    pairs = [(a, at_awaited(b)) for a, b in zip(other.rounds, ours.rounds, strict=False) if a.size]
    of_rounds = [np.percentile(a, (50, 99)) / np.percentile(b, (50, 99)) for a, b in pairs]
    return {
        name: [round(x, 3) for x in (statistics.median(each), *median_interval(each))]
        for name, each in zip(("p50", "p99"), np.transpose(of_rounds).tolist(), strict=False)
    }


def at_awaited(late: Times) -> Times:
    """The lateness, of (2, ticks) in ns, at deadlines that were still to come when the loop woke
    for the tick before."""
    waited = np.ones(late.shape, bool)
    waited[:, 1:] = late[:, :-1] <= PERIOD_NS
    return late[waited]
