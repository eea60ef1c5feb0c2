"""Stopping: Ctrl-C and similar signals set a flag."""

from __future__ import annotations

import contextlib
import signal
from typing import Any


class Interrupt:
    """Context in which Ctrl-C, SIGTERM and a closed terminal only set ``came``.

    A second signal raises KeyboardInterrupt, so that a user need not wait for an orderly end; the
    first one does so if it is to act ``at_once``.
    """

    def __init__(self, at_once: bool = False) -> None:
        self.came, self._at_once = False, at_once
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
        if self.came or self._at_once:
            raise KeyboardInterrupt
        self.came = True

    def ask(self) -> None:
        """Request an orderly stop, as one signal does; from any thread."""
        self.came = True

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
