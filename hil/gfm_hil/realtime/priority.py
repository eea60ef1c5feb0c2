"""What a real-time side requests from the system at its start; if refused, it runs without."""

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gfm_hil.core.roles import Role

PRIORITY = 50  # of SCHED_FIFO: above desktop programs, below the kernel's threads
_LOCK_NOW_AND_LATER = 1 | 2  # MCL_CURRENT | MCL_FUTURE of mlockall(2)


_before: set[int] = set()  # processors that this process could use before it chose one


def ask_for_real_time(role: Role, place: int = 0, controllers: int = 1) -> dict[str, Any]:
    """Request a processor, a real-time priority and locked memory for this thread.

    Threads that it starts later inherit processor and priority, so call this before the link is
    opened. The loops sleep in every tick: the kernel throttles a SCHED_FIFO thread that only
    spins for 50 ms in each second.

    Args:
        place: of a controller, among the ``controllers`` of the same plant.

    Returns:
        What was granted, for the log: ``policy`` ("fifo 50", "nice -20" or "as given"),
        ``processor`` (or None), whether several controllers share it, and ``memory_locked``.
    """
    return {
        "policy": _fifo() or ordinary_priority(),
        **own_processor(role, place, controllers),
        "memory_locked": _lock_memory(),
    }


def own_processor(role: Role, place: int = 0, controllers: int = 1) -> dict[str, Any]:
    """The plant takes the first processor that it may use, the controllers the last ones, until
    they share; returns which one, and whether controllers share it.

    A link's I/O thread shares the processor, so that a round trip does not wait for a migration.
    """
    if not hasattr(os, "sched_setaffinity"):
        return {"processor": None, "shared": False}
    allowed = sorted(os.sched_getaffinity(0))
    _before.update(allowed)
    others = allowed[1:] or allowed
    mine = others[-1 - place % len(others)] if role == "controller" else allowed[0]
    os.sched_setaffinity(0, {mine})
    return {"processor": mine, "shared": role == "controller" and controllers > len(others)}


@contextmanager
def one_processor(mode: str = "lockstep") -> Iterator[None]:
    """Keep this thread in lockstep on one processor, and what it starts meanwhile.

    For a controller and its model's own threads and processes, of which one waits while the other
    works: to wake one on another processor takes longer (30 µs on a virtual machine) than to change
    from one to the other on the same. It is the same processor at each call; another process, as of
    a campaign, is likely to take another one.
    """
    if mode != "lockstep" or not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {sorted(allowed)[os.getpid() % len(allowed)]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _fifo() -> str:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError):
        return ""
    return f"fifo {PRIORITY}"


def leave_real_time() -> None:
    """Schedule this thread as any other one, whatever it inherited."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def ordinary_priority() -> str:
    """Give this thread the highest ordinary priority: for loops that only spin."""
    try:
        leave_real_time()
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    except (AttributeError, OSError):
        return "as given"
    return "nice -20"


def _lock_memory() -> bool:
    """Lock all pages in memory, so that no tick waits for a page fault."""
    try:
        return bool(ctypes.CDLL(None).mlockall(_LOCK_NOW_AND_LATER) == 0)
    except (AttributeError, OSError):
        return False


def restore_priority() -> None:
    """Give the calling thread, which only watches, ordinary priority on its former processors."""
    try:
        leave_real_time()
        if _before:
            os.sched_setaffinity(0, _before)
    except (AttributeError, OSError):
        return


def no_collector_pauses() -> None:
    """Collect once and switch the garbage collector off; a collection takes hundreds of ticks."""
    gc.collect()
    gc.freeze()
    gc.disable()
