"""What a real-time side asks of the machine, and what it does without rights that it lacks."""

from __future__ import annotations

import gc
import os
import time

from gfm_hil.links.base import Side

_PRIORITY = 50  # SCHED_FIFO, in the middle: above the machine's services, below the kernel's own
_NEAR_NS = 25_000  # sleep to this before a deadline, then spin: a wake-up takes up to 15 us


def own_processor(side: Side) -> None:
    """Keep this process, and the link's threads it will start, on one processor of its own.

    The controller takes the last processor it may use, the plant the first: with the link's I/O
    thread beside its main thread a round trip does not wait for a migration.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    allowed = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {allowed[-1] if side == "controller" else allowed[0]})


def no_collector_pauses() -> None:
    """Collect once and switch the garbage collector off; a collection takes hundreds of ticks."""
    gc.collect()
    gc.freeze()
    gc.disable()


def take_priority() -> bool:
    """SCHED_FIFO for this process and the link's threads it will start; False without the rights.

    A FIFO process that never sleeps is throttled by the kernel for 50 ms in each second, so the
    loops sleep whenever nothing is due (``sleep_until``).
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (AttributeError, OSError):
        return False
    return True


def sleep_until(moment_ns: int) -> None:
    """Sleep until shortly before a moment on CLOCK_MONOTONIC; the caller spins the rest.

    Only for a process with priority: the others' sleeps end up to 50 us late by design.
    """
    left = moment_ns - _NEAR_NS - time.monotonic_ns()
    if left > 0:
        time.sleep(left * 1e-9)
