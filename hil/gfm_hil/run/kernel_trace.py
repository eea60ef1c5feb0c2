"""What ran on a processor in place of a loop, from the kernel's own trace (tracefs).

The trace is read while it is written, so that a long one takes no memory: ``walk`` goes through the
pages of the kernel's ring buffer (include/linux/ring_buffer.h of Linux) and keeps only what took a
processor for a while.
"""

import os
import re
import subprocess
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from gfm_hil.run.processor_time import STOPPED, UNREAD, WAITS, ProcessorTime, collect
from gfm_runtime.compiled import cached, compiled

_PREFIX = "gfmhil-"  # of our instances, before the number of the process
_BUFFER_KB = 8192  # of the kernel, on each processor: more than a second of events
_PAGES = 256  # parsed at a time
_BETWEEN_S = 0.05  # reads
_SOFTIRQS = (
    "HI", "TIMER", "NET_TX", "NET_RX", "BLOCK", "IRQ_POLL", "TASKLET", "SCHED", "HRTIMER", "RCU",
)  # fmt: skip

# what an event means to ``walk``
_IGNORED, _SWITCH, _WAKING, _ENTRY, _EXIT = range(5)
# whose time it is; a number follows in the lower 32 bits
_THREAD, _IRQ, _SOFTIRQ, _VECTOR, _STOPPED, _WAITS, _UNREAD = range(1, 8)
# what the loop's thread does
_SLEEPS, _READY, _RUNNING, _HALTED, _BLOCKED = range(5)
# state of a processor from one page to the next: time of the last event; running thread and its
# name; whose time it is, since when, and the thread's name then; interrupts that are not over
_LAST, _RUNS, _RUNS_NAME, _LOOP, _WHO, _SINCE, _WHO_NAME, _DEPTH, _STACK = (
    0, 1, 2, 4, 5, 6, 7, 9, 10,
)  # fmt: skip
_DEEPEST = 8  # interrupts within interrupts
_HEAD = 16  # bytes of a page before its events
_COLUMNS = 5  # who, begin, end, 16 bytes of a thread's name

#: fields that ``walk`` reads: of which event, and how it is called there
_FIELDS = (
    ("sched/sched_switch", "prev_pid"), ("sched/sched_switch", "prev_state"),
    ("sched/sched_switch", "next_comm"), ("sched/sched_switch", "next_pid"),
    ("sched/sched_waking", "pid"),
)  # fmt: skip
_PREV_PID, _PREV_STATE, _NEXT_COMM, _NEXT_PID, _WAKING_PID = range(len(_FIELDS))


@cached
def walk(pages, kinds, numbers, fields, loop, least_ns, state, rows):
    """Go through pages of the ring buffer of a processor; returns how many rows it wrote.

    Args:
        pages: (n, words) of 4 bytes: time (two words), length in bytes (two words), events.
        kinds, numbers: by an event's number what it means, and of an interrupt which one it is.
        fields: where those of ``_FIELDS`` are, in words from an event's begin.
        loop: thread whose processor it is; -1: none, so that interrupts alone count.
        least_ns: what takes less is left out.
        state: of this processor; zeros at first.
        rows: (capacity, 5), written from the first on; see ``_COLUMNS``.
    """
    n = 0
    for p in range(len(pages)):
        page = pages[p]
        t = np.int64(page[0]) | np.int64(page[1]) << 32
        end = 4 + (np.int64(page[2]) & 0x3FFFFFFF) // 4
        if page[2] >> 31:  # the kernel overwrote events that nobody had read
            n = _until(t, np.int64(_UNREAD) << 32, least_ns, state, rows, n)
            state[_DEPTH], state[_LOOP] = 0, _SLEEPS
        i = np.int64(4)
        while i < end and i < len(page):
            length, delta, at = np.int64(page[i]) & 31, np.int64(page[i]) >> 5, i + 1
            if length == 29 and delta == 0:  # the rest is empty
                break
            if length == 29:
                i = at + np.int64(page[at]) // 4
                continue
            if length >= 30:  # more of the time's digits; with 31, all of them
                more = np.int64(page[at]) << 27 | delta
                t = t + more if length == 30 else more
                i += 2
                continue
            t += delta
            i = at + length
            if length == 0:  # a long event, whose length comes first
                i = at + (np.int64(page[at]) + 3) // 4
                at += 1
            number = np.int64(page[at]) & 0xFFFF
            if kinds[number] != _IGNORED:
                n = _until(t, _owner(state, loop), least_ns, state, rows, n)
                _from_now_on(page[at:], kinds[number], numbers[number], fields, loop, state)
    return n


@compiled
def _owner(state, loop):
    """Whose time it is; 0 if the loop runs, or has nothing to do."""
    depth, does = state[_DEPTH], state[_LOOP]
    if depth > 0:
        return state[_STACK + depth - 1]
    if does == _HALTED:
        return np.int64(_STOPPED) << 32
    if does == _BLOCKED:
        return np.int64(_WAITS) << 32
    if does == _READY and state[_RUNS] != loop and state[_RUNS] != 0:  # 0: idle
        return np.int64(_THREAD) << 32 | state[_RUNS]
    return np.int64(0)


@compiled
def _until(t, who, least_ns, state, rows, n):
    """Account for the time since the last event; returns the number of rows."""
    last = state[_LAST]
    if who != state[_WHO]:
        if state[_WHO] != 0 and last - state[_SINCE] >= least_ns and n < len(rows):
            rows[n, 0], rows[n, 1], rows[n, 2] = state[_WHO], state[_SINCE], last
            rows[n, 3], rows[n, 4] = state[_WHO_NAME], state[_WHO_NAME + 1]
            n += 1
        state[_WHO], state[_SINCE] = who, last
        for i in range(2):
            state[_WHO_NAME + i] = state[_RUNS_NAME + i]
    state[_LAST] = t
    return n


@compiled
def _from_now_on(event, kind, number, fields, loop, state):
    """What an event changes."""
    depth = state[_DEPTH]
    if kind == _SWITCH:
        if event[fields[_PREV_PID]] == loop:
            why = np.int64(event[fields[_PREV_STATE]])  # TASK_REPORT of include/linux/sched.h
            if why & 0xC:
                state[_LOOP] = _HALTED
            elif why & 2:
                state[_LOOP] = _BLOCKED
            else:
                state[_LOOP] = _SLEEPS if why & 0xFF else _READY
        state[_RUNS] = event[fields[_NEXT_PID]]
        if state[_RUNS] == loop:
            state[_LOOP] = _RUNNING
        name = fields[_NEXT_COMM]
        for i in range(2):
            low, high = np.int64(event[name + 2 * i]), np.int64(event[name + 2 * i + 1])
            state[_RUNS_NAME + i] = low | high << 32
    elif kind == _WAKING:
        if event[fields[_WAKING_PID]] == loop and state[_LOOP] != _RUNNING:
            state[_LOOP] = _READY
    elif kind == _ENTRY:
        if depth < _DEEPEST:
            which = np.int64(event[2]) if number >> 32 != _VECTOR else np.int64(0)
            state[_STACK + depth] = number | which
            state[_DEPTH] = depth + 1
    elif depth > 0:
        state[_DEPTH] = depth - 1


def tracefs() -> Path | str:
    """Where the kernel's trace is, or why there is none, in words."""
    for line in Path("/proc/mounts").read_text("utf-8").splitlines():
        place, kind = line.split()[1:3]
        if kind == "tracefs":
            if os.access(Path(place) / "instances", os.W_OK):
                return Path(place)
            return f"no right to write to {place}: run as root"
    return "tracefs is not mounted: mount -t tracefs nodev /sys/kernel/tracing"


# when the pipe ends; a process that dies may hold the files of its instance a while yet
_REMOVE = """read _; echo 0 > "$0/tracing_on"
for _ in 1 2 3 4 5 6 7 8 9; do rmdir "$0" 2>/dev/null && exit; sleep 0.2; done; rmdir "$0"
"""


class KernelTrace:
    """A trace of some processors, until ``stop``.

    Args:
        place: of tracefs.
        loops: by processor, the thread of a loop there; -1 for a processor without.
        least_ns: shorter times are left out.
    """

    def __init__(self, place: Path, loops: Mapping[int, int], least_ns: int) -> None:
        self._loops, self._least_ns = loops, least_ns
        _remove_stale(place / "instances")
        self._here = place / "instances" / f"{_PREFIX}{os.getpid()}-{time.monotonic_ns()}"
        self._here.mkdir()
        self._guard = subprocess.Popen(  # removes the instance, also after a kill of this process
            ["sh", "-c", _REMOVE, str(self._here)],
            stdin=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        self._vectors: list[str] = []
        self._kinds, self._numbers = np.zeros((2, 1 << 16), np.int64)
        self._set_up()
        size = int(re.findall(r"char data;.*size:(\d+)", self._read("events/header_page"))[0])
        self._pages = np.zeros((_PAGES, (size + _HEAD) // 4), np.uint32)
        self._rows = np.zeros((_PAGES * self._pages.shape[1] // 3, _COLUMNS), np.int64)
        self._states = {cpu: np.zeros(_STACK + _DEEPEST, np.int64) for cpu in loops}
        self._found: list[tuple[int, int, int, int, str]] = []
        self._files = {
            cpu: os.open(self._here / f"per_cpu/cpu{cpu}/trace_pipe_raw", os.O_NONBLOCK)
            for cpu in loops
        }
        self._end = threading.Event()
        self._take()  # compiles
        self._reader = threading.Thread(target=self._follow, daemon=True)
        self._write("tracing_on", "1")
        self._reader.start()

    def stop(self) -> ProcessorTime:
        """End the trace; returns what it shows."""
        self._write("tracing_on", "0")
        self._end.set()
        self._reader.join()
        for file in self._files.values():
            os.close(file)
        self._guard.communicate()
        return collect("trace", sorted(self._found, key=lambda row: row[1]))

    def _set_up(self) -> None:
        """Choose clock, processors and events, and learn the numbers of these."""
        self._write("tracing_on", "0")
        self._write("trace_clock", "mono")  # that of the loops
        self._write("tracing_cpumask", f"{sum(1 << cpu for cpu in self._loops):x}")
        self._write("buffer_size_kb", str(_BUFFER_KB))
        wanted = {
            "sched/sched_switch": (_SWITCH, 0), "sched/sched_waking": (_WAKING, 0),
            "irq/irq_handler_entry": (_ENTRY, _IRQ), "irq/irq_handler_exit": (_EXIT, 0),
            "irq/softirq_entry": (_ENTRY, _SOFTIRQ), "irq/softirq_exit": (_EXIT, 0),
        }  # fmt: skip
        # interrupts of x86 without a number of their own: the timer's, those from other processors
        for entry in sorted(self._here.glob("events/irq_vectors/*_entry")):
            name = entry.name.removesuffix("_entry")
            wanted[f"irq_vectors/{name}_entry"] = _ENTRY, _VECTOR
            wanted[f"irq_vectors/{name}_exit"] = _EXIT, 0
        self._fields = np.zeros(len(_FIELDS), np.int64)
        for event, (kind, whose) in wanted.items():
            form = self._read(f"events/{event}/format")
            number = int(re.findall(r"^ID: (\d+)", form, re.M)[0])
            self._kinds[number], self._numbers[number] = kind, whose << 32
            if whose == _VECTOR:
                self._numbers[number] |= len(self._vectors)
                self._vectors.append(event.split("/")[1].removesuffix("_entry"))
            for k, (of, field) in enumerate(_FIELDS):
                if of == event:
                    at = re.findall(rf"\b{field}(?:\[\d+\])?;\s*offset:(\d+)", form)[0]
                    self._fields[k] = int(at) // 4
            if kind == _WAKING:
                threads = " || ".join(f"pid == {loop}" for loop in self._loops.values())
                self._write(f"events/{event}/filter", threads)
            self._write(f"events/{event}/enable", "1")

    def _follow(self) -> None:
        with suppress(OSError):  # after the loops, before all that would keep it from reading
            if any(loop > 0 and os.sched_getscheduler(loop) for loop in self._loops.values()):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        while not self._end.wait(_BETWEEN_S):
            self._take()
        self._take()

    def _take(self) -> None:
        """Read what the kernel has written so far."""
        for cpu, file in self._files.items():
            full = _PAGES
            while full == _PAGES:
                full = 0
                with suppress(BlockingIOError):
                    while full < _PAGES and os.readv(file, [self._pages[full].data]):
                        full += 1
                n = walk(
                    self._pages[:full], self._kinds, self._numbers, self._fields, self._loops[cpu],
                    self._least_ns, self._states[cpu], self._rows,
                )  # fmt: skip
                for who, begin, end, *name in self._rows[:n].tolist():
                    named = self._name(who >> 32, who & 0xFFFFFFFF, np.array(name).tobytes())
                    self._found.append((cpu, begin, end, end - begin, named))

    def _name(self, kind: int, number: int, thread: bytes) -> str:
        if kind == _THREAD:
            return f"thread {thread.split(bytes(1))[0].decode('utf-8', 'replace')} ({number})"
        if kind == _IRQ:
            with suppress(OSError):
                actions = Path(f"/sys/kernel/irq/{number}/actions").read_text("utf-8").strip()
                return f"irq {number}, {actions}"
            return f"irq {number}"
        if kind == _SOFTIRQ:
            return f"softirq {_SOFTIRQS[number] if number < len(_SOFTIRQS) else number}"
        if kind == _VECTOR:
            return f"interrupt {self._vectors[number]}"
        return {_STOPPED: STOPPED, _UNREAD: UNREAD, _WAITS: WAITS}[kind]

    def _read(self, name: str) -> str:
        return (self._here / name).read_text("utf-8")

    def _write(self, name: str, text: str) -> None:
        (self._here / name).write_text(text, "utf-8")


def _remove_stale(instances: Path) -> None:
    """Remove the instances of processes that are gone."""
    for old in instances.glob(f"{_PREFIX}*"):
        number = old.name.removeprefix(_PREFIX).split("-")[0]
        if not Path(f"/proc/{number}").exists():
            with suppress(OSError):
                old.rmdir()
