"""Watches who has the processors of real-time loops, by the best method that there is here."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gfm_hil.core.roles import ROLES
from gfm_hil.recording.parts import RolePart
from gfm_hil.run.kernel_trace import KernelTrace, tracefs
from gfm_hil.run.proc_watch import ProcWatch
from gfm_hil.run.processor_time import ProcessorTime

LEAST_NS = 5_000  # shorter times make no tick late


class ProcessorWatch:
    """Watches processors from ``begin`` to the end of its context.

    Attributes:
        loops: by processor, the thread of the loop there; -1 for a processor without.
        taken: who had them; None before the end, and if nobody watched.
    """

    def __init__(self) -> None:
        self.loops: Mapping[int, int] = {}
        self.taken: ProcessorTime | None = None
        self._by: KernelTrace | ProcWatch | None = None

    def __enter__(self) -> ProcessorWatch:
        return self

    def begin(self, loops: Mapping[int, int], least_ns: int = LEAST_NS) -> None:
        """Begin to watch these; times of others that are shorter than ``least_ns`` are left out."""
        self.loops = loops
        if loops:
            self._by = _watch(loops, least_ns)

    def __exit__(self, *_: Any) -> None:
        if self._by is not None:
            self.taken = self._by.stop()


def _watch(loops: Mapping[int, int], least_ns: int) -> KernelTrace | ProcWatch:
    place = tracefs()
    if not isinstance(place, str):
        try:
            return KernelTrace(place, loops, least_ns)
        except OSError as problem:
            place = f"{place}: {problem.strerror}"
    return ProcWatch(loops, place)


def loops_of(folder: Path) -> dict[int, int]:
    """Processor and thread of each loop of a run in progress, of those that have one to
    themselves."""
    loops: dict[int, int] = {}
    for role in ROLES:
        part = RolePart.open(folder, role)
        with suppress(OSError):  # the thread has ended
            if part is not None and (thread := int(part.progress[2])):
                allowed = os.sched_getaffinity(thread)
                loops |= {cpu: thread for cpu in allowed if len(allowed) == 1}
    return loops
