"""The plant's ticks over a port: sample, send, take u, advance, until something is to be said.

The same rules as ``gfm_hil.engine.plant_side``, which does it in Python for links without a port.
"""

from __future__ import annotations

from gfm_hil.engine.loop_records import (
    BELL,
    DONE,
    GONE,
    LATE,
    LOOK,
    PEER_SAFE,
    PEER_STOPPED,
    RESTORE,
    RING,
    SILENT,
    STOP,
    STOPPED_HERE,
)
from gfm_hil.links.frame import INVALID, judge, pack, unpack
from gfm_hil.realtime.clock import (
    AHEAD_NS,
    between_looks,
    give_way,
    now_ns,
    sleep_until,
    wait_until,
)
from gfm_hil.recording.recorder import record_command, record_sample
from gfm_plant import plant_ahead, plant_go_on, plant_sample, plant_take
from gfm_plant.names import CONTROLLER, SAFE_STATE
from gfm_plant.names import SILENT as NOT_HEARD
from gfm_plant.protection import trip
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.signals import NU
from gfm_runtime.states import PLANT_TRIP, READY, SAFE, STOPPED

_U_ID = 2
FRESH, OVERDUE, LEAVING, CUT_OFF = range(4)
_UNRESTED, _REST_NS = 10, 50_000  # ticks; ns


@compiled
def plant_ticks(
    send, receive, patient, handle, spins, out, into, reader, loop, told, par, st, y, u, rows,
    times, progress, last,
):  # fmt: skip
    """Run ticks until ``last``; returns why it came back, one of ``gfm_hil.engine.loop_records``.

    Args:
        send, receive, patient, handle, spins: of the link's ``Port``.
        out: sequence, record and bytes of the frame to send; ``into``: record and bytes to
            receive into; see ``gfm_hil.links.frame``.
        reader: counters of what was received.
        loop: one-element array of ``loop_dtype``.
        told: shape (2,), int64, what other threads tell it, see ``gfm_hil.engine.loop_records``.
        par, st, y, u: the plant's records and the vectors of ``gfm_hil.engine.setup.Bench``.
        rows, times, progress: of the recording's part.
    """
    r = loop[0]
    sequence, frame, message = out
    got, got_bytes = into
    ahead = plant_ahead(par)
    # Then in lockstep the next frame leaves right after an answer, and one look at the clock does
    # for both. The processor goes nowhere until a look is done, so two took a tenth of the tick.
    hurried, unseen, why = ahead and not r.realtime, -1, DONE
    while r.tick < last:
        if told[STOP] != 0:
            why = STOPPED_HERE
            break
        if told[RING] != r.bell:
            r.bell = told[RING]
            why = BELL
            break
        k = reader[0].newest = r.tick
        due = r.t0 + k * r.T
        gap = 0
        if r.realtime:
            r.unrested = 0 if due - now_ns() > AHEAD_NS else r.unrested + 1
            gap = wait_until(due, spins)
            times[k, 0], times[k, 1] = due, now_ns()
        plant_sample(par, st, y)
        tripped = st[0].trip
        state, reason = (SAFE, PLANT_TRIP) if tripped != 0 else (0, 0)
        record_sample(rows[k], y, par, st)
        pack(sequence, frame, message, k, state, reason, y)
        send(handle, message)
        sent = now_ns()
        times[k, 2] = sent
        if r.realtime and spins == 0:
            give_way()  # to the link's own thread, before a look in vain
        if unseen >= 0:
            times[unseen, 3] = sent
            unseen = -1
        if ahead:  # u[k] does not act in this period: it can come meanwhile
            plant_go_on(par, st)
        if r.unrested > _UNRESTED:  # or the kernel would have the whole loop rest, for 50 ms
            sleep_until(sent + _REST_NS)
            r.unrested = 0
        until = due + r.T if r.realtime else sent + r.patience
        again = sent + (r.patience if r.realtime else r.repeat)
        while True:
            came, gap = _answer(
                receive, patient, handle, spins, got, got_bytes, reader, r, told, u, times, k,
                min(until, again), gap, hurried,
            )  # fmt: skip
            if came != OVERDUE or again >= until:
                break
            again = now_ns() + r.repeat
            r.repeats += 1
            pack(sequence, frame, message, k, state, reason, y)
            send(handle, message)
        if came == CUT_OFF:
            why = GONE
            break
        if came == FRESH:
            if hurried:
                unseen = k
            if r.extrapolate > 0:
                for j in range(NU):
                    r.u_before[j], r.u_last[j] = r.u_last[j], u[j]
        elif r.realtime and r.late < r.extrapolate:
            for j in range(NU):
                u[j] = r.u_last[j] + (r.late + 1) * (r.u_last[j] - r.u_before[j])
        record_command(rows[k], u)
        progress[0] = k + 1
        if reader[0].state == SAFE:
            if not r.waits:
                why = PEER_SAFE
                break
            trip(st[0], CONTROLLER, SAFE_STATE)
        if reader[0].state == STOPPED:
            why = PEER_STOPPED
            break
        if came != FRESH:
            if not r.realtime:
                why = SILENT if came == OVERDUE else STOPPED_HERE
                judge(reader, came == OVERDUE, True)
                break
            r.misses += 1
            progress[1] = r.misses
        r.late = 0 if came == FRESH else r.late + 1
        judge(reader, r.late > r.hold, tripped != 0)
        times[k, 4] = gap
        r.tick = k + 1
        if tripped != 0 and reader[0].state == READY and came == FRESH:
            why = RESTORE
            break
        plant_take(par, st, u)
        if not ahead:
            plant_go_on(par, st)
        if r.waits and reader[0].e2e == INVALID:
            trip(st[0], CONTROLLER, NOT_HEARD)
        if st[0].trip != tripped:
            why = LOOK
            break
        if r.late * r.T >= r.patience:
            judge(reader, True, True)
            why = SILENT
            break
        if reader[0].e2e == INVALID and not r.waits:
            why = LATE
            break
    if unseen >= 0:
        times[unseen, 3] = now_ns()
    return why


@inlined
def _answer(
    receive, patient, handle, spins, got, got_bytes, reader, r, told, u, times, k, until, gap,
    hurried,
):  # fmt: skip
    """Wait for u[k]: whether it is FRESH, OVERDUE or not awaited any more (LEAVING), and the
    longest gap between two looks at the clock. Whoever is hurried looks at the clock later."""
    before = times[k, 2]
    looks = 0
    while True:
        size = receive(handle, got_bytes)
        if size <= 0 and looks > r.looks and not r.realtime:
            size = patient(handle, got_bytes)
        if size > 0:
            tick = unpack(reader, _U_ID, got, got_bytes, size, u)
            # a controller that leaves says so under the last tick it saw
            leaves = reader[0].state >= reader[0].leaving
            if tick == k or leaves:
                if hurried:
                    return FRESH if tick == k else LEAVING, gap
                now = now_ns()
                if tick == k:
                    times[k, 3] = now
                return FRESH if tick == k else LEAVING, max(gap, now - before)
        elif size < 0:
            return CUT_OFF, gap
        looks += 1
        if looks % r.clock_every == 0 or looks > r.looks:
            now = now_ns()
            gap = max(gap, now - before)
            before = now
            if now >= until:
                return OVERDUE, gap
        if size <= 0:
            if not r.realtime and told[STOP] != 0:
                return LEAVING, gap
            between_looks(looks, spins)
