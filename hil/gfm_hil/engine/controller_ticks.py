"""The controller's ticks over a port: take y, compute, send u, until something is to be said.

The same rules as ``engine.controller_side``, which does it in Python for links without a port.
In real time it sleeps until shortly before the next frame, which a phase lock to the frames
received so far foretells: it needs no clock in common with the plant.
"""

from __future__ import annotations

from gfm_hil.engine.loop_records import (
    BELL,
    EVENT,
    GONE,
    LOOK,
    PEER_SAFE,
    PEER_STOPPED,
    RING,
    SILENT,
    STOP,
    STOPPED_HERE,
)
from gfm_hil.links.frame import judge, pack, unpack
from gfm_hil.realtime.clock import AHEAD_NS, between_looks, give_way, now_ns, sleep_until
from gfm_hil.recording.recorder import record_controller
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.controller import control, heed, missed
from gfm_runtime.states import SAFE, STOPPED

_Y_ID = 1
_LOOKED_NS = 20_000
_LEAK = 2e-4  # of a tick, in each: how much slower than ours the plant's clock may run
_EARLIER = 0.05  # of a tick


@compiled
def controller_ticks(
    send, receive, patient, handle, spins, out, into, reader, loop, told, ctl, laws, states, est,
    y, u, rows, times, progress, event,
):  # fmt: skip
    """Answer frames; returns why it came back, one of ``gfm_hil.engine.loop_records``.

    Comes back with EVENT when the next tick is ``event`` or later, after computing the one
    before; if frames were lost on the way there, with that tick's y in hand (``pending``).

    Args:
        send, receive, patient, handle, spins, out, into, reader, loop, told: as of
            ``plant_ticks``.
        ctl, laws, states, est: the controller's records.
        y, u: vectors of ``gfm_hil.engine.setup.Bench``.
        rows, times, progress: of the recording's part.
    """
    r = loop[0]
    sequence, frame, message = out
    sent = 0  # when the last answer left, in this call
    while True:
        if not r.pending:
            before = r.tick
            why = _next_frame(
                receive, patient, handle, spins, into, reader, r, told, ctl, y, times, sent
            )  # fmt: skip
            if why >= 0:
                return why
            if r.tick <= before:  # the plant asks again: our answer was lost
                r.tick = before
                pack(sequence, frame, message, before, ctl[0].state, ctl[0].reason, u)
                send(handle, message)
                continue
            if r.tick >= event:
                r.pending = 1
                return EVENT
        r.pending = 0
        k = r.tick
        changes = ctl[0].changes
        heed(ctl, reader[0].state == SAFE)
        control(ctl, laws, states, est, y, u)
        times[k, 2] = now_ns()
        pack(sequence, frame, message, k, ctl[0].state, ctl[0].reason, u)
        send(handle, message)
        times[k, 3] = sent = now_ns()
        if r.realtime and spins == 0:
            give_way()  # to the link's own thread: a sleep takes 9 µs before it leaves
        record_controller(rows[k], ctl, est)
        r.done += 1
        progress[0], progress[1] = k + 1, ctl[0].reason
        if ctl[0].state != r.seen or ctl[0].changes != changes:
            r.seen = ctl[0].state
            return LOOK
        if k + 1 >= event:
            return EVENT


@inlined
def _next_frame(
    receive, patient, handle, spins, into, reader, r, told, ctl, y, times, sent
):  # fmt: skip
    """Wait for a good frame of the plant: -1, its tick in ``r``; or why to come back.

    What the link's own thread took after the last answer was ``sent`` (0: there was none) is a
    gap between two looks like any other.
    """
    got, got_bytes = into
    judge(reader, False, ctl[0].state == SAFE)
    if told[RING] != r.bell:
        r.bell = told[RING]
        return BELL
    slept = False
    before = now_ns()
    gap = before - sent if r.realtime and sent > 0 else 0
    if r.realtime and r.done > 0 and told[STOP] == 0:
        wake = min(r.t0 + (r.tick + 1) * r.T + int(r.phase) - AHEAD_NS, before + r.T)
        if wake > before:
            sleep_until(wake)
            slept = True
            before = wake  # what it sleeps beyond that is a gap like any other
    awake = now_ns()
    looks = 0
    while True:
        size = receive(handle, got_bytes)
        looks += 1
        if size <= 0 and looks > r.looks and not r.realtime:
            size = patient(handle, got_bytes)
        if size < 0:
            return GONE
        if size > 0 or looks % r.clock_every == 0 or looks > r.looks:
            now = now_ns()
            gap = max(gap, now - before)
            before = now
            if size > 0:
                k = unpack(reader, _Y_ID, got, got_bytes, size, y)
                if k > r.tick:  # nothing else is a sign of life
                    r.heard = now
                if k >= 0:
                    break
            if now - r.heard >= r.patience:
                judge(reader, True, True)
                return SILENT
            if r.realtime and r.done > 0:  # before tick 0 nothing can be stale
                while ctl[0].stale < (now - r.heard) // r.T and ctl[0].state != SAFE:
                    missed(ctl)
                judge(reader, ctl[0].stale > ctl[0].hold, True)
                if ctl[0].state != r.seen:
                    r.seen = ctl[0].state
                    return LOOK
        if told[STOP] != 0:
            return STOPPED_HERE
        if told[RING] != r.bell:
            r.bell = told[RING]
            return BELL
        if size <= 0:
            between_looks(looks, spins)
    if reader[0].state == SAFE and not r.waits:
        return PEER_SAFE
    if reader[0].state == STOPPED:
        return PEER_STOPPED
    if r.realtime:
        _lock(r, k, now, now - awake > _LOOKED_NS, slept)
    if k > r.tick:
        times[k, 0] = r.t0 + k * r.T
        times[k, 1], times[k, 4] = now, gap
    r.tick = k
    return -1


@compiled
def _lock(r, k, now, seen, slept):
    """Learn from frame k when the next one will come.

    ``phase`` follows the earliest arrivals against k T: what is late was held up, and says nothing
    of the other side's clock. Only a frame that was awaited for some looks is ``seen`` to come:
    others may have been there, in a link's own thread that has to run first. One that was there
    after a sleep says that the sleep was too long.
    """
    away = float(now - r.t0 - k * r.T)
    if seen:
        r.phase = min(r.phase + _LEAK * r.T, away)
    elif slept:
        r.phase -= _EARLIER * r.T
