"""What a real-time side asks of the machine before it starts, and does without if refused."""

from __future__ import annotations

import gc
import os

from gfm_hil.links.base import Side


def own_processor(side: Side) -> None:
    """Keep this process, and the link's threads it will start, on one processor of its own.

    The controller takes the last processor it may use, the plant the first: with the link's I/O
    thread beside its main thread a round trip does not wait for a migration.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    allowed = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {allowed[-1] if side == "controller" else allowed[0]})


def go_first() -> bool:
    """Ask for the highest ordinary priority, for this process and the threads it will start.

    Not SCHED_FIFO: these loops spin, and the kernel throttles a spinning FIFO process for 50 ms
    in each second. False where the rights are missing; other work then competes on equal terms.
    """
    try:
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    except (AttributeError, OSError):
        return False
    return True


def no_collector_pauses() -> None:
    """Collect once and switch the garbage collector off; a collection takes hundreds of ticks."""
    gc.collect()
    gc.freeze()
    gc.disable()
