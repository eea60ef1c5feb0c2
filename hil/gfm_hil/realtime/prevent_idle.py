"""Keeps a processor busy while a real-time loop sleeps on it between ticks.

An idle processor takes time to wake. A virtual machine gives an idle processor back to its host,
which may return it late, so that a loop misses more deadlines on an idle machine than on a busy
one. A thread of idle priority, which runs only when nothing else does, keeps the processor busy.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numba import types

from gfm_hil.realtime.atomics import load_acquire, pause
from gfm_hil.realtime.environment import virtual_machine
from gfm_runtime.compiled import compiled

_STOP, _RUNS, _PRIORITY, _FLAGS = range(4)  # _PRIORITY: a struct sched_param, 0
_OTHER, _IDLE = 0, 5  # SCHED_OTHER, SCHED_IDLE of sched.h on Linux
_BETWEEN_LOOKS = 1000  # pauses between two polls of the flag, some 20 µs
_PATIENCE_S = 1.0


#: sched_setscheduler(2) of the calling thread (0), a policy, and the address of its priority
_set_policy: Any = types.ExternalFunction(
    "sched_setscheduler", types.int32(types.int32, types.int32, types.int64)
)


@compiled
def _spin(flags):
    """Spin at idle priority until told to stop. It is compiled because a thread of idle priority
    that waits for the processor must not hold the interpreter's lock."""
    priority = flags.ctypes.data + 8 * _PRIORITY
    if _set_policy(0, _IDLE, priority) == 0:
        flags[_RUNS] = 1
        while load_acquire(flags.ctypes.data) == 0:  # _STOP
            for _ in range(_BETWEEN_LOOKS):
                pause()
        _set_policy(0, _OTHER, priority)


def warm_up() -> None:
    """Compile (or load from the cache) the loop of the thread without running it."""
    _spin.compile("void(int64[::1])")


@contextmanager
def prevent_idle(processor: int | None, wanted: str) -> Iterator[bool]:
    """Keep a processor busy within this context; yields whether a thread does so.

    Args:
        processor: its number, one that this thread may use; None: do nothing.
        wanted: ``prevent_idle`` of the scenario: "auto" (on a virtual machine), "always" or
            "never".
    """
    flags = np.zeros(_FLAGS, np.int64)
    if processor is None or not (
        wanted == "always" or (wanted == "auto" and virtual_machine() != "no")
    ):
        yield False
        return

    warm_up()  # compile before the thread starts: this thread waits for it

    def work() -> None:
        os.sched_setaffinity(0, {processor})  # of this thread
        _spin(flags)

    thread = threading.Thread(target=work, name="prevent-idle", daemon=True)
    thread.start()
    until = time.monotonic() + _PATIENCE_S
    while not flags[_RUNS] and thread.is_alive() and time.monotonic() < until:
        time.sleep(0.001)
    try:
        yield bool(flags[_RUNS])
    finally:
        flags[_STOP] = 1
        thread.join(_PATIENCE_S)
