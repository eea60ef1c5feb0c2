"""The controller's ticks over a link: take y, compute, send u, until Python has to act.

The plant's frames drive it. In real time it also watches the clock: it counts ticks that pass
without a newer frame, and more than ``late_policy.hold`` of them lead to the safe state. It sleeps
until shortly before the next frame, which a phase lock to the frames received so far foretells: it
needs no clock in common with the plant.

Over a link with ``every`` = n > 1, y[k] comes at every n-th tick only. When it comes, the loop
first computes the ticks since the last one, with the y of that one, and sends no u of them.
"""

from gfm_hil.engine.loop_records import STOP, WAKE, ReturnReason
from gfm_hil.engine.replay import stands_still
from gfm_hil.engine.tick import answer
from gfm_hil.links.frame import judge, pack, pack_again, skip, unpack
from gfm_hil.realtime.clock import AHEAD_NS, now_ns, sleep_until, spin_or_yield, yield_processor
from gfm_hil.recording.recorder import record_controller
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.controller import missed, take_set_points
from gfm_runtime.states import SAFE, STOPPED

_Y_ID = 1
_LOOKED_NS = 20_000
_LEAK = 2e-4  # of a tick, per tick: by how much the plant's clock may run slower than ours
_EARLIER = 0.05  # of a tick


@compiled
def controller_ticks(end, records, controller, event):
    """Answer frames; returns why it came back, a ``ReturnReason``.

    Returns EVENT when the next tick is ``event`` or later, after computing the one before; if
    frames were lost on the way there, with that tick's y in hand (``pending``).

    Args:
        end: ``gfm_hil.engine.loop_records.LinkEnd``.
        records, controller: ``Records`` and ``ControllerRecords`` from there.
        event: tick of the next event.
    """
    loop, y, u, times = records.loop, records.y, records.u, records.times
    ctl, laws, states, est = controller
    r = loop[0]
    sent = 0  # when the last answer left, in this call
    while True:
        why = receive(end, records, r, ctl, event, sent)
        if why != ReturnReason.GO_ON:
            return why
        changes = ctl[0].changes
        if not stands_still(records.plan, r.tick):
            take_set_points(ctl[0], records.y_sent, len(y))
            answer(ctl, laws, states, est, y, u, plant_tripped(end, r))
        why = reply(end, records, r, controller, event, changes)
        if why != ReturnReason.GO_ON:
            return why
        sent = times[r.tick, 3]


@inlined
def receive(end, records, r, ctl, event, sent):
    """Wait for the plant's next tick: GO_ON with its y in hand; or why to return.

    The plant asks again where an answer was lost, and gets it again.
    """
    sequence, frame, message = end.out
    while not r.pending:
        if r.tick == r.received:
            if r.left != 0:
                return _parting(r, end.reader[0].state)
            why = _next_frame(end, records, r, ctl, sent)
            if why != ReturnReason.GO_ON:
                return why
            if r.received == r.tick:
                pack_again(sequence, frame, message)  # a reset may have changed state and u since
                end.send(end.handle, message)
                continue
            r.tick = max(r.tick, r.received - r.every) if r.done > 0 else r.received - 1
        r.tick += 1
        if r.every > 1:
            _between(end, records, r)
        if r.tick >= event:
            r.pending = 1
            return ReturnReason.EVENT
        break
    r.pending = 0
    return ReturnReason.GO_ON


@inlined
def plant_tripped(end, r):
    """Whether the plant had tripped in the tick in hand: not yet in the ticks before the y that
    says so."""
    return end.reader[0].state == SAFE and (r.every == 1 or (r.tick == r.received and r.left == 0))


@inlined
def _between(end, records, r):
    """Take the y received once its tick is there; note the times of a tick before it."""
    y, times = records.y_sent, records.times
    got, _ = end.into
    if r.tick == r.received and r.left == 0:
        for j in range(len(y)):
            y[j] = got[0].values[j]
    else:
        times[r.tick, 0] = r.t0 + r.tick * r.T
        times[r.tick, 1], times[r.tick, 4] = now_ns(), 0


@inlined
def reply(end, records, r, controller, event, changes):
    """Send u of the tick in hand and record it; GO_ON, or why to return.

    ``changes`` is how often the law had changed before this tick.
    """
    u, rows, times, progress = records.u, records.rows, records.times, records.progress
    ctl, _, states, est = controller
    sequence, frame, message = end.out
    k = r.tick
    times[k, 2] = now_ns()
    if r.every == 1 or k % r.every == 0:
        pack(sequence, frame, message, k, ctl[0].state, ctl[0].reason, u)
        end.send(end.handle, message)
    else:
        skip(sequence)
    times[k, 3] = now_ns()
    if r.realtime and end.spins == 0:
        yield_processor()  # to the link's own thread: a sleep takes 9 µs before it leaves
    record_controller(rows[k], ctl, states, est)
    r.done += 1
    progress[0], progress[1] = k + 1, ctl[0].reason
    if ctl[0].state != r.seen or ctl[0].changes != changes:
        r.seen = ctl[0].state
        return ReturnReason.CHANGED
    return ReturnReason.EVENT if k + 1 >= event else ReturnReason.GO_ON


@inlined
def _next_frame(end, records, r, ctl, sent):
    """Wait for a good frame of the plant: GO_ON, its tick in ``r.received`` if it is newer than
    ``r.tick``; or why to return.

    The time since the last answer was ``sent`` (0: there was none), which the link's own thread
    took, is a gap between two looks at the clock like any other.
    """
    flags, y, times = records.flags, records.y_sent, records.times
    got, got_bytes = end.into
    reader = end.reader
    judge(reader, False, ctl[0].state == SAFE)
    if flags[WAKE] != r.woken:
        r.woken = flags[WAKE]
        return ReturnReason.WOKEN
    slept = False
    before = now_ns()
    gap = before - sent if r.realtime and sent > 0 else 0
    if r.realtime and r.done > 0 and flags[STOP] == 0:
        due = r.t0 + (r.tick + r.every) * r.T
        wake = min(due + int(r.phase) - AHEAD_NS, before + r.every * r.T)
        if end.spins == 0 and due > before:
            # Others need the processor too. Without any rest the kernel would throttle all real
            # time on it for 50 ms in each second.
            wake = max(wake, min(before + r.T // 2, due))
        if wake > before:
            sleep_until(wake)
            slept = True
            before = wake  # oversleeping counts as a gap
    awake = now_ns()
    looks = 0
    while True:
        size = end.receive(end.handle, got_bytes)
        looks += 1
        if size <= 0 and looks > r.spin_limit and not r.realtime:
            size = end.patient(end.handle, got_bytes)
        if size < 0:
            return ReturnReason.GONE
        if size > 0 or looks % r.clock_every == 0 or looks > r.spin_limit:
            now = now_ns()
            gap = max(gap, now - before)
            before = now
            if size > 0:
                k = unpack(reader, _Y_ID, got, got_bytes, size, y[: r.at_once])
                if k > r.tick:  # only a newer tick is a sign of life
                    r.heard = now
                if k >= 0:
                    break
            if now - r.heard >= r.patience:
                judge(reader, True, True)
                return ReturnReason.SILENT
            if r.realtime and r.done > 0:  # before tick 0 nothing can be stale
                overdue = (now - r.heard) // r.T - (r.every - 1)
                while ctl[0].stale < overdue and ctl[0].state != SAFE:
                    missed(ctl)
                judge(reader, ctl[0].stale > ctl[0].hold, True)
                if ctl[0].state != r.seen:
                    r.seen = ctl[0].state
                    return ReturnReason.CHANGED
        if flags[STOP] != 0:
            return ReturnReason.STOPPED_HERE
        if flags[WAKE] != r.woken:
            r.woken = flags[WAKE]
            return ReturnReason.WOKEN
        if size <= 0:
            spin_or_yield(looks, end.spins)
    why = _parting(r, reader[0].state)
    if why != ReturnReason.GO_ON:
        if r.every == 1 or r.done == 0 or k <= r.tick + 1:
            return why
        r.received, r.left = k - 1, 1  # the ticks up to there are computed first
        return ReturnReason.GO_ON
    if r.realtime:
        _lock(r, k, now, now - awake > _LOOKED_NS, slept)
    if k > r.tick:
        times[k, 0] = r.t0 + k * r.T
        times[k, 1], times[k, 4] = now, gap
        r.received = k
    return ReturnReason.GO_ON


@inlined
def _parting(r, state):
    """Whether the plant's state ends the run: PEER_SAFE, PEER_STOPPED, or GO_ON."""
    if state == SAFE and not r.survives_trip:
        return ReturnReason.PEER_SAFE
    if state == STOPPED:
        return ReturnReason.PEER_STOPPED
    return ReturnReason.GO_ON


@compiled
def _lock(r, k, now, seen, slept):
    """Learn from frame k when the next one will come.

    ``phase`` follows the earliest arrivals against k T, because a late frame says nothing of the
    plant's clock. A frame counts as ``seen`` to arrive only after empty reads: without them it may
    have waited in a link's own thread. A frame that was there right after a sleep shows that the
    sleep was too long.
    """
    away = float(now - r.t0 - k * r.T)
    if seen:
        r.phase = min(r.phase + _LEAK * r.T, away)
    elif slept:
        r.phase -= _EARLIER * r.T
