"""The plant's ticks over a link: sample, send, wait for u, advance, until Python has to act.

Lockstep: the plant waits for u[k], and sends y[k] again if nothing comes. Real time: the plant
samples tick k at its deadline t_0 + k T_s on CLOCK_MONOTONIC, and u[k] has until the next deadline.
A u[k] that is not there by then is a miss: the plant holds the last u, and after
``late_policy.hold`` misses in a row it blocks.
"""

from __future__ import annotations

from gfm_hil.engine.loop_records import STOP, WAKE, Why
from gfm_hil.engine.tick import obey, sample, take
from gfm_hil.links.frame import INVALID, judge, pack, pack_again, unpack
from gfm_hil.realtime.clock import (
    AHEAD_NS,
    between_looks,
    give_way,
    now_ns,
    sleep_until,
    wait_until,
)
from gfm_hil.recording.recorder import record_command
from gfm_plant import plant_is_delayed, plant_step
from gfm_plant.names import CONTROLLER
from gfm_plant.names import SILENT as NOT_HEARD
from gfm_plant.protection import trip
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.states import PLANT_TRIP, SAFE

_U_ID = 2
FRESH, OVERDUE, LEAVING, CUT_OFF = range(4)
_UNRESTED, _REST_NS = 10, 50_000  # ticks; ns


@compiled
def plant_ticks(end, records, plant, last):
    """Run ticks until ``last``; returns why it came back, a ``Why``.

    Args:
        end: ``gfm_hil.engine.loop_records.LinkEnd``.
        records: ``Records`` from there.
        plant: ``gfm_plant.PlantRecords`` of one converter.
        last: the tick before which it stops.
    """
    loop, flags, y, u, rows, times, progress = records
    st = plant.st
    reader, r = end.reader, loop[0]
    sequence, frame, message = end.out
    delayed = plant_is_delayed(plant)
    # In lockstep a delayed plant sends its next frame right after an answer, so one reading of the
    # clock serves both. A reading stalls the processor: two of them took a tenth of the tick.
    hurried, unseen, why = delayed and not r.realtime, -1, Why.DONE
    while r.tick < last:
        if flags[STOP] != 0:
            why = Why.STOPPED_HERE
            break
        if flags[WAKE] != r.woken:
            r.woken = flags[WAKE]
            why = Why.WOKEN
            break
        k = reader[0].newest = r.tick
        due = r.t0 + k * r.T
        gap = 0
        if r.realtime:
            r.unrested = 0 if due - now_ns() > AHEAD_NS else r.unrested + 1
            gap = wait_until(due, end.spins)
            times[k, 0], times[k, 1] = due, now_ns()
        tripped = sample(plant, 0, y, rows[k])
        state, reason = (SAFE, PLANT_TRIP) if tripped != 0 else (0, 0)
        pack(sequence, frame, message, k, state, reason, y)
        end.send(end.handle, message)
        sent = now_ns()
        times[k, 2] = sent
        if r.realtime and end.spins == 0:
            give_way()  # to the link's own thread, before the first look
        if unseen >= 0:
            times[unseen, 3] = sent
            unseen = -1
        if delayed:  # u[k] does not act in this period: it can come meanwhile
            plant_step(plant)
        if r.unrested > _UNRESTED:  # else the kernel throttles the whole loop for 50 ms
            sleep_until(sent + _REST_NS)
            r.unrested = 0
        until = due + r.T if r.realtime else sent + r.patience
        again = sent + (r.patience if r.realtime else r.repeat)
        while True:
            came, gap = _answer(end, r, flags, u, times, k, min(until, again), gap, hurried)
            if came != OVERDUE or again >= until:
                break
            again = now_ns() + r.repeat
            r.repeats += 1
            pack_again(sequence, frame, message)
            end.send(end.handle, message)
        if came == CUT_OFF:
            why = Why.GONE
            break
        if came == FRESH:
            if hurried:
                unseen = k
            if r.extrapolate > 0:
                for j in range(len(u)):
                    r.u_before[j], r.u_last[j] = r.u_last[j], u[j]
        elif r.realtime and r.late < r.extrapolate:
            for j in range(len(u)):
                u[j] = r.u_last[j] + (r.late + 1) * (r.u_last[j] - r.u_before[j])
        record_command(rows[k], u)
        progress[0] = k + 1
        why = obey(plant, 0, r.waits, reader[0].state)
        if why != Why.GO_ON:
            break
        if came != FRESH:
            if not r.realtime:
                why = Why.SILENT if came == OVERDUE else Why.STOPPED_HERE
                judge(reader, came == OVERDUE, True)
                break
            r.misses += 1
            progress[1] = r.misses
        r.late = 0 if came == FRESH else r.late + 1
        judge(reader, r.late > r.hold, tripped != 0)
        times[k, 4] = gap
        r.tick = k + 1
        why = take(plant, 0, u, tripped, reader[0].state, came == FRESH)
        if why != Why.GO_ON:
            break
        if not delayed:
            plant_step(plant)
        if r.waits and reader[0].e2e == INVALID:
            trip(plant, 0, CONTROLLER, NOT_HEARD)
        if st[0].trip != tripped:
            why = Why.CHANGED
            break
        if r.late * r.T >= r.patience:
            judge(reader, True, True)
            why = Why.SILENT
            break
        if reader[0].e2e == INVALID and not r.waits:
            why = Why.LATE
            break
        why = Why.DONE
    if unseen >= 0:
        times[unseen, 3] = now_ns()
    return why


@inlined
def _answer(end, r, flags, u, times, k, until, gap, hurried):
    """Wait for u[k]: whether it is FRESH, OVERDUE or no longer awaited (LEAVING), and the longest
    gap between two looks at the clock. A ``hurried`` loop looks at the clock later."""
    got, got_bytes = end.into
    reader = end.reader
    before = times[k, 2]
    looks = 0
    while True:
        size = end.receive(end.handle, got_bytes)
        if size <= 0 and looks > r.spin_limit and not r.realtime:
            size = end.patient(end.handle, got_bytes)
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
        if looks % r.clock_every == 0 or looks > r.spin_limit:
            now = now_ns()
            gap = max(gap, now - before)
            before = now
            if now >= until:
                return OVERDUE, gap
        if size <= 0:
            if not r.realtime and flags[STOP] != 0:
                return LEAVING, gap
            between_looks(looks, end.spins)
