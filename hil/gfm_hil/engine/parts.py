"""The parts of a plant that lines of travelling waves cut, a thread each.

The ends of the lines wait for each other after each tick, see `gfm_plant.parted`. Now and then all
threads meet, and one of them asks whether to go on, so that all end with the same tick.
"""

from __future__ import annotations

import contextvars
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from gfm_plant import Network
from gfm_plant.parted import leave, spin

_SPINS = 2000  # looks at the other end of a line before the first yield


def run_threads(
    parts: Sequence[Network],
    cores: int,
    run: Callable[[int, Callable[[int], bool]], int],
    meets: Callable[[int], bool],
    ask: Callable[[int], bool],
) -> int:
    """Have a thread ``run`` each part of a plant; returns the ticks done.

    Args:
        parts: the plants of the parts.
        cores: processor cores that they share.
        run: gets the index of a part, and a function that says after some ticks, among them those
            at which the threads meet, whether to go on.
        meets: whether they meet after so many ticks.
        ask: says there whether to go on.
    """
    allowed = sorted(os.sched_getaffinity(0))[:cores]
    going, done = True, 0

    def decide() -> None:
        nonlocal going
        going = ask(done)

    meeting = threading.Barrier(len(parts), decide)

    def go_on(k: int) -> bool:
        nonlocal done
        if not meets(k):
            return True
        done = k
        meeting.wait()
        return going

    def work(p: int) -> int:
        os.sched_setaffinity(0, {allowed[p % len(allowed)]})  # of this thread
        try:
            return run(p, go_on)
        except BaseException:
            meeting.abort()
            raise
        finally:
            leave(parts[p])

    for part in parts:
        spin(part, _SPINS if len(allowed) >= len(parts) else 0)
    with ThreadPoolExecutor(len(parts), "part") as pool:
        every = [pool.submit(contextvars.copy_context().run, work, p) for p in range(len(parts))]
    # the cause first: the others find the barrier broken
    failed = [problem for one in every if (problem := one.exception()) is not None]
    for problem in sorted(failed, key=lambda one: isinstance(one, threading.BrokenBarrierError)):
        raise problem
    return every[0].result()
