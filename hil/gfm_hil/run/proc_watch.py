"""What /proc shows of who had the processors of real-time loops, where there is no kernel trace.

How long each loop's thread waited for its processor is exact, who had it meanwhile is who ran most
on it between two readings. /proc does not time interrupts.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.run.taken import STOPPED, Taken, collected, nobody

_BETWEEN_S = 0.1  # readings
_LEAST_NS = 20_000  # of waiting between two readings
_TICK_NS = 10_000_000  # of /proc/stat, USER_HZ
_IDLE_CLASS = 5  # SCHED_IDLE of sched.h
# fields of /proc/PID/stat after the name, see proc_pid_stat(5)
_STATE, _PROCESSOR, _POLICY = 0, 36, 38


class ProcWatch:
    """Reads /proc until ``stop``; arguments as of ``KernelTrace``, and why there is no trace."""

    def __init__(self, loops: Mapping[int, int], why: str) -> None:
        self._loops, self._why = loops, why
        self._found: list[tuple[int, int, int, int, str]] = []
        self._end = threading.Event()
        self._reader = threading.Thread(target=self._follow, daemon=True)
        self._reader.start()

    def stop(self) -> Taken:
        """End it; returns what it shows."""
        self._end.set()
        self._reader.join()
        return collected("proc", self._found, why=self._why)

    def _follow(self) -> None:
        loops = set(self._loops.values())
        before, going = _read(loops), True
        while going:
            going = not self._end.wait(_BETWEEN_S)
            now = _read(loops)
            self._compare(before, now)
            before = now

    def _compare(self, before: _Reading, now: _Reading) -> None:
        """Account for what the loops waited between two readings."""
        for cpu, loop in self._loops.items():
            span = cpu, before.at_ns, now.at_ns
            if "T" in (before.does.get(loop), now.does.get(loop)):
                self._found.append((*span, now.at_ns - before.at_ns, STOPPED))
            stolen = now.stolen_ns[cpu] - before.stolen_ns[cpu]
            if stolen:
                self._found.append((*span, stolen, nobody("trace")))
            waited = now.waited_ns.get(loop, 0) - before.waited_ns.get(loop, 0)
            ran = {
                name: ns - before.ran_ns[name]
                for name, ns in now.ran_ns.items()
                if name[0] == cpu and name in before.ran_ns
            }
            if waited >= _LEAST_NS and any(ran.values()):
                most = max(ran, key=lambda name: ran[name])
                self._found.append((*span, min(waited, ran[most]), most[1]))


@dataclass(frozen=True)
class _Reading:
    """What /proc shows at a time: by processor, and by thread."""

    at_ns: int
    stolen_ns: Mapping[int, int]  # by the host, by processor
    waited_ns: Mapping[int, int]  # for its processor, by loop
    does: Mapping[int, str]  # state of each loop, a letter
    ran_ns: Mapping[tuple[int, str], int]  # by processor and name of every other thread


def _read(loops: Collection[int]) -> _Reading:
    stolen = {}
    for line in Path("/proc/stat").read_text("utf-8").splitlines():
        if found := re.match(r"cpu(\d+) (.*)", line):
            stolen[int(found[1])] = int(found[2].split()[7]) * _TICK_NS
    waited, does, ran = {}, {}, {}
    for task in Path("/proc").glob("[0-9]*/task/[0-9]*"):
        with suppress(OSError):  # it has ended
            name, values = (
                (task / "stat").read_text("utf-8", "replace").split("(", 1)[1].rsplit(") ", 1)
            )
            fields, times = values.split(), (task / "schedstat").read_text("utf-8").split()
            thread = int(task.name)
            if thread in loops:
                waited[thread], does[thread] = int(times[1]), fields[_STATE]
            elif int(fields[_POLICY]) != _IDLE_CLASS:
                ran[int(fields[_PROCESSOR]), f"thread {name} ({thread})"] = int(times[0])
    return _Reading(time.monotonic_ns(), stolen, waited, does, ran)
