"""What /proc shows of who had the processors of real-time loops, where there is no kernel trace.

How long each loop's thread waited for its processor is exact, who had it meanwhile is who ran most
on it between two readings, of those who may run before the loop. /proc does not time interrupts.
"""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.run.processor_time import STOPPED, ProcessorTime, collect, nobody

_BETWEEN_S = 0.1  # readings
_LEAST_NS = 20_000  # of waiting between two readings
_TICK_NS = 10_000_000  # of /proc/stat, USER_HZ
# of sched.h: SCHED_IDLE runs after all others, SCHED_DEADLINE before
_RANKS = {5: -1, 6: 100}
# fields of /proc/PID/stat after the name, see proc_pid_stat(5)
_STATE, _PROCESSOR, _PRIORITY, _POLICY = 0, 36, 37, 38


class ProcWatch:
    """Reads /proc until ``stop``; arguments as of ``KernelTrace``, and why there is no trace."""

    def __init__(self, loops: Mapping[int, int], why: str) -> None:
        self._loops, self._why = loops, why
        self._found: list[tuple[int, int, int, int, str]] = []
        self._end = threading.Event()
        self._reader = threading.Thread(target=self._follow, daemon=True)
        self._reader.start()

    def stop(self) -> ProcessorTime:
        """End it; returns what it shows."""
        self._end.set()
        self._reader.join()
        return collect("proc", self._found, why=self._why)

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
                thread: ns - before.ran_ns[thread]
                for thread, ns in now.ran_ns.items()
                if now.at[thread] == cpu
                and thread in before.ran_ns
                and max(now.rank[thread], before.rank[thread]) >= now.rank.get(loop, 0)
            }
            if waited >= _LEAST_NS and any(ran.values()):
                most = max(ran, key=lambda thread: ran[thread])
                self._found.append((*span, min(waited, ran[most]), now.name[most]))


@dataclass(frozen=True)
class _Reading:
    """What /proc shows at a time: by processor, and by the number of a thread."""

    at_ns: int
    stolen_ns: Mapping[int, int]  # by the host, by processor
    waited_ns: Mapping[int, int]  # for its processor, by loop
    does: Mapping[int, str]  # state of each loop, a letter
    ran_ns: Mapping[int, int]  # of every other thread
    at: Mapping[int, int]  # the processor of each
    rank: Mapping[int, int]  # who may run before whom; of the loops, too
    name: Mapping[int, str]


def _tasks() -> Iterator[str]:
    for process in os.scandir("/proc"):
        if process.name.isdecimal():
            with suppress(OSError):
                yield from (task.path for task in os.scandir(f"{process.path}/task"))


def _text(path: str) -> str:
    """Of a small file; five times as quick as by pathlib, for there are hundreds."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, 4096).decode("utf-8", "replace")
    finally:
        os.close(file)


def _read(loops: Collection[int]) -> _Reading:
    stolen = {}
    for line in Path("/proc/stat").read_text("utf-8").splitlines():
        if found := re.match(r"cpu(\d+) (.*)", line):
            stolen[int(found[1])] = int(found[2].split()[7]) * _TICK_NS
    waited, does, ran, at, rank, named = {}, {}, {}, {}, {}, {}
    for task in _tasks():
        with suppress(OSError):  # it has ended
            name, values = _text(f"{task}/stat").split("(", 1)[1].rsplit(") ", 1)
            fields, times = values.split(), _text(f"{task}/schedstat").split()
            thread = int(task.rpartition("/")[2])
            rank[thread] = _RANKS.get(int(fields[_POLICY]), int(fields[_PRIORITY]))
            if thread in loops:
                waited[thread], does[thread] = int(times[1]), fields[_STATE]
            else:
                ran[thread], at[thread] = int(times[0]), int(fields[_PROCESSOR])
                named[thread] = f"thread {name} ({thread})"
    return _Reading(time.monotonic_ns(), stolen, waited, does, ran, at, rank, named)
