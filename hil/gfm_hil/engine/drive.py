"""Driving the compiled loops: call them, and do in Python what they return for.

The loop has a thread of its own; the main thread, which receives Ctrl-C, watches it.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers import ControllerError
from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import Role
from gfm_hil.engine.controller_ticks import controller_ticks
from gfm_hil.engine.loop_records import (
    FLAGS,
    STOP,
    ControllerRecords,
    LinkEnd,
    Records,
    ReturnReason,
    Side,
    limited_reader,
    make_loop,
)
from gfm_hil.engine.plant_ticks import plant_ticks
from gfm_hil.engine.setup import Bench, follow_trips
from gfm_hil.engine.timeline import Timeline, report_check
from gfm_hil.links import Link, Port, port_function
from gfm_hil.links.frame import LAST_TIMES, FrameError, FrameReader, FrameWriter
from gfm_hil.links.pump import with_port
from gfm_hil.realtime.clock import now_ns, sleep_until
from gfm_hil.realtime.priority import restore_priority
from gfm_hil.recording.log import PLANT_LEFT
from gfm_hil.recording.parts import RolePart
from gfm_plant import NO_FRESH_U
from gfm_plant.names import CONTROLLER_GONE, CONTROLLER_LEFT
from gfm_runtime.signals import names
from gfm_runtime.states import LOST_PEER, PLANT_TRIP, REASONS, SAFE, STOPPED

_FAR = 2**62  # the next tick of a timeline without events
_NAP_NS = 100_000
_SOON = 200  # receptions without a message before lockstep sleeps
_LAST_NS = 500_000_000  # for sending, and for receiving, last frames
_WATCH_S = 0.05  # how often the main thread watches the loop


class Share(NamedTuple):
    """What a role's loop needs of one converter."""

    bench: Bench
    link: Link
    part: RolePart
    timeline: Timeline
    # there are more loops than processors: this one yields its processor whenever no message is
    # there, and in lockstep it sleeps soon
    crowded: bool = False


class _End:
    """One end of a link for a compiled loop, with the frames and records that the loop writes."""

    def __init__(self, role: Role, share: Share, t0_ns: int, flags: NDArray[np.int64]) -> None:
        bench, link, part, *_ = share
        assert link.port is not None
        scenario, port = bench.scenario, link.port
        plant = role == "plant"
        self.bench, self.link = bench, link
        self.writer = FrameWriter("y" if plant else "u", scenario.frame_signals)
        hold = int(bench.controller.ctl["hold"][0])  # of the watchdog, for both sides
        every = getattr(link, "every", 1)
        self.reader = limited_reader(role, scenario, hold, every)
        self.loop = make_loop(scenario, 0 if plant else -1, t0_ns, hold, every)
        port.paced(scenario.mode == "realtime")
        sleeps_soon = share.crowded and port.patient is not None
        self.loop["spin_limit"] = _SOON if sleeps_soon else port.spin_limit
        w, r = self.writer, self.reader
        end = LinkEnd(
            port.send, port.receive, port.patient or _rest, port.handle,
            0 if share.crowded else port.spins,
            (w.sequence, w.frame, w.message), (r.frame, r.message), r.record,
        )  # fmt: skip
        records = Records(
            self.loop,
            flags,
            bench.y,
            bench.y_sent,
            bench.u,
            part.signals,
            part.times,
            part.progress,
            part.flows,
            *bench.trace,
        )
        self.side = Side(end, records)

    @property
    def tick(self) -> int:
        """Plant: the next tick; controller: the last one received."""
        return int(self.loop["tick"][0])

    def checked(self, why: ReturnReason) -> ReturnReason:
        """The reason for which the loop returned. Raises PeerLost: the link is gone."""
        if why == ReturnReason.GONE:
            self.link.receive()  # raises and says more
            raise PeerLost("the link is gone")
        return why

    def set_last_u(self, u: NDArray[np.float64]) -> None:
        """Set the two newest u that were received, p.u., to one value, so that u has no trend."""
        for name in ("u_last", "u_before"):
            self.loop[name][0, : len(u)] = u

    def send_last_frames(self, state: int, reason: int, values: NDArray[np.float64]) -> None:
        """Send the frames that end the run, with the state and reason of this side."""
        tick = max(self.tick, 0)
        end_exchange(self.link, self.writer, self.reader, tick, state, reason, values)


def drive_plant(shares: Sequence[Share], t0_ns: int, flags: NDArray[np.int64]) -> list[FrameReader]:
    """Run the plant's side of a scenario after the handshakes, with a share for each converter;
    returns the frame counters of each."""
    ends = [_End("plant", share, t0_ns, flags) for share in shares]
    timelines = [share.timeline for share in shares]
    sides, first = tuple(end.side for end in ends), ends[0]
    bench = shares[0].bench
    ticks = bench.scenario.ticks
    for end in ends:
        end.set_last_u(end.bench.u)
    while any(timeline.running for timeline in timelines):
        for timeline in timelines:
            timeline.carry_out(first.tick)
        until = min(ticks, *(timeline.next_tick() for timeline in timelines))
        why = first.checked(plant_ticks(sides, bench.plant.records, until))
        tick = first.tick
        if why == ReturnReason.RESTORE:
            bench.restore_plant(tick)
            first.set_last_u(bench.u)
        for started in follow_trips(bench.plant):
            ends[started].set_last_u(bench.plant.st["u"][started, 0, : len(bench.u)])
        report_check(bench.plant, timelines, tick)
        for timeline in timelines:
            timeline.look(max(tick - 1, 0))
            if tick >= ticks and why in (
                ReturnReason.DONE,
                ReturnReason.CHANGED,
                ReturnReason.RESTORE,
            ):
                timeline.finish(tick)
            elif why == ReturnReason.STOPPED_HERE:
                timeline.end("interrupted", "stopped by the operator", tick)
            elif why == ReturnReason.PEER_SAFE:
                timeline.end("safe", REASONS[first.reader.reason], tick)
            elif why == ReturnReason.PEER_STOPPED:
                timeline.end("interrupted", CONTROLLER_LEFT, tick)
            elif why == ReturnReason.SILENT:
                timeline.end("safe", CONTROLLER_GONE, tick)
            elif why == ReturnReason.LATE:
                timeline.end("safe", NO_FRESH_U, tick)
    for end, timeline in zip(ends, timelines, strict=True):
        assert timeline.outcome is not None
        status, survives_trip = timeline.outcome.status, end.bench.scenario.survives_trips
        state = SAFE if status == "tripped" and not survives_trip else STOPPED
        early = status != "completed" and end.tick < ticks
        if not end.loop["lost"][0]:
            end.send_last_frames(state, int(early), end.bench.y_sent)
    return [end.reader for end in ends]


def drive_controller(share: Share, t0_ns: int, flags: NDArray[np.int64]) -> FrameReader:
    """Run the controller's side of a scenario after the handshake; returns its frame counters.

    The controller of a converter in a network answers on in its safe state after a trip, until the
    plant leaves.
    """
    bench, timeline = share.bench, share.timeline
    end, ctl = _End("controller", share, t0_ns, flags), bench.controller.ctl
    loop, own, in_network = end.loop[0], _records(bench), bench.scenario.network is not None
    why, ticks = ReturnReason.EVENT, _ticks_of(bench)
    if bench.external is not None:
        bench.external.last_words = lambda: end.send_last_frames(STOPPED, 0, bench.u)
    loop["heard"] = max(time.monotonic_ns(), t0_ns)
    while timeline.running or in_network:
        event = timeline.next_tick()
        if loop["pending"]:  # the frame of the event's own tick was lost
            timeline.carry_out(end.tick)
            event = timeline.next_tick()
        elif event <= end.tick + 1 or why == ReturnReason.WOKEN:
            timeline.carry_out(end.tick + 1)
            event = timeline.next_tick()
        try:
            why = end.checked(ticks(*end.side, own, event))
        except ControllerError as problem:
            timeline.end("safe", str(problem), end.tick)
            end.send_last_frames(STOPPED, 0, bench.u)
            break
        tick = end.tick
        if why in (ReturnReason.CHANGED, ReturnReason.EVENT) and not loop["pending"]:
            timeline.look(max(tick, 0))
        if why == ReturnReason.STOPPED_HERE:
            timeline.end("interrupted", "stopped by the operator", tick)
            end.send_last_frames(STOPPED, 0, bench.u)
            break
        if why == ReturnReason.PEER_SAFE:
            timeline.end("tripped", REASONS[PLANT_TRIP], max(tick, end.reader.tick))
            end.send_last_frames(SAFE, PLANT_TRIP, bench.u)
            break
        if why == ReturnReason.PEER_STOPPED:
            if end.reader.reason:
                timeline.end("interrupted", PLANT_LEFT, tick)
            else:
                timeline.finish(tick)
            end.send_last_frames(STOPPED, 0, bench.u)
            break
        if why == ReturnReason.SILENT:
            timeline.end("safe", REASONS[LOST_PEER], tick)
            end.send_last_frames(SAFE, LOST_PEER, bench.u)
            break
        if not timeline.running and not in_network:  # ``timeline.look`` found a safe state
            end.send_last_frames(SAFE, int(ctl["reason"][0]), bench.u)
    return end.reader


def send_last(
    link: Link, writer: FrameWriter, tick: int, state: int, reason: int, values: NDArray[np.float64]
) -> None:
    """Send the frame that ends a run several times, because one alone might be lost.

    If the link is full because the other side is behind, retry for a while.
    """
    give_up = time.monotonic_ns() + _LAST_NS
    for _ in range(LAST_TIMES):
        message = writer.pack(tick, state, reason, values)
        while not link.send(message) and time.monotonic_ns() < give_up:
            time.sleep(0.001)


def end_exchange(
    link: Link,
    writer: FrameWriter,
    reader: FrameReader,
    tick: int,
    state: int,
    reason: int,
    values: NDArray[np.float64],
) -> None:
    """Send the frames that end a run and wait a moment for the other side's.

    A side that closed at once could lose its last frames: libzmq drops what a peer that is 64
    frames behind has not read yet. A peer that has heard the first of them may close before the
    second.
    """
    unused = np.empty(len(names(reader.group)))
    with contextlib.suppress(PeerLost):
        send_last(link, writer, tick, state, reason, values)
        give_up = time.monotonic_ns() + _LAST_NS
        while reader.state not in (SAFE, STOPPED) and time.monotonic_ns() < give_up:
            message = link.receive()
            if message is None:
                link.wait(0.01)
                continue
            with contextlib.suppress(FrameError):
                reader.unpack(message, unused)


def run_loop(
    role: Role,
    shares: Sequence[Share],
    t0_ns: int,
    stopped: Callable[[], bool],
    flags: NDArray[np.int64] | None = None,
) -> list[FrameReader]:
    """Run one side of a scenario after the handshakes, in a thread; returns its frame counters.

    The thread inherits processor and priority from the caller. The caller then returns to ordinary
    priority, and every 50 ms checks whether to stop and writes the log.
    A link without a port gets a thread that pumps its messages.

    Args:
        shares: of the controller one, of the plant one for each converter.
        flags: shape (FLAGS,), by which other threads stop or wake the loop, see
            ``gfm_hil.engine.loop_records``.

    Raises:
        PeerLost: an external controller does not answer; its thread goes on.
    """
    if flags is None:
        flags = np.zeros(FLAGS, np.int64)
    shares = [share._replace(link=with_port(share.link)) for share in shares]
    timelines = [share.timeline for share in shares]
    external = shares[0].bench.external if role == "controller" else None
    for share in shares:
        getattr(share.link, "start", _do_nothing)()
    readers: list[FrameReader] = []
    problems: list[BaseException] = []

    def work() -> None:
        try:
            if role == "plant":
                readers.extend(drive_plant(shares, t0_ns, flags))
            else:
                readers.append(drive_controller(shares[0], t0_ns, flags))
        except BaseException as problem:  # the caller's thread raises it
            problems.append(problem)

    for timeline in timelines:
        timeline.put_off = True
    thread = threading.Thread(target=work, name=f"{role}-loop", daemon=True)
    thread.start()
    for share in shares:
        share.part.progress[2] = thread.native_id or 0
    restore_priority()
    try:
        while thread.is_alive():
            thread.join(_WATCH_S)
            for timeline in timelines:
                timeline.flush()
            flags[STOP] = stopped() or any(timeline.failed for timeline in timelines)
            if external is not None:
                external.watch(timelines[0].end, shares[0].bench.scenario.answer_timeout_s)
    finally:  # also after a second Ctrl-C: the thread must end before its arrays go
        flags[STOP] = 1
        while thread.is_alive() and not (external is not None and external.abandoned):
            with contextlib.suppress(KeyboardInterrupt):
                thread.join()
        for timeline in timelines:
            timeline.put_off = False
        for share in shares:
            getattr(share.link, "stop", _do_nothing)()
    if problems:
        raise problems[0]
    return readers


def _do_nothing() -> None:
    """The start and the stop of a link that has neither method."""


def _ticks_of(bench: Bench) -> Callable[..., ReturnReason]:
    return bench.external or controller_ticks


def _records(bench: Bench) -> ControllerRecords:
    c = bench.controller
    if bench.external is None:
        c.find_inner_tick()
    return ControllerRecords(c.ctl, c.laws, c.states, c.est)


def compile_loops(role: Role, benches: Sequence[Bench], parts: Sequence[RolePart]) -> None:
    """Compile (or load from cache) a side's loop, which is the same for all links, without running
    a tick."""
    nowhere: Any = SimpleNamespace(port=Port(np.zeros(1, np.int64), _nothing, _nothing, 0))
    unused: Any = None
    ends = [
        _End(role, Share(bench, nowhere, part, unused), 0, np.ones(FLAGS, np.int64))
        for bench, part in zip(benches, parts, strict=True)
    ]
    if role == "plant":
        plant_ticks(tuple(end.side for end in ends), benches[0].plant.records, 0)
    else:
        _ticks_of(benches[0])(*ends[0].side, _records(benches[0]), _FAR)


@port_function
def _rest(handle, message):
    """Sleep for 100 µs: lockstep on a link that cannot sleep until a message comes."""
    sleep_until(now_ns() + _NAP_NS)
    return 0


@port_function
def _nothing(handle, message):
    return 0
