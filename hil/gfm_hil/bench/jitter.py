"""How late a loop begins its ticks: the clock and the scheduler alone, without other work.

Both processors pace at the same time, as the two sides of a run do. No link and no law can recover
the ticks lost here: they are the host's share of the misses.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.attribution import bursts
from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.cpu_load import Load, cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.pair import Pair, Policy, pair
from gfm_hil.bench.rounds import REST, Plan, rounds
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


def pace_here(first_ns: int, period_ns: int, how: int, ticks: int) -> NDArray[np.int64]:
    """``pace`` in a process of the pair."""
    late = np.full(ticks, -1, np.int64)
    pace(first_ns, period_ns, how, late)
    return late


def pace_both(two: Pair, period_ns: int, how: int, seconds: float) -> NDArray[np.int64]:
    """Lateness on both processors at the same time, ns, shape (2, ticks)."""
    ticks = max(1, round(seconds * 1e9 / period_ns))
    first = time.monotonic_ns() + _LEAD_NS
    return np.stack(list(two.both(pace_here, first, period_ns, how, ticks).values()))


def lost(late: NDArray[np.int64], allowed_ns: float) -> NDArray[np.int64]:
    """Ticks at which either of the two, (2, ticks), was later than allowed."""
    return np.flatnonzero((late > allowed_ns).any(axis=0))


def measure(plan: Plan, tell: Callable[[str, float], None]) -> list[dict[str, Any]]:
    """Measure; returns one row per way to wait, load and policy."""
    cells: dict[tuple[Policy, Load, str], list[NDArray[np.int64]]] = {
        (policy, load, wait): []
        for policy in plan.policies for load in plan.loads for wait in WAITS
    }  # fmt: skip
    with ExitStack() as stack:
        load_is = stack.enter_context(cpu_load())
        two = {
            policy: stack.enter_context(pair(policy, memory_folder(stack)))
            for policy in plan.policies
        }
        for each in two.values():
            each.both(pace_here, 0, 1, HYBRID, 1)  # compile before timing
        for number in rounds(plan.rounds, plan.until):
            for n, (policy, load, wait) in enumerate(list(cells)[:: -1 if number % 2 else 1]):
                tell(f"{policy}, {load}, {wait}", (number + n / len(cells)) / plan.rounds)
                with load_is(load):
                    late = pace_both(two[policy], PERIOD_NS, WAITS[wait], plan.seconds)
                cells[policy, load, wait].append(late)
                time.sleep(REST * plan.seconds)
    return [
        {"policy": policy, "load": load, "wait": wait, "period_us": PERIOD_NS / 1e3}
        | summary([late.ravel() for late in found])
        | _lost(found, PERIOD_NS)
        for (policy, load, wait), found in cells.items()
    ]


def _lost(found: list[NDArray[np.int64]], period_ns: int) -> dict[str, Any]:
    ticks = sum(late.shape[1] for late in found)
    gone = [lost(late, period_ns) for late in found]
    lengths = Counter[int]()
    for some in gone:
        lengths.update(bursts(some))
    return {
        "ticks": ticks,
        "lost": sum(map(len, gone)),
        "lost_pct": round(100 * sum(map(len, gone)) / ticks, 4),
        "bursts": sorted(lengths.items()),
    }
