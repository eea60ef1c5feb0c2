"""How late a loop begins its ticks: the clock and the scheduler alone, without other work.

Both processors pace at the same time, as the two sides of a run do. No link and no law can recover
the ticks lost here: they are the host's share of the misses.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from itertools import product
from typing import Any

import numpy as np

from gfm_hil.bench.attribution import Times, bursts
from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.cpu_load import cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.pair import Pair, pair
from gfm_hil.bench.rounds import REST, ShowProgress, in_turn
from gfm_hil.realtime.clock import now_ns, sleep_until, wait_until
from gfm_runtime.compiled import cached

HYBRID, SPIN, SLEEP = range(3)
WAITS = {"sleep+spin": HYBRID, "spin": SPIN, "nanosleep": SLEEP}
PERIOD_NS = 100_000
_LEAD_NS = 2_000_000  # between the call and the first deadline


@cached
def pace(first_ns, period_ns, how, late):
    """Fill ``late`` (ticks,) with the ns from each deadline to the loop's wake-up."""
    for k in range(len(late)):
        due = first_ns + k * period_ns
        if how == HYBRID:
            wait_until(due, 1)
        elif how == SLEEP:
            sleep_until(due)
        while now_ns() < due:
            pass
        late[k] = now_ns() - due


def pace_here(first_ns: int, period_ns: int, how: int, ticks: int) -> Times:
    """``pace`` in a process of the pair."""
    late = np.full(ticks, -1, np.int64)
    pace(first_ns, period_ns, how, late)
    return late


def pace_both(two: Pair, period_ns: int, how: int, seconds: float) -> Times:
    """Lateness on both processors at the same time, ns, shape (2, ticks)."""
    ticks = max(1, round(seconds * 1e9 / period_ns))
    first = time.monotonic_ns() + _LEAD_NS
    return np.stack(list(two.both(pace_here, first, period_ns, how, ticks).values()))


def lost(late: Times, allowed_ns: float) -> Times:
    """Ticks at which either of the two, (2, ticks), was later than allowed."""
    return np.flatnonzero((late > allowed_ns).any(axis=0))


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add a row per policy, load and way to wait to ``jitter``."""
    cells = list(product(options.policies, options.loads, WAITS))
    late = {cell: list[Times]() for cell in cells}
    with ExitStack() as stack:
        load_is = stack.enter_context(cpu_load())
        two = {p: stack.enter_context(pair(p, memory_folder(stack))) for p in options.policies}
        for each in two.values():
            each.both(pace_here, 0, 1, HYBRID, 1)  # compile before timing
        for _, share, cell in in_turn(cells, options.rounds, options.until):
            policy, load, wait = cell
            show(", ".join(cell), share)
            with load_is(load):
                times = pace_both(two[policy], PERIOD_NS, WAITS[wait], options.seconds)
            late[cell].append(times)
            time.sleep(REST * options.seconds)
    content["jitter"] = [_row(*cell, late[cell]) for cell in cells]


def _row(policy: str, load: str, wait: str, rounds: list[Times]) -> dict[str, Any]:
    ticks = sum(late.shape[1] for late in rounds)
    gone = [lost(late, PERIOD_NS) for late in rounds]
    count = sum(map(len, gone))
    return {
        "policy": policy, "load": load, "wait": wait, "period_us": PERIOD_NS / 1e3,
        **summary([late.ravel() for late in rounds]),
        "ticks": ticks, "lost": count, "lost_pct": round(100 * count / ticks, 4),
        "bursts": bursts(gone),
    }  # fmt: skip
