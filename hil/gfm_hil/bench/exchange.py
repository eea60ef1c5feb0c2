"""The two sides of ``gfmhil bench latency --to``, compiled: y[k] goes out, u[k] comes back.

They speak the protocol of docs/own-controller.md, so that any controller can answer. That of
``gfmhil bench answer`` puts its clock into u: when it heard y[k], when it answers, and how far its
CLOCK_TAI may be off, in ns as integers; 0: its clock is CLOCK_MONOTONIC.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.one_way import ANSWERED, DUE, HEARD, RECEIVED, SENT
from gfm_hil.links.frame import DATA_IDS, MAGIC, FrameWriter, is_sealed, pack, record_dtype
from gfm_hil.realtime.clock import now_ns, sleep_until, spin_or_yield, wait_until, yield_processor
from gfm_runtime.compiled import cached
from gfm_runtime.signals import TABLE_VERSION, VectorName
from gfm_runtime.states import RUNNING, SAFE

_Y, _U = DATA_IDS["y"], DATA_IDS["u"]
#: why a side ends early: the other one is in SAFE or has left; the link is gone; no frame for long;
#: a message that is no frame, such as the greeting of another bench
LEFT, GONE, SILENT, OTHER = -2, -3, -4, -5
_LOOKS, _REST_NS, _IDLE_NS = 64, 100_000, 5_000_000  # of the answerer


class Frames(NamedTuple):
    """A frame to send or to receive: its sequence, and its memory as a record and as bytes."""

    sequence: NDArray[np.int64]
    record: np.ndarray
    message: NDArray[np.uint8]


def frames(group: VectorName, inner: bool = False, clocks: bool = False) -> Frames:
    """Memory for frames of a group; with ``clocks`` their values are integers."""
    writer = FrameWriter(group, inner)
    frame = writer.frame
    if clocks:
        fields = {name: record_dtype[name] for name in record_dtype.names or ()}
        fields["values"] = np.dtype(("<i8", record_dtype["values"].shape))
        frame = frame.view(np.dtype([*fields.items()]))
    return Frames(writer.sequence, frame, writer.message)


@cached
def tick_of(frame, message, size, data_id):
    """The tick of a frame that came; -1 if it is none, LEFT if it says that its sender leaves."""
    f = frame[0]
    if size != len(message) or not is_sealed(message):
        return -1
    if f.magic != MAGIC or f.version != TABLE_VERSION or f.data_id != data_id:
        return -1
    return LEFT if f.state >= SAFE else np.int64(f.tick)


@cached
def send_all(handle, send, receive, spins, y, u, values, period_ns, patience_ns, duration_ns,
             first, stamps):  # fmt: skip
    """Send y of the ticks from ``first`` on, and take what comes back; returns how many were sent,
    or LEFT or GONE.

    Args:
        handle, send, receive, spins: of the link's port.
        y, u: ``Frames``, that of u with ``clocks``.
        values: of y, p.u.
        period_ns: one y each period, counted from its deadline, whatever has come back; 0: the next
            one once u has come, or after ``patience_ns``.
        duration_ns: for how long to send.
        stamps: (most, 5), see ``gfm_hil.bench.one_way``.
    """
    sequence, frame, message = y
    begin = now_ns()
    end, due, n, got, polls = begin + duration_ns, begin + period_ns, 0, 0, 0
    until = begin
    while True:
        now = now_ns()
        sending = n < len(stamps) and now < end
        if not sending and (got == n or now >= until):
            return n
        if sending:
            pack(sequence, frame, message, first + n, 0, 0, values)
            if period_ns > 0:
                wait_until(due, spins)
            sent = now_ns()
            stamps[n, DUE], stamps[n, SENT], stamps[n, HEARD:] = sent, sent, -1
            if period_ns > 0:
                stamps[n, DUE] = due
                due += period_ns
            send(handle, message)
            n += 1
            if spins == 0:
                yield_processor()
            until = due if period_ns > 0 else sent + patience_ns
            if n == len(stamps) or until >= end:
                until = sent + patience_ns
        while now_ns() < until:
            size = receive(handle, u[2])
            if size > 0:
                now = now_ns()
                k = tick_of(u[1], u[2], size, _U)
                if k == LEFT:
                    return LEFT
                k -= first
                if 0 <= k < n and stamps[k, RECEIVED] < 0:
                    row = stamps[k]
                    row[RECEIVED] = now
                    row[HEARD], row[ANSWERED] = u[1][0].values[0], u[1][0].values[1]
                    got += 1
                polls = 0
                if stamps[n - 1, RECEIVED] >= 0 and (sending or got == n):
                    break
            elif size < 0:
                return GONE
            else:
                polls += 1
                spin_or_yield(polls, spins)
    return n


@cached
def answer_all(handle, send, receive, spins, y, u, clocks, tai_ns, silence_ns, stop):
    """Answer each y with our clock; returns LEFT, GONE, SILENT or OTHER, or 0 once told to stop.

    Args:
        handle, send, receive, spins, y, u: as of ``send_all``.
        clocks: integers, as many as u has values; the third one is set.
        tai_ns: CLOCK_TAI less CLOCK_MONOTONIC, 0 for the latter.
        silence_ns: after which to give up.
        stop: shape (1,), not 0: stop.
    """
    sequence, frame, message = u
    polls, last = 0, now_ns()
    while stop[0] == 0:
        size = receive(handle, y[2])
        if size > 0:
            last = now_ns()
            tick = tick_of(y[1], y[2], size, _Y)
            if tick >= 0:
                clocks[0], clocks[1] = last + tai_ns, now_ns() + tai_ns
                pack(sequence, frame, message, tick, RUNNING, 0, clocks)
                send(handle, message)
                if spins == 0:
                    yield_processor()
            elif tick == LEFT:
                return LEFT
            elif size != len(y[2]):
                return OTHER
            polls = 0
            continue
        if size < 0:
            return GONE
        polls += 1
        spin_or_yield(polls, spins)
        if polls % _LOOKS == 0:
            now = now_ns()
            if now - last > silence_ns:
                return SILENT
            if now - last > _IDLE_NS:  # between two rounds
                sleep_until(now + _REST_NS)
    return 0
