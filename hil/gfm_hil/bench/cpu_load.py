"""CPU load for a benchmark: a process on each processor that never sleeps, of ordinary priority."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Literal

Load = Literal["idle", "busy"]
LOADS: tuple[Load, ...] = ("idle", "busy")

_COMPUTE = (
    "import os, signal, sys\n"
    "from gfm_runtime.children import end_with_parent\n"
    # a stopped process takes no other signal
    "end_with_parent(int(sys.argv[2]), signal.SIGKILL)\n"
    "os.sched_setaffinity(0, {int(sys.argv[1])})\n"
    "os.kill(os.getpid(), signal.SIGSTOP)\n"
    "while True:\n"
    "    pass\n"
)
_SETTLE_S = 0.02


@contextmanager
def cpu_load() -> Iterator[Callable[[Load], AbstractContextManager[None]]]:
    """Start the processes, stopped; yields a context in which they run if it is ``busy``."""
    started = [
        subprocess.Popen(  # own session: Ctrl-C is the parent's to handle
            [sys.executable, "-c", _COMPUTE, str(cpu), str(os.getpid())], start_new_session=True
        )
        for cpu in sorted(os.sched_getaffinity(0))
    ]

    def send(wanted: Load, number: signal.Signals) -> None:
        if wanted == "busy":
            for process in started:
                process.send_signal(number)
            time.sleep(_SETTLE_S)

    @contextmanager
    def load(wanted: Load) -> Iterator[None]:
        send(wanted, signal.SIGCONT)
        try:
            yield
        finally:
            send(wanted, signal.SIGSTOP)

    try:
        for process in started:  # each stops itself
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        yield load
    finally:
        for process in started:
            process.kill()
            process.wait()
