"""Stopping: Ctrl-C and similar signals set a flag; a process ends with its parent."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from typing import Any

_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)


class Interrupt:
    """Context in which Ctrl-C, SIGTERM and a closed terminal only set ``came``.

    A second signal raises KeyboardInterrupt, so that a user need not wait for an orderly end.
    """

    def __init__(self) -> None:
        self.came = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        with contextlib.suppress(ValueError):  # only the main thread can set handlers
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                before = signal.getsignal(number)
                if number == signal.SIGHUP and before == signal.SIG_IGN:
                    continue  # nohup has set it
                signal.signal(number, self._note)
                self._before[number] = before
        return self

    def _note(self, number: int, frame: Any) -> None:
        if self.came:
            raise KeyboardInterrupt
        self.came = True

    def ask(self) -> None:
        """Request an orderly stop, as one signal does; from any thread."""
        self.came = True

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)


def end_with_parent(parent: int | None = None, by: signal.Signals = signal.SIGTERM) -> None:
    """Have Linux send this process a signal when its parent is gone, even if it was killed.

    ``parent`` is its process id, to check whether it has already ended.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, by)
        if parent not in (None, os.getppid()):
            os.kill(os.getpid(), by)
