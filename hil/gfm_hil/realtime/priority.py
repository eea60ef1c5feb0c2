"""What a real-time side asks of the machine before it starts, and does without if refused."""

from __future__ import annotations

import ctypes
import gc
import os
from typing import Any

from gfm_hil.core.roles import Side

PRIORITY = 50  # of SCHED_FIFO: above what a desktop runs, below the kernel's own threads
_LOCK_NOW_AND_LATER = 1 | 2  # MCL_CURRENT | MCL_FUTURE of mlockall(2)


_before: set[int] = set()  # processors that this process might use before it chose one


def ask_for_real_time(side: Side) -> dict[str, Any]:
    """Ask for a processor, a real-time priority and memory that stays, for this thread.

    Threads that it starts later inherit processor and priority; so this comes before the link is
    opened. The loops sleep in every tick: the kernel throttles a SCHED_FIFO thread that only
    spins for 50 ms in each second.

    Returns:
        What was granted, for the log: ``policy`` ("fifo 50", "nice -20" or "as given"),
        ``processor`` (or None) and ``memory_locked``.
    """
    return {
        "policy": _fifo() or ordinary_priority(),
        "processor": own_processor(side),
        "memory_locked": _lock_memory(),
    }


def own_processor(side: Side) -> int | None:
    """The controller takes the last processor it may use, the plant the first.

    With a link's I/O thread beside its main thread a round trip does not wait for a migration.
    """
    if not hasattr(os, "sched_setaffinity"):
        return None
    allowed = sorted(os.sched_getaffinity(0))
    _before.update(allowed)
    mine = allowed[-1] if side == "controller" else allowed[0]
    os.sched_setaffinity(0, {mine})
    return mine


def _fifo() -> str:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        return ""
    return f"fifo {PRIORITY}"


def ordinary_priority() -> str:
    """The highest ordinary priority for this thread: for loops that do nothing but spin."""
    try:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    except (AttributeError, OSError):
        return "as given"
    return "nice -20"


def _lock_memory() -> bool:
    """Have every page stay where it is, so that no tick waits for one."""
    try:
        return bool(ctypes.CDLL(None).mlockall(_LOCK_NOW_AND_LATER) == 0)
    except (AttributeError, OSError):
        return False


def stand_back() -> None:
    """Give the calling thread ordinary priority on what processors it had: it only watches."""
    try:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if _before:
            os.sched_setaffinity(0, _before)
    except (AttributeError, OSError):
        return


def no_collector_pauses() -> None:
    """Collect once and switch the garbage collector off; a collection takes hundreds of ticks."""
    gc.collect()
    gc.freeze()
    gc.disable()
