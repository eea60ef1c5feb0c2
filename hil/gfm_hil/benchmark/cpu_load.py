"""Load on the machine: one busy process per processor, at ordinary priority."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Literal

Load = Literal["idle", "hogs"]
LOADS: tuple[Load, ...] = ("idle", "hogs")

_HOG = (
    "import os, sys\n"
    "from gfm_hil.core.stopping import end_with_parent\n"
    "end_with_parent(int(sys.argv[2]))\n"
    "os.sched_setaffinity(0, {int(sys.argv[1])})\n"
    "while True:\n"
    "    pass\n"
)
_SETTLE_S = 0.02


@contextmanager
def hogs() -> Iterator[Callable[[Load], AbstractContextManager[None]]]:
    """Start them, stopped; yields a context that runs them for ``hogs`` and not for ``idle``."""
    started = [
        subprocess.Popen(  # own session: only the parent handles Ctrl-C
            [sys.executable, "-c", _HOG, str(cpu), str(os.getpid())], start_new_session=True
        )
        for cpu in sorted(os.sched_getaffinity(0))
    ]

    def send(number: signal.Signals) -> None:
        for process in started:
            process.send_signal(number)
        time.sleep(_SETTLE_S)

    @contextmanager
    def load(wanted: Load) -> Iterator[None]:
        if wanted == "idle":
            yield
            return
        send(signal.SIGCONT)
        try:
            yield
        finally:
            send(signal.SIGSTOP)

    try:
        time.sleep(0.3)
        send(signal.SIGSTOP)
        yield load
    finally:
        for process in started:
            process.kill()
            process.wait()
