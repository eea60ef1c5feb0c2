"""The plant's ticks over links: sample, send, wait for u, advance, until Python has to act.

Each converter has a link to a controller of its own; the tick is one. Lockstep: the plant waits for
every u[k], and sends y[k] again where nothing comes. Real time: the plant samples tick k at its
deadline t_0 + k T_s on CLOCK_MONOTONIC, and u[k] has until the next deadline. A u[k] that is not
there by then is a miss: the plant holds the last u of that converter, and after
``late_policy.hold`` misses in a row it blocks it. One converter alone then ends the run. Among
several, a controller that leaves or falls silent trips its converter, and the others go on.

Over a link with ``every`` = n > 1, y[k] is sent at every n-th tick only, and its u[k] acts from
tick k + n on (before tick n u[0] acts): a delay of n ticks, in lockstep as in real time.
"""

from gfm_hil.engine.loop_records import STOP, WAKE, ReturnReason
from gfm_hil.engine.replay import ACTS, replay
from gfm_hil.engine.tick import apply_peer_state, asks_to_start, sample, take
from gfm_hil.links.frame import INVALID, judge, pack, pack_again, skip, unpack
from gfm_hil.realtime.clock import (
    AHEAD_NS,
    now_ns,
    sleep_until,
    spin_or_yield,
    wait_until,
    yield_processor,
)
from gfm_hil.recording.columns import kept_of
from gfm_hil.recording.recorder import record_command
from gfm_plant import plant_flows, plant_is_delayed, plant_set_points, plant_step
from gfm_plant.names import CONTROLLER, GONE, LEFT
from gfm_plant.names import SILENT as NOT_HEARD
from gfm_plant.protection import trip
from gfm_plant.synchro_check import WATCHING
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.states import PLANT_TRIP, SAFE

_U_ID = 2
_MEASURED, _ACTS = map(kept_of("plant").index, ("measured", "acts"))
# what came of u[k]; HELD_BACK: it came, and the trace that is replayed says that it did not
AWAITED, FRESH, OVERDUE, LEAVING, CUT_OFF, HELD_BACK = range(6)
_NOTHING, _OTHER, _OVER = range(3)  # what one read of a link gives
_UNRESTED, _REST_NS = 10, 50_000  # ticks; ns


@compiled
def plant_ticks(sides, plant, last):
    """Run ticks until ``last``; returns why it came back, a ``ReturnReason``.

    Args:
        sides: for each converter a ``gfm_hil.engine.loop_records.Side``, in the plant's order.
        plant: ``gfm_plant.PlantRecords``.
        last: the tick before which it stops.
    """
    flags, r = sides[0].records.flags, sides[0].records.loop[0]  # what all have in common
    spins, patience, repeat = sides[0].end.spins, r.patience, r.repeat
    for i in range(len(sides)):
        own = sides[i].records.loop[0]
        spins = min(spins, sides[i].end.spins)
        patience, repeat = min(patience, own.patience), min(repeat, own.repeat)
    delayed = plant_is_delayed(plant)
    # In lockstep a delayed plant sends its next frame right after an answer, so one reading of the
    # clock serves both. A reading stalls the processor: two of them took a tenth of the tick.
    hurried, why = delayed and not r.realtime, ReturnReason.DONE
    while r.tick < last:
        if flags[STOP] != 0:
            why = ReturnReason.STOPPED_HERE
            break
        if flags[WAKE] != r.woken:
            r.woken = flags[WAKE]
            why = ReturnReason.WOKEN
            break
        k = r.tick
        due = r.t0 + k * r.T
        gap, awaited = 0, 0
        if r.realtime:
            r.unrested = 0 if due - now_ns() > AHEAD_NS else r.unrested + 1
            gap = wait_until(due, spins)
        for i in range(len(sides)):
            awaited += _ask(sides[i], plant, i, k, due)
        if delayed:  # u[k] does not act in this period: it can come meanwhile
            plant_step(plant)
        if awaited > 0:
            gap = _await(sides, k, awaited, gap, spins, patience, repeat, hurried)
        why = ReturnReason.GO_ON
        for i in range(len(sides)):
            said = _close(sides[i], plant, i, k, gap, hurried)
            if why == ReturnReason.GO_ON:
                why = said
        if why != ReturnReason.GO_ON:
            break
        if not delayed:
            plant_step(plant)
        for i in range(len(sides)):
            why = _judge(sides[i], plant, i, why)
        if why == ReturnReason.GO_ON and plant.now[0].check > WATCHING:
            why = ReturnReason.CHANGED
        if why != ReturnReason.GO_ON:
            break
        why = ReturnReason.DONE
    for i in range(len(sides)):
        own = sides[i].records.loop[0]
        if own.unseen >= 0:
            sides[i].records.times[own.unseen, 3] = now_ns()
            own.unseen = -1
    return why


@inlined
def _ask(side, plant, i, k, due):
    """Measure, record and send y[k] of a converter; returns 1, or 0 if its controller is lost."""
    end, records = side
    times = records.times
    r = records.loop[0]
    r.tick = end.reader[0].newest = k
    if r.realtime:
        times[k, 0], times[k, 1] = due, now_ns()
    r.tripped = sample(plant, i, records.y, records.rows[k])
    plant_set_points(plant, i, records.y_sent)
    if records.flows.shape[1] > 0:
        plant_flows(plant, records.flows[k])
    if r.lost != 0:
        r.came = OVERDUE
        return 0
    state, reason = (SAFE, PLANT_TRIP) if r.tripped != 0 else (0, 0)
    sequence, frame, message = end.out
    if r.realtime:
        times[k, _MEASURED] = now_ns()
    if r.every == 1 or k % r.every == 0:
        pack(sequence, frame, message, k, state, reason, records.y_sent)
        end.send(end.handle, message)
    else:
        skip(sequence)
    sent = now_ns()
    times[k, 2] = sent
    if r.realtime and end.spins == 0:
        yield_processor()  # to the link's own thread, before the first look
    if r.unseen >= 0:
        times[r.unseen, 3] = sent
        r.unseen = -1
    r.came = AWAITED
    if r.every > 1 and _acts(r, records.u, k):
        r.came = FRESH
        times[k, 3] = sent
        return 0
    return 1


@inlined
def _acts(r, u, k):
    """Whether the u that acts in tick k has come; puts it into u.

    In lockstep the newest u must have come as well: only as long as the plant has sent no later y
    does a second request bring one that was lost.
    """
    asked = k - k % r.every
    acting = max(0, asked - r.every)
    if r.acting != acting and r.ahead == acting:
        r.acting = acting
        for j in range(len(u)):
            u[j] = r.u_ahead[j]
    return r.acting == acting and (r.realtime != 0 or r.ahead == asked)


@inlined
def _await(sides, k, awaited, gap, spins, patience, repeat, hurried):
    """Wait for every u[k] that is ``awaited``; says in each loop what ``came``.

    Returns the longest gap between two looks at the clock, ns. A ``hurried`` loop looks later.
    """
    flags, r = sides[0].records.flags, sides[0].records.loop[0]
    sent = 0
    for i in range(len(sides)):
        sent = max(sent, sides[i].records.times[k, 2])
    if r.unrested > _UNRESTED:  # else the kernel throttles the whole loop for 50 ms
        sleep_until(sent + _REST_NS)
        r.unrested = 0
    until = r.t0 + (k + 1) * r.T if r.realtime else sent + patience
    again = until if r.realtime else sent + repeat
    before, looks = sent, 0
    while True:
        quiet = True
        for i in range(len(sides)):
            if sides[i].records.loop[0].came != AWAITED:
                continue
            found = _look(sides[i], k, looks)
            quiet = quiet and found == _NOTHING
            if found == _OVER:
                awaited -= 1
                own = sides[i].records
                if not hurried:
                    now = now_ns()
                    gap = max(gap, now - before)
                    if own.loop[0].came == FRESH:
                        own.times[k, 3] = now
        if awaited == 0:
            return gap
        looks += 1
        if looks % r.clock_every == 0 or looks > r.spin_limit:
            now = now_ns()
            gap = max(gap, now - before)
            before = now
            if now >= until:
                _give_up(sides, OVERDUE)
                return gap
            if now >= again:
                again = now + repeat
                _ask_again(sides)
        if quiet:
            if not r.realtime and flags[STOP] != 0:
                _give_up(sides, LEAVING)
                return gap
            spin_or_yield(looks, spins)


@inlined
def _look(side, k, looks):
    """Read a link once: whether it gives NOTHING, an OTHER message than u[k], or what ends the
    wait (OVER), with what ``came`` in the loop."""
    end, records = side
    r = records.loop[0]
    got, got_bytes = end.into
    reader = end.reader
    size = end.receive(end.handle, got_bytes)
    if size <= 0 and looks > r.spin_limit and not r.realtime:
        size = end.patient(end.handle, got_bytes)
    if size < 0:
        r.came = CUT_OFF
        return _OVER
    if size == 0:
        return _NOTHING
    tick = unpack(reader, _U_ID, got, got_bytes, size, records.u[: r.at_once])
    if r.every > 1:
        if tick > r.ahead:
            r.ahead = tick
            for j in range(len(records.u)):
                r.u_ahead[j] = got[0].values[j]
        tick = k if _acts(r, records.u, k) else -1
    if tick == k:
        r.came = FRESH
        return _OVER
    if reader[0].state >= reader[0].leaving:  # it says so under the last tick it saw
        r.came = LEAVING
        return _OVER
    return _OTHER


@inlined
def _give_up(sides, came):
    """Stop waiting."""
    for i in range(len(sides)):
        if sides[i].records.loop[0].came == AWAITED:
            sides[i].records.loop[0].came = came


@inlined
def _ask_again(sides):
    """Send y[k] once more to those who have not answered."""
    for i in range(len(sides)):
        end, records = sides[i]
        if records.loop[0].came == AWAITED:
            records.loop[0].repeats += 1
            sequence, frame, message = end.out
            pack_again(sequence, frame, message)
            end.send(end.handle, message)


@inlined
def _close(side, plant, i, k, gap, hurried):
    """Record what a converter is told in tick k, and hand it to the D/A; why to return, if so."""
    end, records = side
    reader, u = end.reader, records.u
    r = records.loop[0]
    came = r.came
    if came == CUT_OFF and r.others == 0:
        return ReturnReason.GONE
    records.times[k, _ACTS] = reader[0].tick if r.every == 1 else r.acting
    if came == FRESH and len(records.plan) > 0:
        records.times[k, _ACTS] = records.plan[k, ACTS]
        if not replay(records.plan, records.kept, k, u, u):
            came, records.times[k, 3] = HELD_BACK, -1
    if came == FRESH:
        if hurried:
            r.unseen = k
        if r.extrapolate > 0:
            for j in range(len(u)):
                r.u_before[j], r.u_last[j] = r.u_last[j], u[j]
    elif r.realtime and r.late < r.extrapolate:
        for j in range(len(u)):
            u[j] = r.u_last[j] + (r.late + 1) * (r.u_last[j] - r.u_before[j])
    record_command(records.rows[k], u)
    records.progress[0] = k + 1
    if r.lost == 0:
        why = apply_peer_state(plant, i, r.survives_trip, reader[0].state)
        if why != ReturnReason.GO_ON:
            if r.others == 0:
                return why
            r.lost = LEFT
        elif came == CUT_OFF:
            r.lost = GONE
        elif came != FRESH and came != HELD_BACK and not r.realtime:
            judge(reader, came == OVERDUE, True)
            if came != OVERDUE:
                return ReturnReason.STOPPED_HERE
            if r.others == 0:
                return ReturnReason.SILENT
            r.lost = GONE
    if came != FRESH:
        r.misses += 1
        records.progress[1] = r.misses
    r.late = 0 if came == FRESH else r.late + 1
    judge(reader, r.late > r.hold, r.tripped != 0)
    records.times[k, 4] = gap
    r.tick = k + 1
    return take(plant, i, u, r.tripped, reader[0].state, came == FRESH)


@inlined
def _judge(side, plant, i, why):
    """Trip a converter whose controller is lost; returns why to return, the weightiest reason so
    far."""
    reader = side.end.reader
    r = side.records.loop[0]
    if r.lost != 0:
        trip(plant, i, CONTROLLER, r.lost)
    elif r.survives_trip and reader[0].e2e == INVALID:
        trip(plant, i, CONTROLLER, NOT_HEARD)
    if plant.st[i].trip != r.tripped:
        return ReturnReason.CHANGED
    if r.lost == 0 and asks_to_start(plant, i, reader[0].state):
        return ReturnReason.CHANGED
    if r.late * r.T >= r.patience:
        judge(reader, True, True)
        if r.others == 0:
            return ReturnReason.SILENT
        r.lost = GONE
    if reader[0].e2e == INVALID and not r.survives_trip:
        return ReturnReason.LATE
    return why
